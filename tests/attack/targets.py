"""What is attacked, and what must hold whatever the bytes are: no exception but the declared, and more (`hear`).

The first byte of an input chooses among the configurations of its target, the second one how its stream is cut.
"""

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from types import FrameType
from typing import Any, Final, NoReturn

from attack.robots import CALLS, MAPS, ROBOTS

from psiu_broker.bus.calls import read_request
from psiu_broker.bus.keys import Keys
from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.identity import identity
from psiu_broker.errors import CallError, EncodeError, LinkError
from psiu_broker.frame import NOBODY, Address, Frame, Malformed
from psiu_broker.mesh.envelope import Envelope, pack, unpack
from psiu_broker.messages import Answer, Decoded
from psiu_broker.profiles.describe import describe
from psiu_broker.profiles.persona import Call, Persona, Say
from psiu_broker.profiles.profile import Description, Profile, Request
from psiu_broker.profiles.responder import Responder
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.trunk.wire import Reader

KEYS: Final = Keys()
FRAMES_USED: Final = 20
"""Of each input, so that longer ones are not dearer without finding more."""
SLOWEST_S: Final = 10
"""CPU time that one input may take at most."""
NOW: Final = datetime(2026, 1, 1, tzinfo=UTC)

OPTIONS: Final[Mapping[str, Sequence[dict[str, Any]]]] = {
    "psiu-ascii": [{}, {"version": "0.5"}, {"version": "0"}, {"strict": True}, {"line_end": "crlf"}],
    "psiu-hexa": [
        {},
        {"fragment": True},
        {"size": "real", "crc": "none"},
        {"crc": "nrsc-5"},
        {"crc": "xor"},
        {"crc": "negsum", "fragment": True},
        {"topology": "master-slave"},
        {"topology": "point-to-point", "remote": 2},
        {"resync": False},
    ],
    "mitya": [{}, {"version": "2013"}, {"version": "2014"}],
    "soccer": [
        {},
        {"preset": "f180"},
        {"preset": "guarana"},
        {"robots": 1, "bytes_per_robot": 1, "byte_codec": "int8", "trailer": "none"},
    ],
    "firmata": [{}, {"role": "board"}],
    "amarino": [{}, {"role": "board"}],
}
"""The configurations of each protocol."""

_ONE_BEHIND_ANOTHER: Final = frozenset({"psiu-ascii", "psiu-hexa", "mitya", "firmata"})
"""Protocols of which each byte is in one event at most."""


def codec_of(protocol: str, options: dict[str, Any]) -> Codec:
    kind = PROTOCOLS[protocol].codec
    names = {"MNERIM", "PC", "R2 D2", "R2031"}
    directory = Directory(names={"R2 D2"}, all_names=names, numbers={1, 2, 3, 255})
    return kind(kind.Options.model_validate(options), directory)


def read(codec: Codec, pieces: Sequence[bytes]) -> list[Event]:
    """What `codec` makes of a stream that ends behind `pieces`."""
    events: list[Event] = []
    for piece in pieces:
        whole = None if codec.pending else codec.whole(piece)
        found = codec.decode(piece, 0.0)
        assert whole is None or list(found) == [whole], "whole() and decode() tell different things"
        events += found
    events += codec.flush(0.0)
    assert not codec.pending, "something waits behind the end"
    return events


def hear(protocol: str, data: bytes) -> None:
    """A robot says `data`.

    However it is cut, the events are the same and hold no more bytes than were said; each frame can be described,
    published, told from others, handed to another broker, written again, and heard by profiles and personas.
    """
    choice, cut, stream = data[:1] or b"\0", data[1:2] or b"\0", data[2:]
    options = OPTIONS[protocol][choice[0] % len(OPTIONS[protocol])]
    codec = codec_of(protocol, options)
    events = read(codec, [stream])
    size = 1 + cut[0] % 16
    other = codec_of(protocol, options)
    again = read(other, [stream[at : at + size] for at in range(0, len(stream), size)])
    assert again == events, f"cut into pieces of {size} bytes, it is heard differently"
    if protocol in _ONE_BEHIND_ANOTHER:
        said = sum(event.size if isinstance(event, Malformed) else len(event.wire) for event in events)
        assert said <= len(stream), "more bytes were heard than said"
    frames = list(dict.fromkeys(event for event in events if isinstance(event, Frame)))
    _use(protocol, options, codec, frames[:FRAMES_USED])


def _use(protocol: str, options: dict[str, Any], codec: Codec, frames: Sequence[Frame]) -> None:
    profile = robot_of(protocol, options)
    asked = list(_requests(protocol, profile))
    responder = Responder("PC")
    persona = persona_of(protocol, options)
    for frame in frames:
        identity(frame)
        while profile.learn(frame) and profile.greeting():
            pass
        profile.moves(frame)
        for request in asked:
            profile.read(request, frame)
        for description in (profile.describe(frame), describe(frame, lambda _: {})):
            decoded = Decoded(
                source=str(frame.source), destination=str(frame.destination), protocol=protocol, broker="b", link="l",
                received=NOW, wire=frame.wire.hex(), **description,
            )  # fmt: skip
            assert Decoded.model_validate_json(decoded.model_dump_json()) == decoded, "it is not read as it was put"
        KEYS.decoded(frame.source, frame.destination, frame.subject)
        if protocol in ("psiu-ascii", "psiu-hexa"):
            responder.answer(frame, 0.0)
        if persona is not None:
            _play(persona, codec, frame, profile.describe(frame))
        _write(options, codec, frame)
        _hand_on(frame)


def robot_of(protocol: str, options: dict[str, Any]) -> Profile:
    entry = PROTOCOLS[protocol]
    robot = entry.profile.Options.model_validate(ROBOTS[protocol])
    return entry.profile.make(entry.codec.Options.model_validate(options), robot, 1.0)


def _requests(protocol: str, profile: Profile) -> Iterator[Request]:
    for command, parameters in CALLS[protocol]:
        with contextlib.suppress(CallError):
            yield profile.request(command, parameters)


def persona_of(protocol: str, options: dict[str, Any]) -> Persona | None:
    entry = PROTOCOLS[protocol]
    if entry.persona is None:
        return None
    settings = entry.codec.Options.model_validate(options)
    return entry.persona("MNERIM", settings, entry.persona.Options.model_validate(MAPS[protocol]))


def _play(persona: Persona, codec: Codec, frame: Frame, told: Description) -> None:
    """The program says `frame`; what it calls is done, then not; and the robot tells what `told` says."""
    actions = list(persona.heard(frame, 0.0))
    for call in [action for action in actions if isinstance(action, Call)]:
        actions += persona.answered(call, Answer(values=[1, "x"], elapsed_ms=1), "", 0.0)
        actions += persona.answered(call, None, "nothing came", 0.0)
    actions += persona.told(told, 0.0)
    if (until := persona.waits_until()) is not None:
        actions += persona.due(until)
    for action in actions:
        if isinstance(action, Say):
            with contextlib.suppress(EncodeError):
                codec.encode(Frame(NOBODY, NOBODY, action.subject, action.payload, codec.protocol))


def _write(options: dict[str, Any], codec: Codec, frame: Frame) -> None:
    """Writing `frame` anew gives bytes that are read as the same frame, or is refused."""
    with contextlib.suppress(EncodeError):
        codec.encode(frame)
    with contextlib.suppress(EncodeError):
        wire = codec.encode(frame._replace(wire=b"", dialect=""))
        if codec.protocol in ("psiu-ascii", "psiu-hexa"):
            heard = [event for event in read(codec, [wire]) if isinstance(event, Frame)]
            assert [each.payload for each in heard] == [frame.payload], "it is written as something else"
            if options.get("topology", "ad-hoc") == "ad-hoc":  # in others, what is written is heard at the far end
                assert [each.destination for each in heard] == [frame.destination], "it is written for somebody else"


def _hand_on(frame: Frame) -> None:
    try:
        data = pack(Envelope(1, 2, 3, 4, 5, frame))
    except EncodeError:
        return
    found = unpack(data)
    assert found is None or found.frame.payload == frame.payload, "another broker hears something else"


def from_a_broker(data: bytes) -> None:
    """Another broker hands on `data` as a frame: it is none, or can be described, handed on and written or refused.

    Robots of every protocol may be awaiting an answer just then.
    """
    envelope = unpack(data)
    if envelope is None:
        return
    frame = envelope.frame
    with contextlib.suppress(EncodeError):
        assert unpack(pack(envelope)) == envelope
    options = OPTIONS[frame.protocol][envelope.epoch % len(OPTIONS[frame.protocol])]
    codec = codec_of(frame.protocol, options)
    _use(frame.protocol, options, codec, [frame])
    for protocol in PROTOCOLS:
        robot = robot_of(protocol, OPTIONS[protocol][0])
        for request in _requests(protocol, robot):
            robot.read(request, frame)


def over_a_trunk(data: bytes) -> None:
    """Whoever is at the far end of a trunk says `data`: it is refused, or gives no more bytes than came."""
    reader = Reader()
    size = 1 + (data[0] if data else 0)
    found = 0
    try:
        for at in range(1, len(data), size):
            found += sum(len(each) for each in reader.feed(data[at : at + size]) if isinstance(each, bytes))
    except LinkError:
        return
    assert found <= len(data)


def from_a_program(data: bytes) -> None:
    """A program calls a command, both as it likes: it is refused with a `CallError`, or becomes a frame or none."""
    choice, (command, _, payload) = data[:1] or b"\0", data[1:].partition(b"\n")
    protocol = sorted(PROTOCOLS)[choice[0] % len(PROTOCOLS)]
    options = OPTIONS[protocol][0]
    profile = robot_of(protocol, options)
    try:
        asked = profile.request(command.decode("utf-8", "replace"), read_request(payload).parameters)
    except CallError:
        return
    to = Address.named("MNERIM") if protocol == "psiu-ascii" else Address.numbered(1)
    source = {"psiu-ascii": Address.named("PC"), "psiu-hexa": Address.numbered(2)}.get(protocol, NOBODY)
    frame = Frame(source, to, asked.subject, asked.payload, protocol)
    profile.answers_to(asked)
    profile.read(asked, frame)
    with contextlib.suppress(EncodeError):
        codec_of(protocol, options).encode(frame)


def as_a_key(data: bytes) -> None:
    """A key of the bus is read, or refused with a ValueError."""
    key = data.decode("utf-8", "replace")
    for read_key in (KEYS.read_call, KEYS.read_decoded, KEYS.read_card, KEYS.read_broker, KEYS.read_program):
        for each in (key, "psiu/" + key):
            with contextlib.suppress(ValueError):
                read_key(each)


TARGETS: Final[dict[str, Callable[[bytes], None]]] = {
    **{protocol: partial(hear, protocol) for protocol in PROTOCOLS},
    "envelope": from_a_broker,
    "trunk": over_a_trunk,
    "call": from_a_program,
    "key": as_a_key,
}
"""By the names that `python -m tests.attack` takes."""


def tell(name: str, data: bytes, limit_s: float = SLOWEST_S) -> None:
    """Attack the target `name` with `data`.

    Raises:
        TimeoutError: it takes more CPU time than `limit_s`. A busy machine makes no difference.
    """
    old = signal.signal(signal.SIGVTALRM, partial(_too_slow, limit_s))
    signal.setitimer(signal.ITIMER_VIRTUAL, limit_s)
    try:
        TARGETS[name](data)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, old)


def _too_slow(limit_s: float, signum: int, frame: FrameType | None) -> NoReturn:
    raise TimeoutError(f"one input takes more than {limit_s:g} s of CPU time")
