"""The way back: a captured upload as a script file. Pure."""

import re
from collections.abc import Iterator
from typing import Final

from psiu_broker.codecs.mitya import LETTERS, MESSAGE_BYTES, number
from psiu_broker.profiles.roboscript.reading import no_roboscript
from psiu_broker.profiles.roboscript.script import PROBLEMS_SHOWN, RECORD, ROOM, WAIT, Action, Vocabulary

_MESSAGE: Final = re.compile(rb"[A-Za-z=*~#][0-9A-Fa-f]{4}")
_SPACE: Final = re.compile(rb"\s+")
_SEPARATORS: Final = re.compile(rb"[\s:,]+|0[xX](?=[0-9A-Fa-f]{2})")
_HEXADECIMAL: Final = re.compile(rb"[0-9A-Fa-f]+")


def decompiled(capture: bytes, vocabulary: Vocabulary) -> tuple[str, tuple[str, ...]]:
    """The script in a captured upload, as a file that `read` reads, and what is wrong with the capture.

    What `read` would refuse stays in the file, and is told.

    The capture is the messages themselves or their bytes in hexadecimal, with whitespace wherever it likes; what
    comes before the recording and after its end is passed over. Commands and delays alone will do as well.
    """
    if not vocabulary.forms:
        return "", (no_roboscript(vocabulary),)
    letters = LETTERS[vocabulary.version]
    found = list(_messages(_plain(capture)))
    record = (at for at, (letter, value) in enumerate(found) if letters.get(letter) == RECORD and value >> 8 == 1)
    begin = next(record, None)
    upload = _Upload(vocabulary)
    for place, (letter, value) in enumerate(found if begin is None else found[begin + 1 :], 1):
        if upload.ended:
            break
        upload.take(place, letter, value)
    problems = upload.problems
    if not found:
        problems.append("there is no message in it: a capture is messages as r0100Z0001D0064W01F4Z0000, or hexadecimal")
    elif begin is not None and not upload.ended:
        problems.append("its end, Z0000, is missing")
    if upload.room not in (None, len(upload.actions)):
        problems.append(f"it makes room for {upload.room} actions and has {len(upload.actions)}")
    where = "" if begin is None else f", slot {found[begin][1] & 0xFF}"
    return upload.file(where), tuple(problems[:PROBLEMS_SHOWN])


class _Upload:
    """What a body that records would have taken, were it patient."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        self.actions: list[Action] = []
        self.problems: list[str] = []
        self.room: int | None = None
        self.ended = False
        self._vocabulary = vocabulary
        self._begun = False
        """The last action awaits its delay."""

    def take(self, place: int, letter: str, value: int) -> None:
        """The next message, the `place`th of the upload."""
        word = LETTERS[self._vocabulary.version].get(letter)
        if word == ROOM and value:
            self.room = value
        elif word == ROOM:
            self.ended = True
            self._expect_no_delay(place)
        elif word == WAIT and self._begun:
            self.actions[-1] = self.actions[-1]._replace(delay_ms=value)
            self._begun = False
        elif word == WAIT:
            self.problems.append(f"message {place}: a delay without a command before it, left out")
        elif self._vocabulary.line(letter, value) is None:
            self.problems.append(f"message {place}: {letter}{value:04X} cannot be in a script, left out")
        else:
            self._expect_no_delay(place)
            trouble = self._vocabulary.trouble(letter, value)
            if trouble is not None:
                self.problems.append(f"message {place}: {trouble}")
            self.actions.append(Action(letter, value))
            self._begun = True

    def file(self, where: str) -> str:
        """All of it as lines."""
        total_ms = sum(action.delay_ms for action in self.actions)
        lines = [f"# Robot Mitya {self._vocabulary.version}{where}: {len(self.actions)} actions, {total_ms} ms"]
        for action in self.actions:
            lines.append(self._vocabulary.line(action.letter, action.value) or "")
            if action.delay_ms:
                lines.append(f"{WAIT} {action.delay_ms}")
        return "\n".join(lines) + "\n"

    def _expect_no_delay(self, place: int) -> None:
        if self._begun:
            self.problems.append(f"message {place}: the command before it has no delay, which a body refuses")


def _plain(capture: bytes) -> bytes:
    """The messages, without what is between them, of a capture that may be in hexadecimal."""
    bare = _SPACE.sub(b"", capture)
    pairs = _SEPARATORS.sub(b"", capture)
    if len(pairs) % 2 == 0 and _HEXADECIMAL.fullmatch(pairs):
        data = _SPACE.sub(b"", bytes.fromhex(pairs.decode("ascii")))
        return data if _MESSAGE.search(data) else bare
    return bare


def _messages(data: bytes) -> Iterator[tuple[str, int]]:
    """Letter and value of each message; bytes between them are passed over."""
    at = 0
    while at + MESSAGE_BYTES <= len(data):
        piece = data[at : at + MESSAGE_BYTES]
        if _MESSAGE.fullmatch(piece):
            yield chr(piece[0]), number(piece)
            at += MESSAGE_BYTES
        else:
            at += 1
