"""Robots that answer by a script, on a clock that jumps instead of waiting: for tests of calls."""

import asyncio
import functools
import selectors
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from math import inf
from typing import Any

import pytest

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.conversation import Conversations, Robot, Traffic
from psiu_broker.errors import CallError
from psiu_broker.frame import Address, Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles import HexaProfile, Node, PsiuProfile

BASE = Address.named("base")
MNERIM = Address.named("MNERIM")
OURS = Address.numbered(1)
ARM = Address.numbered(0x12)
NODES = {
    "garra": Node(node=4, type="servo"),
    "sonar": Node(node=7, type="distance", unit="cm"),
    "luz": Node(node=8, type="luminosity"),
}


class JumpingSelector(selectors.DefaultSelector):
    """Where the loop would sleep, its clock jumps."""

    jumped_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert timeout is not None, "nothing is left that could wake the loop"
        self.jumped_s += max(timeout, 0.0)
        return super().select(0)


class JumpingLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is what its timers make of it."""

    def __init__(self) -> None:
        self._jumping = JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return 1000.0 + self._jumping.jumped_s


def jumping(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run an async test on a jumping clock."""

    @functools.wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        with asyncio.Runner(loop_factory=JumpingLoop) as runner:
            runner.run(test(*args, **kwargs))

    return run


def now() -> float:
    return asyncio.get_running_loop().time()


class Robots:
    """A broker's worth of calls to scripted robots: `script` says what each frame sent is answered with.

    Every link is `stuck`, and keeps what it is given, or sends it at once.
    """

    def __init__(self, **options: Any) -> None:
        self.conversations = Conversations(self, **options)
        self.sent: list[tuple[float, bytes]] = []
        self.ages: list[float] = []
        self.refuse: CallError | None = None
        self.script: Callable[[Frame], Sequence[tuple[float, bytes]]] = lambda _: ()
        self.begun = now()
        self.stuck = False
        self._kept: list[tuple[float, Frame]] = []
        self._out: dict[str, Traffic] = {}
        self._links: dict[Address, str] = {}

    def send(self, frame: Frame, patience_s: float) -> CallError | None:
        if self.refuse is not None:
            return self.refuse
        self.ages.append(round(patience_s, 6))
        if self.stuck:
            self._kept.append((now() + patience_s, frame))
            return None
        self._leaves(frame)
        return None

    def flows(self) -> None:
        """The links are stuck no more: what they kept leaves."""
        self.stuck = False
        kept, self._kept = self._kept, []
        for _, frame in kept:
            self._leaves(frame)

    def _leaves(self, frame: Frame) -> None:
        self.sent.append((round(now() - self.begun, 6), frame.payload))
        self.another_leaves(self._links[frame.destination])
        self.conversations.delivered(frame, now())
        for delay_s, payload in self.script(frame):
            answer = frame._replace(source=frame.destination, destination=frame.source, subject="", payload=payload)
            asyncio.get_running_loop().call_later(delay_s, self.say, answer)

    def expire(self, link: str) -> None:
        late = [frame for until, frame in self._kept if until <= now() + 1e-6]
        self._kept = [(until, frame) for until, frame in self._kept if until > now() + 1e-6]
        for frame in late:
            self.conversations.undelivered(frame, CallError("expired", "nothing was sent"))

    def traffic(self, link: str) -> Traffic:
        return self._out.get(link, Traffic(0, -inf))

    def another_leaves(self, link: str) -> None:
        """A frame, of ours or of anybody, leaves on `link` now."""
        self._out[link] = Traffic(self.traffic(link).frames + 1, now(), self.traffic(link).heard)

    def another_is_heard(self, link: str) -> None:
        self._out[link] = Traffic(self.traffic(link).frames, now(), self.traffic(link).heard + 1)

    def say(self, frame: Frame) -> bool:
        self.another_is_heard(self._links.get(frame.source, "radio"))
        return self.conversations.heard(frame, now())

    def says(self, payload: bytes, source: Address = ARM) -> bool:
        """The robot says something of itself."""
        destination, protocol = (OURS, "psiu-hexa") if source.is_numbered else (BASE, "psiu-ascii")
        return self.say(Frame(source, destination, "", payload, protocol))

    def of_words(self, address: Address = MNERIM, link: str = "radio", peer: object = None) -> Robot:
        self._links[address] = link
        return Robot(
            str(address), BASE, address, PsiuProfile(),
            lambda request: psiu_ascii.message(BASE, address, *request.payload.decode().split()), link, peer,
        )  # fmt: skip

    def of_bytes(self) -> Robot:
        self._links[ARM] = "arm"
        build = lambda request: psiu_hexa.packet(OURS, ARM, request.payload)  # noqa: E731
        return Robot("BRACO", OURS, ARM, HexaProfile(NODES), build, "arm")

    async def ascii(
        self,
        command: str,
        *parameters: Value,
        address: Address = MNERIM,
        link: str = "radio",
        peer: object = None,
        **more: Any,
    ) -> Answer:
        return await self.conversations.call(self.of_words(address, link, peer), command, parameters, **more)

    async def hexa(self, command: str, *parameters: Value, **more: Any) -> Answer:
        return await self.conversations.call(self.of_bytes(), command, parameters, **more)

    @property
    def idle(self) -> bool:
        return not self.conversations._turns and not self.conversations._under_way

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.sent]


async def refused(call: Awaitable[object]) -> CallError:
    with pytest.raises(CallError) as caught:
        await call
    return caught.value
