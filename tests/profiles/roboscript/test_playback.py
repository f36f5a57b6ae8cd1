"""A stop ends the script that a body plays, whatever was played before it, and keeps every script that it can."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.mitya import Mitya, Version, message
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Value
from psiu_broker.profiles.profile import Reply, Request
from psiu_broker.profiles.roboscript import ScriptedMitya
from psiu_broker.profiles.roboscript.playback import Playback, lost
from psiu_broker.simulator.mitya import MityaBody, MityaVersion

BODIES: list[tuple[MityaVersion, bool]] = [("2012", False), ("2012", True), ("2013", False), ("2013", True)]
SCRIPT_MS = 60_000


class Lab:
    """A body, on a line or behind a phone, that holds a script in each of `slots`: on, and off a minute later."""

    def __init__(self, version: MityaVersion = "2012", *, phone: bool = False, slots: range = range(8)) -> None:
        options = Mitya.Options(version=version)
        self.body = MityaBody(version=version, phone=phone)
        self.robot = ScriptedMitya.make(options, ScriptedMitya.Options(), 2.0, datagrams=phone)
        self.codec = Mitya(options, datagrams=phone)
        self.ears = Mitya(options, datagrams=phone)
        self.now = 0.0
        drive = "D" if version == "2012" else "G"
        for slot in slots:
            for each in (
                f"r01{slot:02X}",
                "Z0002",
                f"{drive}0064",
                f"W{SCRIPT_MS:04X}",
                f"{drive}0000",
                "W0000",
                "Z0000",
            ):
                self.body.receive(each.encode(), self.now)

    def call(self, command: str, *parameters: Value, lost: frozenset[int] = frozenset()) -> Reply | None:
        """The answer to a call; of its messages those of the numbers `lost` do not arrive."""
        self.now += 1.0
        request: Request = self.robot.request(command, parameters)
        frame = Frame(NOBODY, NOBODY, request.subject, request.payload, "mitya")
        reply: Reply | None = None
        for number, piece in enumerate(self.codec.pieces(self.codec.encode(frame))):
            for _, said in self.body.receive(piece, self.now) if number not in lost else ():
                for heard in self.ears.decode(said, self.now):
                    assert isinstance(heard, Frame)
                    self.robot.learn(heard)
                    reading = self.robot.read(request, heard)
                    reply = reading if isinstance(reading, Reply) and reply is None else reply
        self.body.advance(self.now)
        return reply or request.silence

    @property
    def speed(self) -> int:
        self.body.advance(self.now)
        return self.body.body.left

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.body.advance(self.now)


@pytest.mark.parametrize(("version", "phone"), BODIES)
def test_a_stop_ends_the_script_that_is_played(version: MityaVersion, phone: bool) -> None:
    lab = Lab(version, phone=phone)
    lab.body.scripts[3].insert(0, lab.body.scripts[3][0]._replace(delay_ms=5000))
    lab.call("play", 3)
    assert lab.speed == 100
    lab.call("pare")
    assert lab.speed == 0
    lab.wait(10)
    assert lab.speed == 0, "the script went on"
    assert lab.body.recording is None
    assert len(lab.body.scripts) == 8, "a script was lost"


@pytest.mark.parametrize(("version", "phone"), BODIES)
def test_each_of_many_stops_ends_what_was_played_before_it(version: MityaVersion, phone: bool) -> None:
    lab = Lab(version, phone=phone, slots=range(10))
    for slot in (3, 9, 8, 3, 7, 3, 0, 9):
        lab.call("play", slot)
        lab.call("stop")
        assert (lab.speed, lab.body.playing) == (0, type(lab.body.playing)())
    assert len(lab.body.scripts) == 10


def test_a_script_that_was_stopped_can_be_played_again() -> None:
    lab = Lab()
    for _ in range(3):
        lab.call("play", 3)
        assert lab.speed == 100
        lab.call("stop")
        assert lab.speed == 0


def test_a_stop_is_one_message_where_nothing_was_played_and_once_the_script_is_known_to_have_ended() -> None:
    for version, phone in BODIES:
        lab = Lab(version, phone=phone)
        knows = not phone
        plain = b"D0000" if version == "2012" else b"G0000"
        assert lab.robot.request("stop", []).payload == plain
        lab.call("play", 3)
        lab.call("stop")
        assert (lab.robot.request("stop", []).payload == plain) is knows
        lab.call("play", 3)
        assert len(lab.robot.request("stop", []).payload) > len(plain)


@pytest.mark.parametrize("version", ["2012", "2013"])
def test_where_one_datagram_is_lost_the_motors_stop_and_the_next_stop_ends_the_script(version: MityaVersion) -> None:
    for number in range(7):
        lab = Lab(version, phone=True)
        lab.call("play", 3)
        lab.call("stop", lost=frozenset({number}))
        assert lab.speed <= 1, "no motor turns at that"
        assert lab.body.recording is None, number
        lab.call("stop")
        assert (lab.speed, list(lab.body.playing)) == (0, [])


def test_a_phone_passes_the_stop_on_though_the_last_speed_it_passed_on_was_0() -> None:
    lab = Lab("2013", phone=True)
    lab.call("drive", 0)
    lab.call("play", 3)
    assert lab.speed == 100
    lab.call("stop")
    assert lab.speed == 0


def test_a_body_that_answers_each_message_has_answered_the_stop_with_the_last_of_them() -> None:
    lab = Lab("2013")
    lab.call("play", 3)
    assert lab.call("stop") == Reply("sucesso")
    request = lab.robot.request("drive", [1])
    assert lab.robot.read(request, lab.ears.decode(b"#0000", 0.0)[0]) == Reply("sucesso")  # type: ignore[arg-type]


def test_a_gesture_under_way_and_the_stop_that_comes_meanwhile_are_both_answered() -> None:
    lab = Lab("2013")
    lab.call("play", 3)
    requests = [lab.robot.request("nod", []), lab.robot.request("stop", [])]
    answers: list[int] = []
    for number in range(3):
        (done,) = lab.ears.decode(b"#0000", 0.0)
        assert isinstance(done, Frame)
        readings = [lab.robot.read(request, done) for request in requests]
        answers += [number for reading in readings if reading is not None]
    assert answers == [1, 2]


@pytest.mark.parametrize("version", ["2012", "2013"])
def test_where_every_slot_was_played_the_oldest_script_is_lost_and_the_caller_is_told(version: MityaVersion) -> None:
    lab = Lab(version, slots=range(10))
    for slot in (4, *range(10)):
        lab.call("play", slot)
    answer = lab.call("stop")
    assert answer is not None
    assert "the script of slot 0 was lost to the stop: upload it again" in (answer.remark or "")
    assert (lab.speed, list(lab.body.playing)) == (0, [])
    assert sorted(slot for slot in lab.body.scripts if lab.body.scripts[slot]) == list(range(1, 10))


@given(
    version=st.sampled_from(["2012", "2013"]),
    datagrams=st.booleans(),
    played=st.lists(st.integers(0, 9), max_size=30),
)
def test_what_stops_it_is_sent_as_it_is_and_nothing_more(version: Version, datagrams: bool, played: list[int]) -> None:
    playback = Playback(version, datagrams=datagrams)
    for slot in played:
        playback.begins(slot)
    stop = playback.stop()
    codec = Mitya(Mitya.Options(version=version), datagrams=datagrams)
    assert codec.encode(Frame(NOBODY, NOBODY, "stop", stop, "mitya")) == stop
    assert b"".join(codec.pieces(stop)) == stop
    assert lost(stop) == (next(slot for slot in played if slot in _oldest(played)) if len(set(played)) == 10 else None)
    other = Mitya(Mitya.Options(version="2013" if version == "2012" else "2012"))
    if len(stop) > 5:
        with pytest.raises(EncodeError):
            other.encode(Frame(NOBODY, NOBODY, "stop", stop, "mitya"))
    with pytest.raises(EncodeError):
        codec.encode(Frame(NOBODY, NOBODY, "stop", stop + message("r", 0x0100), "mitya"))


def _oldest(played: list[int]) -> set[int]:
    """The slot whose last time is the longest ago."""
    last = {slot: at for at, slot in enumerate(played)}
    return {min(last, key=lambda slot: last[slot])}
