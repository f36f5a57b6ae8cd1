"""The keys of the bus, and back: any name becomes one chunk that Zenoh takes.

A chunk keeps ``A-Z a-z 0-9 _ . -`` and percent-encodes every other byte of the UTF-8 name, so it
never begins with ``@`` and never holds a wildcard. A *name* that reads as an address (``0x12``,
``red.0x12``) has its first character encoded; an empty name is a lone ``%``.
"""

import re
from collections.abc import Iterable
from typing import Final
from urllib.parse import quote, unquote

from psiu_broker.frame import Address

KEY_LENGTH_MAX: Final = 32_768
"""Half of what a Zenoh transport can carry; a longer key would break the session for good."""

_NO_NAME: Final = "%"
_PREFIX: Final = re.compile(r"[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*")


def chunk(text: str) -> str:
    """`text` as one key chunk."""
    return quote(text, safe="", errors="replace").replace("~", "%7E") or _NO_NAME


def text(chunk: str) -> str:
    """The text of a chunk, ours or written by hand (``João`` as it is).

    Raises:
        ValueError: its percent-encoding is not UTF-8.
    """
    return "" if chunk == _NO_NAME else unquote(chunk, errors="strict")


def robot_chunk(robot: Address) -> str:
    """`robot` as one key chunk: ``MNERIM``, ``0x12``, ``red.0x12``, or ``%30x12`` for a robot *named* 0x12."""
    if not robot.is_numbered and Address.parse(robot.name).is_numbered:
        return f"%{ord(robot.name[0]):02X}{robot.name[1:]}"
    return chunk(str(robot))


def robot(chunk: str) -> Address:
    """The inverse of `robot_chunk`.

    Raises:
        ValueError: its percent-encoding is not UTF-8.
    """
    address = Address.parse(chunk)
    return address if address.is_numbered else Address.named(text(chunk))


class Keys:
    """The keys under one prefix. A method raises ValueError where the key would be too long for Zenoh."""

    def __init__(self, prefix: str = "psiu") -> None:
        """Raises ValueError unless `prefix` is one or more plain chunks: ``psiu``, ``lab/psiu``."""
        if not _PREFIX.fullmatch(prefix):
            raise ValueError(f"the prefix {prefix!r} is not plain chunks of A-Z a-z 0-9 _ . -")
        self.prefix: Final = prefix
        self.every_frame: Final = f"{prefix}/*/*/**"
        self.every_card: Final = f"{prefix}/*"
        self.every_call: Final = f"{prefix}/@call/*/*"
        self.every_program: Final = f"{prefix}/@program/**"

    def decoded(self, source: Address, destination: Address, subject: str) -> str:
        """``psiu/{source}/{destination}/{subject}``; a subject may hold one ``/`` (``node/4``)."""
        return self._join(robot_chunk(source), robot_chunk(destination), *_subject_chunks(subject))

    def read_decoded(self, key: str) -> tuple[Address, Address, str]:
        """Source, destination and subject; raises ValueError for any other key."""
        chunks = self._split(key)
        if len(chunks) not in (3, 4) or key.startswith(f"{self.prefix}/@"):
            raise ValueError(f"{key} is not the key of a frame")
        return robot(chunks[0]), robot(chunks[1]), "/".join(text(part) for part in chunks[2:])

    def card(self, robot: Address) -> str:
        return self._join(robot_chunk(robot))

    def read_card(self, key: str) -> Address:
        """The robot; raises ValueError for any other key."""
        chunks = self._split(key)
        if len(chunks) != 1:
            raise ValueError(f"{key} is not the key of a card")
        return robot(chunks[0])

    def call(self, robot: Address, command: str) -> str:
        return self._join("@call", robot_chunk(robot), chunk(command))

    def read_call(self, key: str) -> tuple[Address, str]:
        """Robot and command; raises ValueError for a key that names not exactly one of each."""
        chunks = self._split(key)
        if len(chunks) != 3 or chunks[0] != "@call" or "*" in key:
            raise ValueError("a call names one robot and one command")
        return robot(chunks[1]), text(chunks[2])

    def alive(self, broker: str) -> str:
        """What a broker asks only itself."""
        return self._join("@alive", chunk(broker))

    def program(self, program: str) -> str:
        """The token of a program whose calls say that they are its."""
        return self._join("@program", chunk(program))

    def read_program(self, key: str) -> tuple[str, bool]:
        """The program, and whether it says that it goes in good order; raises ValueError for any other key.

        Those whose ids begin with ``@`` have no token: they are on links.
        """
        chunks = self._split(key)
        if len(chunks) not in (2, 3) or chunks[0] != "@program" or chunks[2:] not in ([], ["done"]):
            raise ValueError(f"{key} is not the token of a program")
        program = text(chunks[1])
        if program.startswith("@"):
            raise ValueError(f"{key} is not the token of a program")
        return program, len(chunks) == 3

    def raw(self, broker: str, link: str) -> str:
        return self._join("@raw", chunk(broker), chunk(link))

    def every_raw(self, broker: str) -> str:
        return self._join("@raw", chunk(broker), "*")

    def broker(self, broker: str, *what: str) -> str:
        """``psiu/@broker/{broker}/{what}``; `what` is one word, or ``why`` and two robots' texts."""
        word, *robots = what
        return self._join("@broker", chunk(broker), word, *(robot_chunk(Address.parse(each)) for each in robots))

    def every_broker(self, *what: str) -> str:
        """The same, asked of every broker."""
        word, *robots = what
        return self._join("@broker", "*", word, *(robot_chunk(Address.parse(each)) for each in robots))

    def read_broker(self, key: str) -> tuple[str, list[str]]:
        """The broker's name and the chunks behind it; raises ValueError for any other key."""
        chunks = self._split(key)
        if len(chunks) < 2 or chunks[0] != "@broker":
            raise ValueError(f"{key} is not the key of a broker")
        return text(chunks[1]), chunks[2:]

    def _join(self, *chunks: str) -> str:
        key = "/".join((self.prefix, *chunks))
        if len(key) > KEY_LENGTH_MAX:
            raise ValueError(f"a key of {len(key)} characters is longer than {KEY_LENGTH_MAX}")
        return key

    def _split(self, key: str) -> list[str]:
        if not key.startswith(f"{self.prefix}/"):
            raise ValueError(f"{key} is not under {self.prefix}/")
        return key[len(self.prefix) + 1 :].split("/")


def _subject_chunks(subject: str) -> Iterable[str]:
    first, slash, rest = subject.partition("/")
    return (chunk(first), chunk(rest)) if first and slash and rest else (chunk(subject),)
