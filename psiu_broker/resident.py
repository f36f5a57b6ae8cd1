"""The robot that the broker is: what it answers for itself, and for robots that have no words of their own."""

import asyncio
import logging
import random
import time
from collections.abc import Callable, Coroutine, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from psiu_broker.calling import DISCOVER, Caller, Calling
from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.psiu_hexa import BAD_CHECK, PsiuHexa
from psiu_broker.config import Configuration
from psiu_broker.config.who import describer
from psiu_broker.errors import CallError
from psiu_broker.exchange import Exchange
from psiu_broker.frame import COMPLAINT, EVERYONE, Address, Frame, Malformed, Way
from psiu_broker.link import Link
from psiu_broker.messages import Answer, CallRequest, Command, Value
from psiu_broker.playing import Playing
from psiu_broker.profiles import Description, Responder
from psiu_broker.profiles.hexa import NAK
from psiu_broker.profiles.psiu import NAME, canonical, said
from psiu_broker.profiles.rarely import Rarely
from psiu_broker.profiles.responder import outcome, refusal
from psiu_broker.routing.outbox import STOP_LANE, lane
from psiu_broker.routing.table import Route
from psiu_broker.routing.verdicts import ANSWERED, LINK_DOWN, REFUSED, Verdict

__all__ = ["DISCOVER", "Resident"]

log = logging.getLogger(__name__)

ANSWER_DELAY_S: Final = 0.035
"""At most this late, and at random, is a question to everyone answered on a shared line (PSIU row 8; row 14: 40 ms)."""
NAME_WITHIN_S: Final = 2.0
"""How long after our question a name is its answer."""
NAK_EVERY_S: Final = 0.1
TASKS_KEPT: Final = 64
STOPS_KEPT: Final = 8
"""How many stops of one robot, besides, may wait for their answers; of any more the answers are not waited for."""
_TALKING: Final = frozenset({psiu_ascii.PROTOCOL, psiu_hexa.PROTOCOL})
"""The protocols in which the broker is a robot among others, with a name or a number of its own."""


@dataclass(slots=True)
class _Asked:
    """When we asked for names on a link, and who has answered."""

    at: float
    answered: set[Address] = field(default_factory=set)


class Resident:
    """Implements `exchange.Resident`; `call` and `tell` are what the bus offers to programs."""

    def __init__(
        self, configuration: Configuration, exchange: Exchange, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = Address.named(configuration.broker.name)
        self._exchange = exchange
        self._router = exchange.router
        self._clock = clock
        self._calling = Calling(configuration, exchange, clock)
        self._conversations = self._calling.conversations
        self.failsafe = self._calling.failsafe
        self._playing = Playing(configuration, exchange, self._calling, self.failsafe, clock)
        self._describe = describer(configuration)
        self._responder = Responder(configuration.broker.name)
        self._tasks: dict[asyncio.Task[None], Address | None] = {}
        """What goes on, and which robot it tells to stop in words."""
        self._naks = Rarely()
        self._asked: dict[str, _Asked] = {}

    def settling(self, settling_s: Callable[[], float]) -> None:
        """As `Calling.settling_s`."""
        self._calling.settling_s = settling_s

    # exchange.Resident

    def answer(self, frame: Frame, way: Way, now: float) -> None:
        if frame.protocol not in _TALKING:
            self._hear(frame, now)
            return
        if self._conversations.heard(frame, now) or self._says_its_name(frame, way, now):
            return
        self._tell_programs(frame, now)
        reply = self._responder.answer(frame, now, self._conversations.pinging(frame.source))
        if reply is None:
            return
        link = self._exchange.links.get(way.link)  # none: it came from another broker
        if frame.destination == EVERYONE and link is not None and not link.adapter.datagrams:
            delay_s = random.uniform(0, ANSWER_DELAY_S)  # noqa: S311 - keeps robots apart, no secret
            asyncio.get_running_loop().call_later(delay_s, self._say, reply)
        else:
            self._exchange.send(reply, now)

    def translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        played = self._playing.heard(frame, way, now)
        if played is not None:
            return played
        if frame.protocol != psiu_ascii.PROTOCOL:
            return REFUSED
        route = self._router.find(frame.destination)
        if route is None or not self._has_room(frame, route):
            return REFUSED
        down = self._exchange.links[route.way.link].state != "open"
        told = None if down else self._responder.listed(frame, str(route.robot), self.commands(route), now)
        if told is not None:
            self._exchange.send(told, now)
        elif not said(frame).answer:
            stopped = route.robot if lane(frame) == STOP_LANE else None
            waits = stopped is None or self._stops_of(stopped) < STOPS_KEPT
            self._start(self._ask_for(frame, route, way, now, waits=waits), stopped)
        return LINK_DOWN if down else ANSWERED

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None:
        if malformed.reason == COMPLAINT:
            self._conversations.complained(way.link, way.peer)
            return
        nak = self._nak(self._exchange.links[way.link], malformed)
        if nak is not None and self._naks.may(way, now, NAK_EVERY_S):
            self._exchange.send(nak, now)

    def asked_names(self, ways: Iterable[Way], now: float) -> None:
        self._asked.update({way.link: _Asked(now) for way in ways})

    def delivered(self, frame: Frame, now: float) -> None:
        self._conversations.delivered(frame, now)

    def undelivered(self, frame: Frame, verdict: Verdict) -> None:
        self._calling.undelivered(frame, verdict)

    def unreachable(self, frame: Frame, way: Way, now: float) -> None:
        words, source = said(frame), self._router.find(frame.source)
        asks = not words.answer and canonical(words.command) != NAME  # the name of one who is absent is nobody's
        if frame.protocol != psiu_ascii.PROTOCOL or frame.destination == EVERYONE or not asks:
            return
        told = self._responder.refused(frame, str(frame.destination), now)
        if told is not None and source is not None and source.way == way:
            self._exchange.send_by(told, way, now)

    def link_opened(self, link: Link, now: float) -> None:
        """Greet, as far as our allowance on the link goes: robots are to be known before anybody needs them."""
        options = link.configuration.options
        if link.name in self.failsafe.links:
            link.watch = self.failsafe
            self.failsafe.link_opened(link.name)
        self._playing.link_opened(link, now)
        if not options.greet or options.plays is not None:
            return
        if link.codec.protocol not in _TALKING:
            for route in self._router.robots():
                if route.way.link == link.name:
                    self._meet(route)
            return
        if link.codec.protocol == "psiu-ascii" and options.wildcard:
            self._exchange.ask_names(link, now)
        for route in self._router.robots():
            if route.way.link != link.name or route.protocol != "psiu-hexa" or len(self._tasks) >= TASKS_KEPT:
                continue
            number = next(address for address in route.addresses if address.is_numbered)
            if self._exchange.may_ask(number, link.name, now, 1 + options.retries):
                self._start(self._greet(route))

    def link_closed(self, link: Link, now: float) -> None:
        self.failsafe.link_closed(link.name)
        self._playing.link_closed(link.name)
        self._conversations.link_down(link.name, link.reason or "closed")

    def peer_came(self, way: Way, now: float) -> None:
        self._playing.peer_came(way, now)

    def peer_lost(self, way: Way, now: float) -> None:
        self._playing.peer_lost(way)
        self._conversations.link_down(way.link, "its far end is gone", way.peer)

    # What the broker tells us.

    def robot_heard(self, route: Route) -> None:
        self._calling.robot_heard(route)
        link = self._exchange.links.get(route.way.link)
        if link is None or not link.adapter.datagrams or link.configuration.options.plays is not None:
            return
        if route.protocol not in _TALKING and link.configuration.options.greet:
            # When the link opened, nobody was there to be greeted.
            self._meet(route, again=True)

    def robot_gone(self, route: Route) -> None:
        self._calling.robot_gone(route)

    def commands(self, route: Route) -> Sequence[Command]:
        return self._calling.commands(route)

    def describe(self, frame: Frame) -> Description:
        """What a frame says, in the words of `messages.Decoded`."""
        if frame.protocol in _TALKING:
            return self._describe(frame)
        return self._calling.describe(frame) or {"kind": "command", "command": frame.subject}

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer:
        """Raises CallError, as `Calling.call` does."""
        return await self._calling.call(robot, command, request)

    async def tell(self, robot: Address, command: str, request: CallRequest) -> None:
        """Raises CallError, as `Calling.tell` does."""
        await self._calling.tell(robot, command, request)

    async def close(self) -> None:
        """End every call, wait for what the broker itself was asking, and stop the robots that are to be stopped."""
        self._conversations.close()
        await self._playing.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._exchange.alone = self.failsafe.last  # robots that command others still speak
        await self.failsafe.close()

    # Inside.

    def _hear(self, frame: Frame, now: float) -> None:
        """A frame of a robot that knows nothing of us: perhaps an answer, perhaps something to pass on."""
        self._calling.learn(frame)
        if not self._conversations.heard(frame, now):
            self._tell_programs(frame, now)

    def _tell_programs(self, frame: Frame, now: float) -> None:
        """Those that the sender is played to hear what it says."""
        route = self._router.find(frame.source)
        self._playing.told(frame.source if route is None else route.robot, lambda: self.describe(frame), now)

    def _says_its_name(self, frame: Frame, way: Way, now: float) -> bool:
        """Whether `frame` answers our qualseunome or ping: its sender's first on the link where we just asked.

        Any other is a question to us, and in the same words. A group is asked by one way, and each of its robots
        answers by another, its own.
        """
        asked = self._asked.get(way.link)
        ours = frame.subject == "ping" or (frame.subject == NAME and frame.destination == self.name)
        if not ours or asked is None:
            return False
        if now - asked.at > NAME_WITHIN_S or frame.source in asked.answered:
            return False
        asked.answered.add(frame.source)
        return True

    def _nak(self, link: Link, malformed: Malformed) -> Frame | None:
        """Our NAK to a packet with a bad check, where it is ours to say (PSIU HEXA row 7)."""
        codec = link.configuration.codec
        if not isinstance(codec, PsiuHexa.Options) or malformed.reason != BAD_CHECK:
            return None
        own = Address.numbered(codec.local, codec.domain)
        wanted = link.configuration.options.nak
        if codec.topology == "ad-hoc":
            if len(malformed.wire) < 2 or wanted is False or (malformed.wire[1] != codec.local and not wanted):
                return None
            return psiu_hexa.packet(own, Address.numbered(malformed.wire[0], codec.domain), bytes((NAK,)))
        if codec.topology == "point-to-point" and wanted is not False and codec.remote is not None:
            return psiu_hexa.packet(own, Address.numbered(codec.remote, codec.domain), bytes((NAK,)))
        if codec.topology == "master-slave" and wanted and malformed.wire:
            return psiu_hexa.packet(own, Address.numbered(malformed.wire[0], codec.domain), bytes((NAK,)))
        return None

    def _say(self, frame: Frame) -> Verdict | None:
        return self._exchange.send(frame, self._clock())

    def _meet(self, route: Route, *, again: bool = False) -> None:
        """Greet a robot that is there again; first bring it out of what it was cut off in."""
        if route.robot in self._conversations.alone and len(self._tasks) < TASKS_KEPT:
            self._start(self._mend(route))
        elif again:
            self._calling.greet_again(route)
        else:
            self._calling.greet(route)

    async def _mend(self, route: Route) -> None:
        try:
            await self._calling.mend(route)
        except CallError as error:
            log.warning("%s may still be recording: %s", route.robot, error)

    async def _greet(self, route: Route) -> None:
        try:
            await self._calling.ask(route, "ping")
        except CallError as error:
            log.info("greeting %s: %s", route.robot, error)

    async def _ask_for(self, frame: Frame, route: Route, way: Way, arrived: float, *, waits: bool) -> None:
        """Do for the sender of `frame`, in words, what a robot of bytes is told; answer in the robot's name.

        Unless it `waits`, the answer is not waited for, and only a refusal is told.
        """
        word, *words = frame.payload.decode("ascii", "replace").split() or [frame.subject]
        name = str(route.robot)
        longest_s = self._exchange.links[route.way.link].configuration.options.longest_wait_s(word)
        fresh_s = longest_s - (self._clock() - arrived)
        try:
            # A robot may send more words than a program may parameters.
            request = CallRequest.model_construct(parameters=list[Value](words))
            if not waits:
                await self._calling.tell(route.robot, word, request, arrived, Caller(frame.source, way))
                return
            answer = await self._calling.ask(route, word, request, fresh_s, Caller(frame.source, way))
        except CallError as error:
            log.debug("%s told %s %s: %s", frame.source, name, word, error)
            told = self._responder.refused(frame, name, self._clock())
            if told is not None:
                self._say(told)
        else:
            told = outcome(frame, name, answer)
            if told is not None and self._say(told) == REFUSED:  # too long for the sender's protocol
                self._say(refusal(frame, name))

    def _has_room(self, frame: Frame, route: Route) -> bool:
        """Whether `frame` can be done for its sender; there is for a stop, unless others have yet to leave."""
        if lane(frame) == STOP_LANE:
            return self._stops_of(route.robot) < 2 * STOPS_KEPT
        return len(self._tasks) < TASKS_KEPT

    def _stops_of(self, robot: Address) -> int:
        """How many stops in words `robot` is being told."""
        return sum(stopped == robot for stopped in self._tasks.values())

    def _start(self, work: Coroutine[Any, Any, None], stopped: Address | None = None) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks[task] = stopped
        task.add_done_callback(self._tasks.pop)
