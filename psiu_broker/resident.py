"""The robot that the broker is: it answers for itself, calls robots for programs, and asks around."""

import asyncio
import logging
import random
import time
from collections.abc import Callable, Coroutine, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.psiu_hexa import BAD_CHECK, PsiuHexa
from psiu_broker.config import Configuration
from psiu_broker.conversation import Conversations
from psiu_broker.errors import CallCode, CallError
from psiu_broker.exchange import Exchange
from psiu_broker.frame import COMPLAINT, EVERYONE, Address, Frame, Malformed, Way
from psiu_broker.link import Link
from psiu_broker.messages import Answer, CallRequest, Command
from psiu_broker.profiles import HexaProfile, Profile, PsiuProfile, Request, Responder
from psiu_broker.profiles.hexa import NAK
from psiu_broker.profiles.psiu import COUNT, NAME, QUESTIONS, SHOW, listed
from psiu_broker.profiles.responder import listing, outcome, refusal
from psiu_broker.routing.router import SELF
from psiu_broker.routing.table import Route
from psiu_broker.routing.verdicts import ANSWERED, DELIVERED, REFUSED, Verdict

log = logging.getLogger(__name__)

DISCOVER: Final = "discover"
"""The broker's own command: ask on every link who is there and what they can do."""

ANSWER_DELAY_S: Final = 0.035
"""At most this late, and at random, is a question to everyone answered on a shared line (PSIU row 8; row 14: 40 ms)."""
SOUGHT_S: Final = 1.0
"""How long a call waits for an unknown robot to answer to its name."""
LISTENING_S: Final = 0.6
"""How long a discovery waits for robots to say their names."""
NAME_WITHIN_S: Final = 2.0
"""How long after our question a name is its answer."""
TASKS_KEPT: Final = 64
COMMANDS_ASKED: Final = 64
NAK_EVERY_S: Final = 0.1

_DROPPED: Final[dict[Verdict, tuple[CallCode, str]]] = {
    "no_route": ("unknown_robot", "nobody knows it"),
    "link_down": ("link_down", "its link is down"),
    "queue_full": ("busy", "the outbox of its link is full"),
    "expired": ("expired", "its link was busy for too long; nothing was sent"),
    "refused": ("refused", "its link cannot carry this"),
    "duplicate": ("refused", "the same frame was just heard from another sender"),
    "same_way": ("unknown_robot", "it is the broker itself"),
}


@dataclass(slots=True)
class _Asked:
    """When we asked for names somewhere, and who has answered."""

    at: float
    answered: set[Address] = field(default_factory=set)


@dataclass(slots=True)
class _Search:
    """The callers that wait for a robot to be heard."""

    found: asyncio.Event = field(default_factory=asyncio.Event)
    callers: int = 0


class Resident:
    """Implements `exchange.Resident`; `call` is what the bus offers to programs."""

    def __init__(
        self, configuration: Configuration, exchange: Exchange, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = Address.named(configuration.broker.name)
        self._robots = {Address.named(robot.name): robot for robot in configuration.robots.values()}
        self._exchange = exchange
        self._router = exchange.router
        self._clock = clock
        self._conversations = Conversations(self._send)
        self._responder = Responder(configuration.broker.name)
        self._profiles: dict[Address, Profile] = {}
        self._searches: dict[Address, _Search] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._naks: dict[Way, float] = {}
        self._asked: dict[Way, _Asked] = {}

    # exchange.Resident

    def answer(self, frame: Frame, way: Way, now: float) -> None:
        if self._conversations.heard(frame, now) or self._says_its_name(frame, way, now):
            return
        reply = self._responder.answer(frame, now, self._conversations.pinging(frame.source))
        if reply is None:
            return
        if frame.destination == EVERYONE and not self._exchange.links[way.link].adapter.datagrams:
            delay_s = random.uniform(0, ANSWER_DELAY_S)  # noqa: S311 - keeps robots apart, no secret
            asyncio.get_running_loop().call_later(delay_s, self._say, reply)
        else:
            self._exchange.send(reply, now)

    def translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        route = self._router.find(frame.destination)
        if route is None or len(self._tasks) >= TASKS_KEPT:
            return REFUSED
        told = listing(frame, str(route.robot), self.commands(route))
        if told is not None:
            self._exchange.send(told, now)
        else:
            self._start(self._ask_for(frame, route))
        return ANSWERED

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None:
        if malformed.reason == COMPLAINT:
            self._conversations.complained(way.link, way.peer)
            return
        nak = self._nak(self._exchange.links[way.link], malformed)
        if nak is not None and now - self._naks.get(way, -NAK_EVERY_S) >= NAK_EVERY_S:
            self._naks[way] = now
            self._exchange.send(nak, now)

    def asked_names(self, ways: Iterable[Way], now: float) -> None:
        self._asked = {way: asked for way, asked in self._asked.items() if now - asked.at < NAME_WITHIN_S}
        self._asked.update({way: _Asked(now) for way in ways})

    def undelivered(self, frame: Frame, verdict: Verdict) -> None:
        self._conversations.undelivered(frame, _dropped(frame.destination, verdict))

    def link_opened(self, link: Link, now: float) -> None:
        """Greet: ask who is there, so that robots are known before anybody needs them."""
        if not link.configuration.options.greet:
            return
        if link.codec.protocol == "psiu-ascii" and link.configuration.options.wildcard:
            self._exchange.ask_names(link, now)
        for route in self._router.robots():
            if route.way.link == link.name and route.protocol == "psiu-hexa" and len(self._tasks) < TASKS_KEPT:
                self._start(self._greet(route))

    def link_closed(self, link: Link, now: float) -> None:
        self._conversations.link_down(link.name, link.reason or "closed")

    # What the broker tells us.

    def robot_heard(self, route: Route) -> None:
        for address in route.addresses:
            search = self._searches.get(address)
            if search is not None:
                search.found.set()

    def robot_gone(self, route: Route) -> None:
        self._profiles.pop(route.robot, None)

    def commands(self, route: Route) -> Sequence[Command]:
        return self.profile(route).commands()

    def profile(self, route: Route) -> Profile:
        """What the robot of `route` understands; kept for as long as the robot is known."""
        profile = self._profiles.get(route.robot)
        if profile is None or profile.protocol != route.protocol:
            profile = self._profiles[route.robot] = self._make_profile(route)
        return profile

    # For programs.

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer:
        """Tell `robot` a command and return its answer, within `request.timeout_s` if it is given.

        Raises:
            CallError: there is no answer; its code says why.
        """
        begun = asyncio.get_running_loop().time()
        if robot == self.name or ((route := self._router.find(robot)) is not None and route.way == SELF):
            return await self._told(command, request)
        if route is None:
            route = await self._seek(robot, request.timeout_s)
        timeout_s = request.timeout_s
        if timeout_s is not None:
            timeout_s -= asyncio.get_running_loop().time() - begun
        return await self._call(route, command, request.parameters, timeout_s)

    async def tell(self, robot: Address, command: str, request: CallRequest) -> None:
        """Send a command and go on: what the robot answers is nobody's.

        Raises:
            CallError: it cannot be sent; its code says why.
        """
        route = self._router.find(robot) or await self._seek(robot, request.timeout_s)
        if route.way == SELF:
            await self._told(command, request)
            return
        wanted = self.profile(route).request(command, request.parameters)
        _, _, build = self._terms(route)
        error = self._send(build(wanted), wanted.timeout_s if request.timeout_s is None else request.timeout_s)
        if error is not None:
            raise error

    async def close(self) -> None:
        """End every call, and wait for what the broker itself was asking."""
        self._conversations.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # Inside.

    async def _call(self, route: Route, command: str, parameters: Sequence[Any], timeout_s: float | None) -> Answer:
        link = self._exchange.links[route.way.link]
        robot = route.robot
        if link.state != "open":
            raise CallError("link_down", f"{robot} is on link {link.name}, which is {link.state}: {link.reason}")
        options = link.configuration.options
        own, address, build = self._terms(route)
        return await self._conversations.call(
            robot=str(robot),
            own=own,
            address=address,
            profile=self.profile(route),
            build=build,
            command=command,
            parameters=parameters,
            link=link.name,
            peer=route.way.peer,
            timeout_s=timeout_s,
            retries=options.retries,
            busy_poll_s=options.busy_poll_s,
        )

    def _terms(self, route: Route) -> tuple[Address, Address, Callable[[Request], Frame]]:
        """Who we are to the robot, who it is to us, and how a request becomes a frame between us."""
        codec = self._exchange.links[route.way.link].configuration.codec
        if isinstance(codec, PsiuHexa.Options):
            address = next(address for address in route.addresses if address.is_numbered)
            own = Address.numbered(codec.local, codec.domain)
            return own, address, lambda request: psiu_hexa.packet(own, address, request.payload)
        address = route.robot
        return (
            self.name,
            address,
            lambda request: psiu_ascii.message(self.name, address, *request.payload.decode("ascii").split(" ")),
        )

    def _make_profile(self, route: Route) -> Profile:
        options = self._exchange.links[route.way.link].configuration.options
        if route.protocol == "psiu-hexa":
            robot = self._robots.get(route.robot)
            if robot is None:
                return HexaProfile({}, options.timeout_s)
            return HexaProfile(robot.nodes, options.timeout_s, robot.sensor_reply)
        return PsiuProfile(timeout_s=options.timeout_s)

    def _says_its_name(self, frame: Frame, way: Way, now: float) -> bool:
        """Whether `frame` answers our qualseunome: the first one from its sender where and soon after we asked.

        Any other is a question to us, and in the same words.
        """
        asked = self._asked.get(way)
        if frame.subject != NAME or frame.destination != self.name or asked is None:
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

    def _send(self, frame: Frame, patience_s: float) -> CallError | None:
        verdict = self._exchange.send(frame, self._clock(), patience_s)
        return None if verdict is None or verdict == DELIVERED else _dropped(frame.destination, verdict)

    def _say(self, frame: Frame) -> None:
        self._exchange.send(frame, self._clock())

    async def _told(self, command: str, request: CallRequest) -> Answer:
        """A call to the broker itself."""
        begun = asyncio.get_running_loop().time()
        values: list[str | int | float]
        match command, request.parameters:
            case "discover", []:
                values = list(await self._discover())
            case "qualseunome", []:
                values = [str(self.name)]
            case "quantoscomandos", []:
                values = [len(OWN_COMMANDS)]
            case "exibecomando", [int(index)] if 1 <= index <= len(OWN_COMMANDS):
                shown = OWN_COMMANDS[index - 1]
                values = [shown.name, shown.ints, shown.floats, shown.chars]
            case _:
                names = ", ".join(each.name for each in OWN_COMMANDS)
                raise CallError("unknown_command", f"{self.name} is the broker; it understands {names}")
        return Answer(values=values, elapsed_ms=_elapsed_ms(begun))

    async def _seek(self, robot: Address, timeout_s: float | None) -> Route:
        """Ask for an unknown robot by its name, and wait a moment for it.

        Raises:
            CallError: unknown_robot, or link_down where it was on a link that went down.
        """
        if not robot.is_numbered and robot != EVERYONE:
            search = self._searches.setdefault(robot, _Search())
            search.callers += 1
            try:
                if search.callers == 1:
                    self._exchange.ask_for(robot, self._clock())
                async with asyncio.timeout(min(SOUGHT_S, timeout_s or SOUGHT_S)):
                    await search.found.wait()
            except TimeoutError:
                pass
            finally:
                search.callers -= 1
                if not search.callers:
                    del self._searches[robot]
            route = self._router.find(robot)
            if route is not None:
                return route
        departed = self._router.table.departed(robot)
        if departed is None:
            raise CallError("unknown_robot", f"no robot {robot} is known, and none answered to that name")
        ago_s = self._clock() - departed.at
        link = self._exchange.links[departed.link]
        if link.state == "open":
            raise CallError(
                "unknown_robot", f"{robot} was last heard on {link.name}; it was given up {ago_s:.0f} s ago"
            )
        raise CallError("link_down", f"{robot} was on {link.name}, which went down {ago_s:.0f} s ago: {link.reason}")

    async def _discover(self) -> list[str]:
        """Ask on every link who is there, then each robot for its commands; the names of all robots known."""
        now = self._clock()
        for link in self._exchange.links.values():
            if link.state == "open" and link.codec.protocol == "psiu-ascii":
                self._exchange.ask_names(link, now)
        await asyncio.sleep(LISTENING_S)
        routes = self._router.robots()
        await asyncio.gather(*(self._inquire(route) for route in routes))
        return [str(route.robot) for route in routes if route.heard_at is not None]

    async def _inquire(self, route: Route) -> None:
        """Learn a robot's commands; a robot that does not answer has none for now."""
        try:
            profile = self.profile(route)
            if not isinstance(profile, PsiuProfile):
                await self._call(route, "ping", [], None)
                return
            count = await self._call(route, COUNT, [], None)
            total = next((value for value in count.values if isinstance(value, int)), 0)
            for index in range(1, min(total, COMMANDS_ASKED) + 1):
                shown = await self._call(route, SHOW, [index], None)
                command = listed(shown.values)
                if command is not None:
                    profile.learn(command)
        except CallError as error:
            log.info("asking %s for its commands: %s", route.robot, error)

    async def _greet(self, route: Route) -> None:
        try:
            await self._call(route, "ping", [], None)
        except CallError as error:
            log.info("greeting %s: %s", route.robot, error)

    async def _ask_for(self, frame: Frame, route: Route) -> None:
        """Do for the sender of `frame`, in words, what a robot of bytes is told; answer in the robot's name."""
        word, *words = frame.payload.decode("ascii").split(" ")
        name = str(route.robot)
        try:
            answer = await self._call(route, word, [each for each in words if each], None)
        except CallError as error:
            log.info("%s told %s %s: %s", frame.source, name, word, error)
            self._say(refusal(frame, name))
        else:
            self._say(outcome(frame, name, answer))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


OWN_COMMANDS: Final = (*QUESTIONS, Command(name=DISCOVER))


def _dropped(robot: Address, verdict: Verdict) -> CallError:
    code, text = _DROPPED.get(verdict, ("refused", verdict))
    return CallError(code, f"{robot}: {text}")


def _elapsed_ms(begun: float) -> float:
    return round((asyncio.get_running_loop().time() - begun) * 1000, 3)
