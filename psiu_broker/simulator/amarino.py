"""A simulated Arduino with Amarino's library, which trusts every flag, as real ones do.

It shares nothing with the broker's codec on purpose.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from psiu_broker.simulator.robot import Heard, Reply, Robot

START: Final = 18
END: Final = 19
ABORT: Final = 27
ROOM: Final = 64
"""The bytes of a message that it keeps."""

FIRST_FLAG: Final = ord("0")
FUNCTIONS: Final = 75
"""How many flags, from ``0`` on, may have a function."""

ECHO: Final[Mapping[str, str | None]] = MappingProxyType({"A": None, "B": "", "C": "42"})


class AmarinoBoard(Robot):
    """A board with a function for each flag of `functions`; each notes what it is told and answers.

    The answer is a text, the values that came where it is empty, or none at all (None). Telemetry is `readings`. A
    message without a flag, or with one below ``0``, makes it crash: it says and hears nothing until it is unplugged.
    """

    protocol = "amarino"

    def __init__(
        self,
        name: str = "board",
        *,
        functions: Mapping[str, str | None] = ECHO,
        readings: Sequence[float] = (21.5,),
        telemetry_s: float | None = None,
        answer_s: float = 0.0,
    ) -> None:
        """Make the board.

        Raises:
            ValueError: a function is for what cannot be a flag.
        """
        super().__init__()
        for flag in functions:
            if len(flag) != 1 or not 0 <= ord(flag) - FIRST_FLAG < FUNCTIONS:
                raise ValueError(f"{flag!r} is no flag: one character from 0 to z")
        self.name = name
        self.crashed = False
        self.readings = list(readings)
        self.telemetry_s = telemetry_s
        self._functions = dict(functions)
        self._answer_s = answer_s
        self._buffer = bytearray()

    def receive(self, data: bytes, now: float) -> list[Reply]:
        texts: list[str] = []
        for byte in data:
            if self.crashed:
                return []
            if byte == ABORT:
                self._buffer.clear()
            elif byte == END:
                texts += self._call(bytes(self._buffer), now)
                self._buffer.clear()
            elif len(self._buffer) < ROOM:
                self._buffer.append(byte)
        return [] if self.crashed else [(self._answer_s, _message(text)) for text in texts]

    def boundary(self) -> None:
        """A board does not notice: it keeps what it has of a message until the next 0x1B or 0x13."""

    def unplug(self) -> None:
        """Take its power away and give it back."""
        self.crashed = False
        self._buffer.clear()

    def hello(self) -> bytes:
        return b"" if self.crashed else _message(self.name)

    def telemetry(self) -> bytes:
        return b"" if self.crashed else _message(";".join(f"{reading:.2f}" for reading in self.readings))

    def _call(self, message: bytes, now: float) -> list[str]:
        place = (message[0] if message else 0) - FIRST_FLAG
        if place < 0:
            self.crashed = True
            return []
        flag = chr(message[0])
        if place >= FUNCTIONS:
            return ["Flag out of bounds: ", str(message[0])]
        if flag not in self._functions:
            return ["Flag not registered: ", str(message[0])]
        text = message[1:].decode("utf-8", "replace")
        self.note(Heard(now, "", f"flag/{flag}", tuple(text.split(";")) if text else ()))
        answer = self._functions[flag]
        return [] if answer is None else [answer or text]


def _message(text: str) -> bytes:
    return bytes([START]) + text.encode() + bytes([END])
