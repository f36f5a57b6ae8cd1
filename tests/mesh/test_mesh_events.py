"""Whatever happens, and in whatever order: after a while of quiet all brokers agree, and nothing came twice."""

from itertools import count

from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from mesh.simulated import RADIO, WIFI, Simulation

BROKERS = "ABCD"
ROBOTS = ("MNERIM", "OUTRO")

PHASES = [Phase.explicit, Phase.generate]
"""Shrinking takes minutes here: leave it to who looks into a failure."""

brokers = st.sampled_from(BROKERS)
robots = st.sampled_from(ROBOTS)
kinds = st.sampled_from(["token", "untoken", "beat", "notice", "frame"])
pauses = st.sampled_from([0.0, 0.01, 0.1, 0.3, 0.5, 1.0, 2.5])

events = st.one_of(
    st.tuples(st.just("roam"), robots, brokers),
    st.tuples(st.just("hear"), robots, st.sets(brokers, min_size=1, max_size=2)),
    st.tuples(st.just("command"), robots, brokers),
    st.tuples(st.just("partition"), st.sets(brokers, min_size=1, max_size=3)),
    st.tuples(st.just("cut"), brokers, brokers),
    st.tuples(st.just("heal")),
    st.tuples(st.just("kill"), brokers),
    st.tuples(st.just("leave"), brokers),
    st.tuples(st.just("start"), brokers),
    st.tuples(st.just("reopen"), brokers),
    st.tuples(st.just("stop"), brokers),
    st.tuples(st.just("resume"), brokers),
    st.tuples(st.just("lose"), kinds, st.integers(2, 4)),
    st.tuples(st.just("quality"), brokers, st.integers(0, 10)),
)


class Storm:
    """Lets events happen, as far as they can, and knows where the robots are."""

    def __init__(self, seed: int, delay_s: float = 0.005) -> None:
        self.mesh = Simulation(BROKERS, seed=seed, delay_s=delay_s)
        self.mesh.run(1)
        self.places = dict.fromkeys(ROBOTS, "A")
        self.said: list[tuple[bytes, int]] = []
        """Frames, and how many brokers heard each."""
        self.commands: list[bytes] = []
        self._words = count(1)

    def happen(self, event: tuple, pause_s: float) -> None:  # type: ignore[type-arg]  # noqa: PLR0912
        mesh = self.mesh
        up = {name for name, station in mesh.stations.items() if not station.stopped}
        match event:
            case ("roam", robot, broker):
                self.places[robot] = broker
                self.hear(robot, {broker})
            case ("hear", robot, at):
                self.hear(robot, at)
            case ("command", robot, broker):
                self.command(robot, broker)
            case ("partition", some):
                mesh.partition(some, set(BROKERS) - some)
            case ("cut", one, other) if one != other:
                mesh.cut((one, other))
            case ("heal",):
                mesh.heal()
            case ("kill" | "leave" as how, broker) if broker in up:
                getattr(mesh, how)(broker)
            case ("start", broker) if broker not in mesh.stations:
                mesh.start(broker)
            case ("reopen", broker) if broker in up:
                mesh.reopen(broker)
            case ("stop", broker) if broker in up:
                mesh.stop(broker)
            case ("resume", broker) if broker in mesh.stations and broker not in up:
                mesh.resume(broker)
            case ("lose", kind, nth):
                which = count()
                mesh.loses = lambda what, *_: what == kind and next(which) % nth == 0
            case ("quality", broker, quality) if broker in mesh.stations:
                mesh.stations[broker].quality[RADIO] = quality
        mesh.run(pause_s)

    def hear(self, robot: str, at: set[str]) -> None:
        self.said.append((self.mesh.says(robot, at, "PC", "estou", str(next(self._words))), len(at)))

    def command(self, robot: str, broker: str) -> bytes:
        self.commands.append(
            self.mesh.says(f"PC{broker}", broker, robot, "parafrente", str(next(self._words)), link=WIFI)
        )
        return self.commands[-1]

    def calm(self) -> None:
        """Nothing bad happens any more; the robots that are near a broker talk."""
        self.mesh.loses = lambda *_: False
        self.mesh.heal()
        for name in BROKERS:
            if name not in self.mesh.stations:
                self.mesh.start(name)
            if self.mesh.stations[name].stopped:
                self.mesh.resume(name)
        for _ in range(30):
            for robot, place in self.places.items():
                self.hear(robot, {place})
            self.mesh.run(0.5)


@settings(max_examples=60, deadline=None, phases=PHASES)
@given(
    st.integers(0, 1000),
    st.sampled_from([0.001, 0.02, 0.15]),
    st.lists(st.tuples(events, pauses), min_size=1, max_size=25),
)
def test_after_a_while_of_quiet_all_agree_who_owns_what_and_nothing_came_twice(
    seed: int,
    delay_s: float,
    happenings: list[tuple[tuple, float]],  # type: ignore[type-arg]
) -> None:
    storm = Storm(seed, delay_s)
    for event, pause_s in happenings:
        storm.happen(event, pause_s)
    storm.calm()
    mesh = storm.mesh
    assert mesh.disagreements(ROBOTS) == []
    assert {robot: mesh.owner(robot) for robot in ROBOTS} == storm.places
    mesh.run(1)
    sure = [storm.command(robot, broker) for robot in ROBOTS for broker in BROKERS]
    mesh.run(1)
    assert [mesh.transmitted(command) for command in sure] == [1] * len(sure)
    assert all(mesh.transmitted(command) <= 1 for command in storm.commands)
    assert all(mesh.published(data) <= heard for data, heard in storm.said)
    mesh.run(5)
    mesh.balances()
    before = mesh.declared_anew
    mesh.run(20)
    assert mesh.declared_anew == before


@settings(max_examples=30, deadline=None, phases=PHASES)
@given(st.integers(0, 1000), st.lists(st.tuples(robots, brokers, st.floats(0.05, 2.0)), max_size=15))
def test_while_the_network_is_whole_no_frame_is_published_twice_and_no_command_carried_out_twice(
    seed: int, steps: list[tuple[str, str, float]]
) -> None:
    storm = Storm(seed)
    for robot, place, pause_s in steps:
        storm.happen(("roam", robot, place), 0.05)
        storm.happen(("command", robot, "D"), pause_s)
    storm.calm()
    assert all(storm.mesh.transmitted(command) <= 1 for command in storm.commands)
    assert all(storm.mesh.published(data) <= 1 for data, _ in storm.said)
    storm.mesh.run(5)
    storm.mesh.balances()
