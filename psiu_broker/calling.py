"""Calls to robots for whoever makes them: where the robot is, what it understands, and the broker's own commands."""

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final, NamedTuple

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.config import Configuration
from psiu_broker.config.tables import FailsafeConfiguration
from psiu_broker.conversation import Conversations, Robot, Traffic
from psiu_broker.errors import CallCode, CallError
from psiu_broker.exchange import Exchange
from psiu_broker.failsafe import Failsafe
from psiu_broker.frame import EVERYONE, MESH, Address, Frame, Way
from psiu_broker.messages import Answer, CallRequest, Command
from psiu_broker.profiles import Description, Profile, PsiuProfile, Request
from psiu_broker.profiles.psiu import COUNT, QUESTIONS, SHOW, canonical, listed, typed
from psiu_broker.profiles.rarely import Rarely
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.routing.router import SELF
from psiu_broker.routing.table import Route
from psiu_broker.routing.verdicts import DELIVERED, LINK_DOWN, Verdict

log = logging.getLogger(__name__)

DISCOVER: Final = "discover"
"""The broker's own command: ask on every link who is there and what they can do."""
OWN_COMMANDS: Final = (*QUESTIONS, Command(name=DISCOVER))

SOUGHT_S: Final = 1.0
"""How long a call waits for an unknown robot to answer to its name."""
LISTENING_S: Final = 0.6
"""How long a discovery waits for robots to say their names."""
DISCOVERY_S: Final = 30.0
"""How long a discovery may take where nobody says."""
COMMANDS_ASKED: Final = 64
GREETINGS_AT_ONCE: Final = 8
GREET_EVERY_S: Final = 1.0
"""In the long run, for one robot that wants to be greeted without end."""
_PLAIN: Final = CallRequest()
_MOMENT_S: Final = 0.001
"""An outbox reads its clock a moment after a call does."""

_DROPPED: Final[dict[Verdict, tuple[CallCode, str]]] = {
    "no_route": ("unknown_robot", "nobody knows it"),
    "link_down": ("link_down", "its link is down"),
    "queue_full": ("busy", "the outbox of its link is full"),
    "superseded": ("expired", "a newer command for it took its place before it was sent"),
    "expired": ("expired", "its link was busy for too long; nothing was sent"),
    "refused": ("refused", "its link cannot carry this"),
    "duplicate": ("refused", "the same frame was just heard from another sender"),
    "same_way": ("unknown_robot", "it is the broker itself"),
}


class Caller(NamedTuple):
    """Who wants something of a robot, as the policy knows him, and how he reaches the broker."""

    source: Address
    way: Way


@dataclass(slots=True)
class _Search:
    """The callers that wait for a robot to be heard."""

    found: asyncio.Event = field(default_factory=asyncio.Event)
    callers: int = 0


class Calling:
    """Knows how to reach each robot; implements `conversation.Links`."""

    def __init__(
        self, configuration: Configuration, exchange: Exchange, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = Address.named(configuration.broker.name)
        self.conversations = Conversations(self)
        self._robots = {Address.named(robot.name): robot for robot in configuration.robots.values()}
        self._exchange = exchange
        exchange.alone = self.conversations.alone
        self._router = exchange.router
        self._clock = clock
        self._profiles: dict[Address, Profile] = {}
        self._searches: dict[Address, _Search] = {}
        self._greetings = Rarely()
        self._greeted_later: set[Address] = set()
        self._ungreeted: set[Address] = set()
        self.failsafe = Failsafe(configuration, self._stop, self._profile_of, self._heard_at, clock)
        self.settling_s: Callable[[], float] = lambda: 0.0
        """How long another broker may take to say that it heard a robot, too, that was searched for."""

    async def call(
        self,
        robot: Address,
        command: str,
        request: CallRequest,
        asked_at: float | None = None,
        by: Caller | None = None,
    ) -> Answer:
        """Tell `robot` a command and return its answer, within `request.timeout_s` if it is given.

        It is not sent if it was `asked_at` a time longer ago than a frame may wait for the robot's link, nor where the
        policy denies it: to `by`, or to the broker itself, as which programs on Zenoh call.

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
        fresh_s = inf if asked_at is None else self._fresh_s(route, command, asked_at)
        request = request.model_copy(update={"timeout_s": timeout_s})
        return await self.ask(route, command, request, fresh_s, by)

    async def tell(
        self,
        robot: Address,
        command: str,
        request: CallRequest,
        asked_at: float | None = None,
        by: Caller | None = None,
    ) -> None:
        """Send a command and go on: what the robot answers is nobody's. `asked_at`, `by`: as in `call`; default: now.

        Raises:
            CallError: it cannot be sent; its code says why.
        """
        begun = asyncio.get_running_loop().time()
        asked_at = self._clock() if asked_at is None else asked_at
        route = self._router.find(robot) or await self._seek(robot, request.timeout_s)
        if route.way == SELF:
            await self._told(command, request)
            return
        if route.way.link == MESH:
            raise _elsewhere(route)
        self._permit(route, command, request.parameters, by)
        fresh_s = self._fresh_s(route, command, asked_at)
        if request.timeout_s is not None:
            fresh_s = min(fresh_s, request.timeout_s - (asyncio.get_running_loop().time() - begun))
        robot_there = self._robot(route, request.program)
        await self.conversations.tell(robot_there, command, request.parameters, fresh_s=fresh_s)

    async def ask(
        self,
        route: Route,
        command: str,
        request: CallRequest = _PLAIN,
        fresh_s: float = inf,
        by: Caller | None = None,
    ) -> Answer:
        """Tell the robot of `route` a command, as `Conversations.call` does, and return its answer; `by` as in `call`.

        Raises:
            CallError: there is no answer; its code says why.
        """
        if route.way.link == MESH:
            raise _elsewhere(route)
        link = self._exchange.links[route.way.link]
        if link.state != "open":
            raise CallError("link_down", f"{route.robot} is on link {link.name}, which is {link.state}: {link.reason}")
        told = _listing(command, request.parameters, route, self.commands(route))
        if told is not None and route.protocol != psiu_ascii.PROTOCOL:
            return told
        self._permit(route, command, request.parameters, by)
        options, configured = link.configuration.options, self._robots.get(route.robot)
        try:
            return await self.conversations.call(
                self._robot(route, request.program),
                command,
                request.parameters,
                timeout_s=request.timeout_s,
                fresh_s=fresh_s,
                retries=options.retries if request.retries is None else request.retries,
                busy_poll_s=options.busy_poll_s,
                repeatable=configured is not None and command in configured.repeatable,
            )
        finally:
            if route.robot in self._ungreeted:
                self.greet(route)

    def commands(self, route: Route) -> Sequence[Command]:
        return self._profile(route).commands()

    def greet(self, route: Route) -> None:
        """Tell the robot what its profile greets it with, but not before it may hear it."""
        robot = self._robot(route)
        if robot.address in self.conversations.alone:
            self._ungreeted.add(route.robot)
            return
        self._ungreeted.discard(route.robot)
        try:
            greeting = robot.profile.greeting()
        except Exception:  # it must not break the link on which the robot was heard
            log.exception("greeting %s", robot.name)
            return
        for request in greeting:
            # A greeting moves nobody, whatever it looks like.
            self._exchange.send(robot.build(request._replace(question=True)), self._clock())

    def greet_again(self, route: Route) -> None:
        """As `greet`, because of what was heard of the robot: at once, but later where that comes again and again."""
        if self._greetings.may(route.robot, self._clock(), GREET_EVERY_S, GREETINGS_AT_ONCE):
            self.greet(route)
        elif route.robot not in self._greeted_later:
            self._greeted_later.add(route.robot)
            asyncio.get_running_loop().call_later(GREET_EVERY_S, self._greet_late, route.robot)

    def _greet_late(self, robot: Address) -> None:
        self._greeted_later.discard(robot)
        route = self._router.find(robot)
        if route is not None and route.way.link in self._exchange.links:
            self.greet(route)

    async def mend(self, route: Route) -> None:
        """Bring the robot out of what it was cut off in, then greet it.

        Raises:
            CallError: it had no turn.
        """
        await self.conversations.mend(self._robot(route))
        self.greet(route)

    def learn(self, frame: Frame) -> None:
        """Take note of what a robot says, whether it answers a call or not."""
        route = self._router.find(frame.source)
        if route is None or route.way.link in (MESH, SELF.link) or route.protocol != frame.protocol:
            return
        if self._profile(route).learn(frame):
            self.greet_again(route)

    def describe(self, frame: Frame) -> Description | None:
        """What the profile of the robot that sent `frame`, or is to have it, reads there; None where nobody knows."""
        for address in (frame.source, frame.destination):
            route = self._router.find(address)
            if route is not None and route.protocol == frame.protocol and route.way.link not in (MESH, SELF.link):
                return self._profile(route).describe(frame)
        return None

    def robot_heard(self, route: Route) -> None:
        for address in route.addresses:
            search = self._searches.get(address)
            if search is not None:
                search.found.set()

    def robot_gone(self, route: Route) -> None:
        self._profiles.pop(route.robot, None)
        self._ungreeted.discard(route.robot)

    def undelivered(self, frame: Frame, verdict: Verdict) -> None:
        self._note_unsent(frame)
        self.conversations.undelivered(frame, self._dropped(frame.destination, verdict))

    # conversation.Links

    def send(self, frame: Frame, patience_s: float) -> CallError | None:
        verdict = self._exchange.send(frame, self._clock(), patience_s)
        if verdict is None or verdict == DELIVERED:
            return None
        self._note_unsent(frame)
        return self._dropped(frame.destination, verdict)

    def expire(self, link: str) -> None:
        self._exchange.links[link].expire(self._clock() + _MOMENT_S)

    def traffic(self, link: str) -> Traffic:
        found = self._exchange.links[link]
        if found.adapter.datagrams:
            return Traffic(found.frames_out, found.last_sent)
        last_heard = -inf if found.last_heard is None else found.last_heard
        return Traffic(found.frames_out, max(found.last_sent, last_heard), found.frames_in)

    # Inside.

    def _permit(self, route: Route, command: str, parameters: Sequence[Any], by: Caller | None) -> None:
        """Raise CallError where the policy keeps the command from the robot, by whichever of its names it is called."""
        policy = self._router.policy
        if policy is None:
            return
        robot = self._robot(route)
        try:
            request = robot.profile.request(command, parameters)
        except CallError:
            return  # which says why better
        if request.question:
            return
        words = {command, request.subject, *policy.words(_frame(robot.own, robot.address, request, route.protocol))}
        for each in robot.profile.commands():
            names = {each.name, *each.aliases}
            if not names.isdisjoint(words):
                words |= names
        source, way = by or Caller(self.name, SELF)
        rule = policy.denial_of(source, route.robot, words, way)
        if rule is not None:
            raise CallError("refused", f"{source} may not tell {route.robot} {command}: {rule}")

    def _fresh_s(self, route: Route, command: str, asked_at: float) -> float:
        """How long `command`, asked for then, may still wait before it is too late for the robot."""
        link = self._exchange.links.get(route.way.link)
        return inf if link is None else link.configuration.options.longest_wait_s(command) - (self._clock() - asked_at)

    def _note_unsent(self, frame: Frame) -> None:
        profile = self._profile_of(frame.destination)
        if profile is not None:
            profile.unsent(frame)

    def _dropped(self, robot: Address, verdict: Verdict) -> CallError:
        code, text = _DROPPED.get(verdict, ("refused", verdict))
        route = self._router.find(robot)
        link = None if route is None else self._exchange.links.get(route.way.link)
        reason = f" ({link.reason})" if verdict == LINK_DOWN and link is not None and link.reason else ""
        return CallError(code, f"{robot}: {text}{reason}")

    def _robot(self, route: Route, program: str | None = None) -> Robot:
        """Who we are to the robot, who it is to us, and how a request, of `program`'s, becomes a frame between us."""
        name, profile, way = str(route.robot), self._profile(route), route.way
        codec = self._exchange.links[way.link].configuration.codec
        own = Address.numbered(codec.local, codec.domain) if isinstance(codec, PsiuHexa.Options) else self.name
        address = next((each for each in route.addresses if each.is_numbered), route.robot)

        ward = self.failsafe.ward(route.robot)

        def build(request: Request) -> Frame:
            frame = _frame(own, address, profile.sending(request), route.protocol)
            if ward is not None:
                self.failsafe.offered(ward, frame, request, program)
            return frame

        return Robot(name, own, address, profile, build, way.link, way.peer)

    def _profile(self, route: Route) -> Profile:
        """What the robot of `route` understands; kept for as long as the robot is known."""
        profile = self._profiles.get(route.robot)
        if profile is None or profile.protocol != route.protocol:
            profile = self._profiles[route.robot] = self._make_profile(route)
        return profile

    def _profile_of(self, robot: Address) -> Profile | None:
        route = self._router.find(robot)
        return None if route is None or route.way.link in (MESH, SELF.link) else self._profile(route)

    def _heard_at(self, robot: Address) -> float | None:
        route = self._router.find(robot)
        return None if route is None else route.heard_at

    async def _stop(self, robot: Address, options: FailsafeConfiguration, timeout_s: float) -> Answer:
        """As `failsafe.Stop`."""
        route = self._router.find(robot)
        if route is None or route.way.link in (MESH, SELF.link):
            raise CallError("unknown_robot", f"{robot} is no robot of this broker now")
        link = self._exchange.links[route.way.link]
        if link.state != "open":
            raise CallError("link_down", f"link {link.name} is {link.state}: {link.reason}")
        return await self.conversations.stop(
            self._robot(route),
            options.command,
            options.parameters,
            timeout_s=timeout_s,
            retries=link.configuration.options.retries,
        )

    def _make_profile(self, route: Route) -> Profile:
        link = self._exchange.links[route.way.link].configuration
        profile = PROTOCOLS[route.protocol].profile
        robot = self._robots.get(route.robot)
        options = robot.options if robot is not None else profile.Options()
        return profile.make(link.codec, options, link.options.timeout_s, datagrams=link.adapter.datagrams)

    async def _told(self, command: str, request: CallRequest) -> Answer:
        """A call to the broker itself."""
        begun = asyncio.get_running_loop().time()
        values: list[str | int | float]
        match command, request.parameters:
            case "discover", []:
                values = list(await self._discover(request.timeout_s or DISCOVERY_S))
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
        elapsed_ms = round((asyncio.get_running_loop().time() - begun) * 1000, 3)
        return Answer(values=values, elapsed_ms=elapsed_ms)

    async def _seek(self, robot: Address, timeout_s: float | None) -> Route:
        """Ask for an unknown robot, and wait a moment for it.

        Raises:
            CallError: unknown_robot, or link_down where it was on a link that went down.
        """
        if robot != EVERYONE:
            search = self._searches.setdefault(robot, _Search())
            search.callers += 1
            try:
                if search.callers > 1 or self._exchange.ask_for(robot, self._clock()):
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
                await asyncio.sleep(self.settling_s())  # who owns it, of two that hear it, only one commands it
                route = self._router.find(robot)
            if route is not None:
                return route
        departed = self._router.table.departed(robot)
        if departed is None:
            raise CallError("unknown_robot", f"no robot {robot} is known, and none answered to that name")
        ago_s = self._clock() - departed.at
        if departed.link == MESH:
            raise CallError("unknown_robot", f"{robot} was with another broker until {ago_s:.0f} s ago")
        link = self._exchange.links[departed.link]
        if link.state == "open":
            raise CallError(
                "unknown_robot", f"{robot} was last heard on {link.name}; it was given up {ago_s:.0f} s ago"
            )
        raise CallError("link_down", f"{robot} was on {link.name}, which went down {ago_s:.0f} s ago: {link.reason}")

    async def _discover(self, timeout_s: float) -> list[str]:
        """Ask where everyone may be asked who is there, then each robot for its commands.

        Returns:
            The names of all robots heard, of whom as much is known as could be learned in `timeout_s`.
        """
        now = self._clock()
        try:
            async with asyncio.timeout(timeout_s):
                for link in self._exchange.links.values():
                    wildcard = link.configuration.options.wildcard and link.codec.protocol == "psiu-ascii"
                    if link.state == "open" and wildcard:
                        self._exchange.ask_names(link, now, told=True)
                await asyncio.sleep(LISTENING_S)
                await asyncio.gather(*(self._inquire(route) for route in self._router.robots()))
        except TimeoutError:
            log.info("discovery: not every robot told its commands within %s s", timeout_s)
        return [str(route.robot) for route in self._router.robots() if route.heard_at is not None]

    async def _inquire(self, route: Route) -> None:
        """Learn a robot's commands; a robot that does not answer has none for now."""
        try:
            profile = self._profile(route)
            if not isinstance(profile, PsiuProfile):
                if route.protocol == psiu_hexa.PROTOCOL:
                    await self.ask(route, "ping")
                return
            count = await self.ask(route, COUNT)
            total = next((value for value in count.values if isinstance(value, int)), 0)
            for index in range(1, min(total, COMMANDS_ASKED) + 1):
                shown = await self.ask(route, SHOW, CallRequest(parameters=[index]))
                command = listed(shown.values)
                if command is not None:
                    profile.learn_command(command)
        except CallError as error:
            log.info("asking %s for its commands: %s", route.robot, error)


def _listing(command: str, parameters: Sequence[Any], route: Route, commands: Sequence[Command]) -> Answer | None:
    """What the robot of `route`, which has no words, would answer to a question about its name and its commands."""
    match canonical(command), [typed(each) if isinstance(each, str) else each for each in parameters]:
        case "qualseunome", []:
            return Answer(values=[str(route.robot)], elapsed_ms=0.0)
        case "quantoscomandos", []:
            return Answer(values=[len(commands)], elapsed_ms=0.0)
        case "exibecomando", [int(index)]:
            if not 1 <= index <= len(commands):
                return Answer(status="falha", elapsed_ms=0.0)
            shown = commands[index - 1]
            return Answer(values=[shown.name, shown.ints, shown.floats, shown.chars], elapsed_ms=0.0)
        case _:
            return None


def _frame(own: Address, robot: Address, request: Request, protocol: str) -> Frame:
    if protocol == psiu_ascii.PROTOCOL:
        return psiu_ascii.message(own, robot, *request.payload.decode("ascii").split(" "))
    return Frame(own, robot, request.subject, request.payload, protocol)


def _elsewhere(route: Route) -> CallError:
    return CallError("unknown_robot", f"{route.robot} is with broker {route.way.peer}")
