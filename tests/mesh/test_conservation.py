"""No frame is lost unseen: not in a broker, not on its links, and not from broker to broker."""

from collections import Counter
from collections.abc import Callable
from typing import Any

from balanced import assert_balanced
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from mesh.simulated import RADIO, WIFI, Simulation, Station, wire

from psiu_broker.codecs import psiu_ascii
from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.link import Link
from psiu_broker.mesh.envelope import Envelope, pack, unpack
from psiu_broker.messages import RawFrame
from psiu_broker.routing.outbox import LANES
from psiu_broker.routing.policy import Policy, Rule

LINKS = (RADIO, WIFI)
BROKERS = ("base1", "base2", "base3")
ROBOTS = ("MNERIM", "BETA", "PC", "GHOST", "??", *BROKERS[:2])
TIGHT = {
    "queue_frames": 3,
    "max_age_s": 0.5,
    "question_max_age_s": 1.0,
    "route_age_s": 20.0,
    "newest_wins": ["gira*"],
    "max_frames_s": 20.0,
    "limits": {"parafrente": {"frames_s": 2.0}},
    "new_names_per_minute": 4,
}
"""Everything that a frame can come to grief by."""


CHANGES: dict[str, Callable[[Envelope], Envelope | bytes]] = {
    "once more": lambda it: it,
    "from another": lambda it: it,
    "cut short": lambda it: pack(it)[:-9],
    "too old": lambda it: it._replace(age_ms=60_000, sequence=it.sequence + 1),
    "ahead of others": lambda it: it._replace(sequence=it.sequence + 3),
    "far ahead": lambda it: it._replace(sequence=it.sequence + 1000),
    "without a place": lambda it: it._replace(sequence=0),
    "of a former life": lambda it: it._replace(epoch=it.epoch - 1),
    "for a former life": lambda it: it._replace(to_epoch=it.to_epoch ^ 1),
    "by a clock that is ahead": lambda it: it._replace(sent_us=2**64 - 1, sequence=it.sequence + 1),
    "by a clock that is behind": lambda it: it._replace(sent_us=0, sequence=it.sequence + 1),
}
"""What an envelope can come as."""


class Witness:
    """Told of every frame's verdict on the bus, it keeps books of its own."""

    listened = raw_listened = True

    def __init__(self) -> None:
        self.fates: dict[str, Counter[str]] = {}

    def publish(self, frame: Frame, way: Way, received: float) -> None: ...

    def tapped(self, link: str) -> bool:
        return True

    def publish_raw(self, raw: RawFrame) -> None:
        if raw.direction == "in" and raw.source is not None:
            self.fates.setdefault(raw.source, Counter())[raw.verdict] += 1


class NothingIsLostUnseen(RuleBasedStateMachine):
    """Whatever robots, links, limits, brokers and the network between them do, and at every moment."""

    brokers = st.sampled_from((*BROKERS, *BROKERS[:2]))
    links = st.sampled_from(LINKS)
    robots = st.sampled_from(ROBOTS)
    words = st.sampled_from(
        (
            ("qualseunome",),
            ("parafrente", "100"),
            ("giradireita", "9"),
            ("giradireita", "10"),
            ("pare",),
            ("parafrente", "sucesso"),
            ("garra", "45"),
        )
    )

    @initialize(seed=st.integers(0, 3), few=st.booleans())
    def begin(self, seed: int, few: bool) -> None:
        self.few = few
        self.ever_stopped = False
        self.losing: frozenset[str] = frozenset()
        self.came: Counter[int] = Counter()
        self.simulation = Simulation((), seed=seed, options=TIGHT)
        self.simulation.loses = lambda kind, *_: kind in self.losing
        for name in BROKERS[:2]:
            self._start(name)
        for name, link, robot in (("base1", RADIO, "MNERIM"), ("base1", WIFI, "PC"), ("base2", RADIO, "BETA")):
            self.a_robot_speaks(name, link, robot, "base1", ("qualseunome",))
        self.simulation.run(1.0)

    def _start(self, name: str) -> None:
        station = self.simulation.start(name)
        station.exchange.bus = Witness()
        take, at = station.mesh.frame_came, id(station)

        def frame_came(*what: Any) -> None:
            self.came[at] += 1
            take(*what)

        station.mesh.frame_came = frame_came  # type: ignore[method-assign]
        if self.few:
            station.router.books._capacity = station.router.books._sweep_at = 4
        for link in station.exchange.links.values():
            link._watch_silence = lambda *_: None  # type: ignore[method-assign]  # `time_passes` sees to it

    def _there(self, name: str) -> Station | None:
        station = self.simulation.stations.get(name)
        return None if station is None or station.stopped else station

    @rule(name=brokers, link=links, source=robots, destination=robots, words=words)
    def a_robot_speaks(self, name: str, link: str, source: str, destination: str, words: tuple[str, ...]) -> None:
        station = self._there(name)
        if station is not None:
            station.exchange.links[link].received(wire(source, destination, *words), None)

    @rule(source=robots, destination=robots, words=words)
    def a_robot_is_heard_by_all(self, source: str, destination: str, words: tuple[str, ...]) -> None:
        for name in BROKERS:
            self.a_robot_speaks(name, RADIO, source, destination, words)

    @rule(
        name=brokers,
        link=links,
        serial=st.integers(0, 20),
        destination=st.sampled_from(("MNERIM", "??", "GHOST")),
        words=st.sampled_from((("parafrente", "1"), ("pare",))),
    )
    def a_stranger_speaks(self, name: str, link: str, serial: int, destination: str, words: tuple[str, ...]) -> None:
        self.a_robot_speaks(name, link, f"S{serial}", destination, words)

    @rule(name=brokers, destination=robots, words=words, patience=st.floats(0, 1))
    def a_broker_speaks(self, name: str, destination: str, words: tuple[str, ...], patience: float) -> None:
        station = self._there(name)
        if station is not None:
            frame = psiu_ascii.message(Address.named(name), Address.named(destination), *words)
            station.exchange.send(frame, station.now, patience)

    @rule(name=brokers, link=links, words=words)
    def a_broker_speaks_in_a_robots_stead(self, name: str, link: str, words: tuple[str, ...]) -> None:
        station = self._there(name)
        if station is not None:
            frame = psiu_ascii.message(Address.named("BETA"), Address.named("PC"), *words)
            station.exchange.send_by(frame, Way(link), station.now)

    @rule(name=brokers, link=links, noise=st.binary(min_size=1, max_size=30))
    def noise_arrives(self, name: str, link: str, noise: bytes) -> None:
        station = self._there(name)
        if station is not None:
            station.exchange.links[link].received(noise, None)

    @rule(name=brokers, link=links)
    def a_link_goes_or_comes(self, name: str, link: str) -> None:
        station = self._there(name)
        if station is None:
            return
        if station.exchange.links[link].state == "open":
            station.unplug(link)
        else:
            station.plug(link)

    @rule(name=brokers, link=links, full=st.booleans())
    def a_wire_fills_or_has_room(self, name: str, link: str, full: bool) -> None:
        station = self._there(name)
        if station is not None:
            station.antennas[link].full = full
            if not full and station.exchange.links[link].state == "open":
                station.exchange.links[link].writable()

    @rule(name=brokers, destination=robots, words=words, unplugged=st.booleans())
    def a_wire_has_no_room_for_a_frame(
        self, name: str, destination: str, words: tuple[str, ...], unplugged: bool
    ) -> None:
        for link in LINKS:
            self.a_wire_fills_or_has_room(name, link, full=True)
        self.a_robot_speaks(name, WIFI, "PC", destination, words)
        if unplugged:
            self.a_link_goes_or_comes(name, RADIO)

    @rule(name=brokers, denied=st.sampled_from(("garra", "parafrente", None)))
    def the_policy_is(self, name: str, denied: str | None) -> None:
        station = self._there(name)
        if station is not None:
            station.router.obey(Policy([Rule(allow=False, command=(denied,))] if denied else []))

    @rule(name=brokers, robots=st.sets(st.sampled_from(ROBOTS[:2])))
    def robots_must_be_left_alone(self, name: str, robots: set[str]) -> None:
        station = self._there(name)
        if station is not None:
            station.exchange.alone = set(map(Address.named, robots))

    @rule(losing=st.sets(st.sampled_from(("frame", "beat", "notice", "token", "untoken")), max_size=2))
    def the_network_loses(self, losing: set[str]) -> None:
        self.losing = frozenset(losing)

    @rule(sender=brokers, to=brokers, lane=st.sampled_from(sorted(LANES)), data=st.binary(max_size=80))
    def what_is_no_envelope_comes(self, sender: str, to: str, lane: int, data: bytes) -> None:
        self.simulation.put_frame(sender, to, lane, data)

    @rule(age=st.integers(0, 5), how=st.sampled_from(sorted(CHANGES)), anyone=brokers)
    def an_envelope_comes_that_is_not_as_it_left(self, age: int, how: str, anyone: str) -> None:
        self.a_robot_speaks("base1", WIFI, "PC", "BETA", ("parafrente", str(age)))
        frames = self.simulation.frames
        if frames:
            sender, to, lane, data = frames[-1 - age % len(frames)]
            envelope = unpack(data)
            assert envelope is not None
            changed = CHANGES[how](envelope)
            self.simulation.put_frame(
                anyone if how == "from another" else sender,
                to,
                lane,
                changed if isinstance(changed, bytes) else pack(changed),
            )

    @rule(name=brokers, refuses=st.booleans())
    def the_bus_takes_frames_or_does_not(self, name: str, refuses: bool) -> None:
        if self._there(name) is not None:
            self.simulation.session(name).refuses = refuses

    @rule(cut=st.booleans())
    def the_network_is_cut_or_healed(self, cut: bool) -> None:
        if cut:
            self.simulation.partition(BROKERS[:1], BROKERS[1:])
        else:
            self.simulation.heal()

    @rule(name=brokers, how=st.sampled_from(("kill", "leave", "reopen", "stop", "resume", "start")))
    def a_broker_comes_or_goes(self, name: str, how: str) -> None:
        station = self.simulation.stations.get(name)
        if how == "start" and station is None:
            self._start(name)
        elif how == "stop" and station is not None:
            self.ever_stopped = True
            self.simulation.stop(name)
        elif station is not None and station.stopped == (how == "resume") and how != "start":
            getattr(self.simulation, how)(name)

    @rule(seconds=st.sampled_from((0.004, 0.1, 0.6, 3.0, 25.0)))
    def time_passes(self, seconds: float) -> None:
        self.simulation.run(seconds)
        for station in self.simulation.stations.values():
            for link in station.exchange.links.values():
                _fall_silent(link)

    @invariant()
    def the_books_of_every_broker_balance(self) -> None:
        for station in (*self.simulation.stations.values(), *self.simulation.former):
            assert_balanced(station.exchange)

    @invariant()
    def the_books_of_every_robot_are_those_of_who_heard_each_verdict(self) -> None:
        for station in () if self.few else self.simulation.stations.values():
            witness = station.exchange.bus
            assert isinstance(witness, Witness)
            # Of what a broker asks of itself, and says in a robot's stead, the verdict is not told.
            for told in station.router.books.told():
                if str(told.robot) not in (station.name, "BETA", "None"):
                    seen = witness.fates.get(str(told.robot), Counter())
                    assert seen == +Counter({"delivered": told.delivered, "answered": told.answered, **told.dropped})

    @invariant()
    def nothing_waits_for_a_link_that_is_down(self) -> None:
        for station in self.simulation.stations.values():
            assert all(link.state == "open" or not link.outbox.size for link in station.exchange.links.values())

    @invariant()
    def whatever_comes_from_a_broker_is_in_the_books_at_once(self) -> None:
        for station in (*self.simulation.stations.values(), *self.simulation.former):
            assert station.exchange.accounts[MESH].arrived == self.came[id(station)]

    @invariant()
    def a_broker_says_that_it_sent_what_the_bus_took_and_nothing_else(self) -> None:
        for station in self.simulation.stations.values():
            mesh = station.mesh
            sent = sum(each.frames_out for each in (*mesh.neighbours, *mesh._former.values()))
            assert sent == self.simulation.taken[station.name, mesh.epoch]

    @invariant()
    def no_frame_comes_from_nowhere(self) -> None:
        assert self._relayed() <= self.simulation.sent["frame"] - self.simulation.lost["frame"]

    def teardown(self) -> None:
        """Once everybody has had the time, every frame has come that one broker gave another and the network took."""
        if not hasattr(self, "simulation"):
            return
        self.simulation.run(1.0)
        if not self.ever_stopped:
            assert self._relayed() == self.simulation.sent["frame"] - self.simulation.lost["frame"]

    def _relayed(self) -> int:
        stations = (*self.simulation.stations.values(), *self.simulation.former)
        return sum(station.exchange.accounts[MESH].arrived for station in stations)


def _fall_silent(link: Link) -> None:
    for end in list(link._ends.values()):
        link._silence(end)


TestNothingIsLostUnseen = NothingIsLostUnseen.TestCase
TestNothingIsLostUnseen.settings = settings(max_examples=40, stateful_step_count=40, deadline=None)
