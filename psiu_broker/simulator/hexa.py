"""A simulated robot that speaks PSIU HEXA: pings, actuators, sensors and an echo of complex packets."""

import math
from collections.abc import Callable, Collection, Mapping
from functools import reduce
from operator import xor
from typing import Final, Literal, get_args

from psiu_broker.simulator.robot import Heard, Reply, Robot

Topology = Literal["ad-hoc", "master-slave", "point-to-point"]
Size = Literal["nominal", "real"]
Crc = Literal["smbus", "maxim-dow", "dvb-s2", "nrsc-5", "xor", "sum", "negsum", "none"]

ACK, NAK, BUSY, AVAILABLE, FREE, WTF = 65, 78, 66, 63, 70, 87
LONGEST_PAYLOAD: Final = 251
PATIENCE_S: Final = 0.1
"""A packet that stops this long in the middle is forgotten."""

PIECE_PATIENCE_S: Final = 1.0
"""A message in pieces whose next piece stays away this long is forgotten."""

MOST_REPEATS: Final = 3
"""How often in a row a NAK makes the robot send its last packet again."""

LONGEST_MESSAGE: Final = 65536
_NOTHING: Final = (-2, b"")
_NAMES: Final = {ACK: "ack", NAK: "nak", BUSY: "busy", AVAILABLE: "available", FREE: "free", WTF: "wtf"}
_NEVER_ANSWERED: Final = frozenset({ACK, NAK, BUSY, FREE, WTF})


def _crc8(data: bytes, polynomial: int, register: int, *, reflected: bool) -> int:
    for byte in data:
        register ^= int(f"{byte:08b}"[::-1], 2) if reflected else byte
        for _ in range(8):
            register = (register << 1) ^ (0x100 | polynomial if register & 0x80 else 0)
    return int(f"{register:08b}"[::-1], 2) if reflected else register


_CHECKS: Final[Mapping[str, Callable[[bytes], int]]] = {
    "smbus": lambda data: _crc8(data, 0x07, 0x00, reflected=False),
    "maxim-dow": lambda data: _crc8(data, 0x31, 0x00, reflected=True),
    "dvb-s2": lambda data: _crc8(data, 0xD5, 0x00, reflected=False),
    "nrsc-5": lambda data: _crc8(data, 0x31, 0xFF, reflected=False),
    "xor": lambda data: reduce(xor, data, 0),
    "sum": lambda data: sum(data) % 256,
    "negsum": lambda data: -sum(data) % 256,
}


class HexaRobot(Robot):
    """A robot with the number `address`, actuators that take any signal, and sensors with fixed signals.

    `actuators` are node numbers, `sensors` node numbers with the signal that each answers; `signals`
    holds what every node has now and may be changed. After each signal to an actuator the robot is
    busy for `busy_s`. `commands` are the command bytes beside those of the table that it acknowledges.
    What it says unasked goes to `master`. Telemetry is a complex packet of (node, signal) pairs.
    """

    protocol = "psiu-hexa"

    def __init__(  # noqa: PLR0913
        self,
        address: int,
        *,
        topology: Topology = "ad-hoc",
        size: Size = "nominal",
        crc: Crc = "smbus",
        actuators: Collection[int] = (1, 2, 3, 4),
        sensors: Mapping[int, int] | None = None,
        commands: Collection[int] = (),
        busy_s: float = 0.0,
        answer_s: float = 0.0,
        sensor_reply: Literal["node-0", "bit7"] = "node-0",
        fragment: bool = False,
        master: int = 0,
        telemetry_s: float | None = None,
    ) -> None:
        """Make the robot.

        Raises:
            ValueError: a number is out of range, or an option has no such value.
        """
        super().__init__()
        sensors = {7: 42} if sensors is None else sensors
        for what, number, least in [
            ("an address", address, 0),
            ("an address", master, 0),
            *(("a node", node, 1) for node in (*actuators, *sensors)),
            *(("a signal", signal, 0) for signal in sensors.values()),
            *(("a command byte", command, 0) for command in commands),
        ]:
            if not least <= number <= 255:
                raise ValueError(f"{what} is {least}–255, not {number}")
        for what, value, known in (("topology", topology, Topology), ("size", size, Size), ("crc", crc, Crc)):
            if value not in get_args(known):
                raise ValueError(f"there is no {what} {value!r} (known: {', '.join(get_args(known))})")
        self.name = f"0x{address:02x}"
        self.address = address
        self.topology = topology
        self.signals: dict[int, int] = dict.fromkeys(actuators, 0) | dict(sensors)
        self.busy_until = -math.inf
        self.telemetry_s = telemetry_s
        self._actuators = frozenset(actuators)
        self._commands = frozenset(commands)
        self._busy_s = busy_s
        self._answer_s = answer_s
        self._sensor_reply = sensor_reply
        self._fragment = fragment
        self._master = master
        self._header = {"ad-hoc": 3, "master-slave": 2, "point-to-point": 1}[topology]
        self._real_size = size == "real"
        self._check = _CHECKS.get(crc)
        self._trailer = 0 if self._check is None else 1
        self._buffer = bytearray()
        self._last_byte = -math.inf
        self._last_sent = self._told = _NOTHING
        self._repeats = 0
        self._pinged: set[int] = set()
        self._asked: set[int] = set()
        self._pieces: dict[int, bytearray] = {}
        self._piece_at = -math.inf

    def receive(self, data: bytes, now: float) -> list[Reply]:
        if now - self._last_byte > PATIENCE_S:
            self._buffer.clear()
        self._last_byte = now
        replies: list[bytes] = []
        for byte in data:
            self._buffer.append(byte)
            if len(self._buffer) >= self._header and len(self._buffer) >= self._wire_bytes(self._buffer):
                packet = bytes(self._buffer)
                self._buffer.clear()
                replies += self._react(packet, now)
        return [(self._answer_s, reply) for reply in replies]

    def boundary(self) -> None:
        self._buffer.clear()

    def hello(self) -> bytes:
        return self.ping(self._master)

    def telemetry(self) -> bytes:
        nodes = [bytes([node, signal]) for node, signal in sorted(self.signals.items())][:80]
        return self.packet(self._master, complex_payload(nodes or [bytes(2)]))

    def ping(self, destination: int) -> bytes:
        """A ping of ours; the answer is noted, not answered."""
        self._pinged.add(self._peer(destination))
        return self.packet(destination, b"")

    def node(self, destination: int, node: int, signal: int = 0) -> bytes:
        """A signal to another robot's actuator, or a question to its sensor."""
        self._asked.add(self._peer(destination))
        return self.packet(destination, bytes([node, signal]))

    def packet(self, destination: int, payload: bytes) -> bytes:
        """One packet from this robot; a long payload becomes several where `fragment` is on.

        Raises:
            ValueError: the payload does not fit one packet and `fragment` is off.
        """
        self._told = (self._peer(destination), payload)
        return self._send(destination, payload)

    def _send(self, destination: int, payload: bytes) -> bytes:
        self._last_sent = (self._peer(destination), payload)
        if len(payload) <= LONGEST_PAYLOAD:
            return self._pack(destination, payload)
        if not self._fragment:
            raise ValueError(f"a payload of {len(payload)} bytes: one packet has room for {LONGEST_PAYLOAD}")
        starts = range(0, len(payload) + 1, LONGEST_PAYLOAD)
        return b"".join(self._pack(destination, payload[start : start + LONGEST_PAYLOAD]) for start in starts)

    def _pack(self, destination: int, payload: bytes) -> bytes:
        size = len(payload) + (self._header + self._trailer if self._real_size else 4)
        body = bytes([*self._addresses(destination), size]) + payload
        return body if self._check is None else body + bytes([self._check(body)])

    def _addresses(self, destination: int) -> tuple[int, ...]:
        if self.topology == "ad-hoc":
            return (self.address, destination)
        return (self.address,) if self.topology == "master-slave" else ()

    def _peer(self, address: int) -> int:
        """Whom an answer will come from: `address` only where packets carry it."""
        return address if self.topology == "ad-hoc" else -1

    def _wire_bytes(self, packet: bytes | bytearray) -> int:
        size = packet[self._header - 1]
        return size if self._real_size else size - 4 + self._header + self._trailer

    def _react(self, packet: bytes, now: float) -> list[bytes]:
        """The answers to one packet; a size that is too small makes a packet of its header alone."""
        ends = len(packet) - self._trailer
        payload = packet[self._header : ends]
        source = packet[0] if self.topology == "ad-hoc" else -1
        destination = packet[self._header - 2] if self.topology != "point-to-point" else self.address
        whole = len(packet) == self._wire_bytes(packet) >= self._header + self._trailer
        if not whole or (self._check is not None and self._check(packet[:ends]) != packet[-1]):
            hears_all = self.topology != "ad-hoc"
            spoken_to = whole and (hears_all or destination == self.address)
            return [self._pack(source, bytes([NAK]))] if spoken_to and not _settles(payload) else []
        if destination != self.address or source == self.address:
            return []
        begins = len(payload) == LONGEST_PAYLOAD and complex_fields(payload) is None
        if self._fragment and (begins or source in self._pieces):
            return self._collect(source, payload, now)
        self._note(source, payload, now)
        answer = self._answer(source, payload, now)
        return [] if answer is None else [self._send(source, answer)]

    def _collect(self, source: int, piece: bytes, now: float) -> list[bytes]:
        if now - self._piece_at > PIECE_PATIENCE_S:
            self._pieces.clear()
        self._piece_at = now
        pieces = self._pieces.setdefault(source, bytearray())
        pieces += piece
        if len(piece) == LONGEST_PAYLOAD and len(pieces) < LONGEST_MESSAGE:
            return []
        message = bytes(self._pieces.pop(source))
        self._note(source, message, now)
        answer = self._complex(source, message, now)
        return [] if answer is None else [self._send(source, answer)]

    def _note(self, source: int, payload: bytes, now: float) -> None:
        subject, parameters = "complex", tuple(field.hex() for field in complex_fields(payload) or ())
        if not payload:
            subject = "ping"
        elif len(payload) == 1:
            subject = _NAMES.get(payload[0], f"command/{payload[0]}")
        elif len(payload) == 2:
            subject, parameters = f"node/{payload[0]}", (str(payload[1]),)
        self.note(Heard(now, "" if source < 0 else f"0x{source:02x}", subject, parameters))

    def _answer(self, source: int, payload: bytes, now: float) -> bytes | None:
        """The payload of the answer to a packet with `payload`, None where there is none."""
        if payload != bytes([NAK]):
            self._repeats = 0
        if not payload:
            if source in self._pinged:
                self._pinged.discard(source)
                return None
            return b""
        if len(payload) == 1:
            return self._command(source, payload[0], now)
        if len(payload) == 2:
            return self._node(source, payload[0], payload[1], now)
        return self._complex(source, payload, now)

    def _command(self, source: int, command: int, now: float) -> bytes | None:
        destination, last = self._last_sent
        if command == NAK and destination == source and self._repeats < MOST_REPEATS:
            self._repeats += 1
            return last
        if command in _NEVER_ANSWERED:
            self._asked.discard(source)
            return None
        if now < self.busy_until:
            return bytes([BUSY])
        if command == AVAILABLE:
            return bytes([FREE])
        return bytes([ACK if command in self._commands else WTF])

    def _node(self, source: int, node: int, signal: int, now: float) -> bytes | None:
        if node == 0:
            if source in self._asked:
                self._asked.discard(source)
                return None
            return bytes([WTF])
        if now < self.busy_until:
            return bytes([BUSY])
        if node in self._actuators:
            self.signals[node] = signal
            self.busy_until = now + self._busy_s
            return bytes([ACK])
        if node in self.signals:
            return bytes([0 if self._sensor_reply == "node-0" else node | 0x80, self.signals[node]])
        return bytes([WTF])

    def _complex(self, source: int, payload: bytes, now: float) -> bytes | None:
        if (source, payload) == self._told:
            self._told = _NOTHING  # The echo of our own packet: echoing it again would never end.
            return None
        if now < self.busy_until:
            return bytes([BUSY])
        return bytes([WTF]) if complex_fields(payload) is None else payload


def complex_fields(payload: bytes) -> list[bytes] | None:
    """The fields of a complex payload (PSIU HEXA 1.3); None where the counts do not add up."""
    if not payload or not payload[0]:
        return None
    sizes = payload[1 : 1 + payload[0]]
    start = 1 + payload[0]
    if len(sizes) < payload[0] or start + sum(sizes) != len(payload):
        return None
    fields = []
    for size in sizes:
        fields.append(payload[start : start + size])
        start += size
    return fields


def complex_payload(fields: Collection[bytes]) -> bytes:
    """The complex payload of `fields`: at most 255, each of at most 255 bytes."""
    return bytes([len(fields), *map(len, fields)]) + b"".join(fields)


def _settles(payload: bytes) -> bool:
    """True: the packet reads as one that is never answered, right or wrong."""
    return len(payload) == 1 and payload[0] in _NEVER_ANSWERED
