"""Two robots with one name, and robots that only roam, as the pure rule and as the router see them."""

from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.quarantine import BOTH_HEARD_S, TURNS, TURNS_WITHIN_S, Quarantine
from psiu_broker.routing.router import Port, Router

MNERIM, PC, BASE = (Address.named(name) for name in ("MNERIM", "PC", "base"))
RADIO, WIFI, CABLE = (Way(link) for link in ("radio", "wifi", "cable"))
WAYS = {way.link: way for way in (RADIO, WIFI, CABLE)}


class Air:
    """Where a name is heard, as the router would tell the rule."""

    def __init__(self, quarantine: Quarantine, robot: Address = MNERIM) -> None:
        self.quarantine = quarantine
        self.robot = robot
        self.link: str | None = None

    def heard(self, link: str, now: float) -> bool:
        """Whether it is listened to."""
        if self.quarantine.holds(self.robot, link):
            self.quarantine.turned_away(self.robot, now)
            return False
        if self.link not in (None, link) and self.quarantine.moved(self.robot, str(self.link), link, now) is not None:
            return False
        self.link = link
        return True


@given(st.lists(st.tuples(st.sampled_from(sorted("abcdef")), st.floats(0, 5)), max_size=60), st.permutations("abcdef"))
def test_a_robot_that_never_comes_back_to_a_link_it_left_is_never_held_back(
    said: list[tuple[str, float]], links: list[str]
) -> None:
    air, now = Air(quarantine := Quarantine()), 0.0
    for link, pause_s in sorted(said, key=lambda each: links.index(each[0])):
        now += pause_s
        assert air.heard(link, now)
    assert not quarantine.held


@given(st.lists(st.floats(TURNS_WITHIN_S, 1000), max_size=30))
def test_a_robot_that_comes_and_goes_slowly_is_never_held_back(stays_s: list[float]) -> None:
    air, now = Air(quarantine := Quarantine()), 0.0
    for turn, stay_s in enumerate(stays_s):
        assert air.heard("ab"[turn % 2], now)
        now += stay_s
    assert not quarantine.held


@given(st.floats(0, TURNS_WITHIN_S / 2 / TURNS), st.integers(2 * TURNS, 50))
def test_of_two_robots_that_talk_by_turns_the_newcomer_is_held_back(pause_s: float, frames: int) -> None:
    air = Air(quarantine := Quarantine())
    listened = [air.heard("ab"[turn % 2], turn * pause_s) for turn in range(frames)]
    assert all(listened[::2]), "the first keeps its name"
    assert listened[1::2].count(True) == TURNS - 1
    (held,) = quarantine
    assert (held.keeper, held.links) == ("a", {"b"})
    assert held.frames == listened[1::2].count(False) - 1, "the one that gave it away is no frame of a held robot yet"


@given(st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from("ab"), st.floats(0, BOTH_HEARD_S)), max_size=40))
def test_one_robot_that_two_radios_hear_is_never_held_back(said: list[tuple[str, str, float]]) -> None:
    air = Air(quarantine := Quarantine())
    for turn, (missed_by_the_other, quicker, apart_s) in enumerate(said):
        assert air.heard(missed_by_the_other, turn)
        assert air.heard(quicker, turn + 0.5)
        quarantine.both_heard(MNERIM, apart_s)


def test_the_same_words_long_after_are_no_sign_of_one_robot() -> None:
    air = Air(quarantine := Quarantine())
    for turn in range(2 * TURNS):
        air.heard("ab"[turn % 2], turn)
        quarantine.both_heard(MNERIM, BOTH_HEARD_S + 0.1)
    assert quarantine.holds(MNERIM, "b")


def by_turns(air: Air, *links: str, since: float = 0.0) -> None:
    for turn in range(2 * TURNS):
        air.heard(links[turn % 2], since + turn)


def test_the_operator_decides_whose_the_name_is() -> None:
    air = Air(quarantine := Quarantine())
    by_turns(air, "a", "b")
    assert not quarantine.release(MNERIM, "a")
    assert quarantine.release(MNERIM, "b")
    assert not quarantine.held
    assert not quarantine.release(MNERIM, "b"), "once"
    by_turns(air, "b", "a", since=100)
    (held,) = quarantine
    assert (held.keeper, held.links) == ("b", {"a"}), "who had it before is the newcomer now"


def test_a_third_robot_is_held_back_beside_the_second() -> None:
    air = Air(quarantine := Quarantine())
    by_turns(air, "a", "b")
    by_turns(air, "a", "c", since=100)
    (held,) = quarantine
    assert (held.keeper, held.links) == ("a", {"b", "c"})
    quarantine.release(MNERIM, "c")
    assert (held.keeper, held.links) == ("c", {"b"})


@given(st.integers(1, 8), st.integers(0, 40))
def test_memory_is_bounded(capacity: int, robots: int) -> None:
    quarantine = Quarantine(capacity=capacity)
    for number in range(robots):
        by_turns(Air(quarantine, Address.named(f"R{number}")), "a", "b")
        Air(quarantine, Address.named(f"Q{number}")).heard("a", 0)
    assert len(quarantine.held) <= capacity
    assert len(quarantine._roaming) <= capacity
    assert not robots or quarantine.holds(Address.named(f"R{robots - 1}"), "b"), "the latest is known"


class Lab:
    """A router with three links, and what each frame met there."""

    def __init__(self) -> None:
        self.router = Router({BASE: "psiu-ascii"}, (), identity=lambda frame: frame.wire)
        for way in WAYS.values():
            self.router.link_up(Port(way.link, "psiu-ascii", lambda way=way: (way,)))  # type: ignore[misc]
        self.now = 0.0
        self.serial = 0

    def say(self, way: Way, source: Address = MNERIM, to: Address = BASE, word: str = "temperatura") -> str:
        self.now += 0.5
        self.serial += 1
        wire = f"{to} {word} {source} {self.serial}".encode()
        decision = self.router.route(Frame(source, to, word, word.encode(), "psiu-ascii", wire, "p"), way, self.now)
        return decision.verdict or decision.action

    def conflict(self) -> None:
        for turn in range(2 * TURNS):
            self.say((RADIO, WIFI)[turn % 2])


def test_who_is_held_back_is_not_listened_to_nor_commanded() -> None:
    lab = Lab()
    lab.conflict()
    assert lab.say(WIFI) == "quarantined"
    assert lab.say(RADIO) == "answer"
    lab.say(CABLE, PC)
    assert lab.router.decide(MNERIM, "psiu-ascii", CABLE).hops == (RADIO,)
    refusal = lab.router.guard.last_refusal(MNERIM)
    assert refusal is not None
    assert (refusal.verdict, refusal.way) == ("quarantined", WIFI)


def test_it_is_not_commanded_while_the_other_is_away_either() -> None:
    lab = Lab()
    lab.conflict()
    lab.router.link_down("radio", lab.now)
    assert lab.say(WIFI) == "quarantined"
    assert lab.router.find(MNERIM) is None


def test_what_it_says_does_not_stand_in_the_way_of_the_same_from_the_other() -> None:
    lab = Lab()
    lab.conflict()
    frame = Frame(MNERIM, BASE, "oi", b"oi", "psiu-ascii", b"base oi MNERIM", "p")
    assert lab.router.route(frame, WIFI, lab.now).verdict == "quarantined"
    assert lab.router.route(frame, RADIO, lab.now + 0.1).action == "answer"
    assert lab.router.route(frame, WIFI, lab.now + 0.2).verdict == "duplicate"


def test_a_stop_passes_whoever_says_it_and_teaches_nothing() -> None:
    lab = Lab()
    lab.conflict()
    lab.say(CABLE, PC)
    assert lab.say(WIFI, to=PC, word="pare") == "forward"
    assert lab.router.decide(MNERIM, "psiu-ascii", CABLE).hops == (RADIO,)


def test_once_released_it_is_followed_at_its_next_frame() -> None:
    lab = Lab()
    lab.conflict()
    lab.router.quarantine.release(MNERIM, "wifi")
    assert lab.say(WIFI) == "answer"
    lab.say(CABLE, PC)
    assert lab.router.decide(MNERIM, "psiu-ascii", CABLE).hops == (WIFI,)


def test_a_robot_that_roams_is_followed() -> None:
    lab = Lab()
    for way in (RADIO, RADIO, WIFI, WIFI, CABLE, CABLE):
        assert lab.say(way) == "answer"
    assert not lab.router.quarantine.held


def test_a_robot_on_two_radios_of_one_broker_is_one_robot() -> None:
    lab = Lab()
    for turn in range(20):
        frame = Frame(MNERIM, BASE, "oi", b"oi", "psiu-ascii", b"base oi MNERIM %d" % turn, "p")
        ways = (RADIO, WIFI) if turn % 2 else (WIFI, RADIO)
        assert lab.router.route(frame, ways[0], float(turn)).action == "answer"
        assert lab.router.route(frame, ways[1], turn + 0.3).verdict == "duplicate"
    assert not lab.router.quarantine.held


def test_of_too_many_who_are_held_back_the_one_that_is_quiet_for_longest_is_let_go() -> None:
    quarantine = Quarantine(capacity=3)
    names = [Address.named(name) for name in "ABCD"]
    for number, name in enumerate(names):
        air = Air(quarantine, name)
        for turn in range(2 * TURNS):
            air.heard("ab"[turn % 2], float(turn))
        if number == 2:
            quarantine.turned_away(names[0], 10.0)
    assert [each.robot for each in quarantine] == [names[2], names[0], names[3]]
