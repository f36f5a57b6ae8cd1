"""How a script that a Robot Mitya plays is brought to an end, for which the protocol has no message. Pure.

A body plays on until it is told of another slot. To play one would begin another script; so it is told to record, and
to end the recording at once, in a slot of which nothing is played: the script there is kept. A script that was cut so
would go on where its slot is named again without being played anew; therefore every slot that was played is shunned.
"""

from typing import Final

from psiu_broker.codecs.mitya import BY_WORD, Version, is_message, message, number
from psiu_broker.frame import Frame
from psiu_broker.profiles.roboscript.script import RECORD, ROOM, SLOTS

_DRIVE: Final = "drive"


class Playback:
    """What is known of the scripts that one robot was told to play."""

    def __init__(self, version: Version, *, datagrams: bool) -> None:
        self._version: Version = version
        self._datagrams = datagrams
        self._may_play = False
        self._played: list[int] = []
        """The slots that were played, the latest at the end."""

    def begins(self, slot: int) -> None:
        """The robot is told to play `slot`."""
        if slot in self._played:
            self._played.remove(slot)
        self._played.append(slot)
        self._may_play = True

    def stop(self) -> bytes:
        """The messages that stop the robot.

        Where all slots were played, the script is lost that was played the longest ago: see `lost`.

        The motors are stopped first, and again for what the script did meanwhile. A Z0000 too many does no harm; one
        that got lost would leave the robot recording. A phone passes on no speed like the last one: before 0 it is 1,
        at which no motor turns.
        """
        letters = BY_WORD[self._version]
        stop = message(letters[_DRIVE], 0)
        if not self._may_play:
            return stop
        if self._datagrams:
            stop = message(letters[_DRIVE], 1) + stop
        free = [slot for slot in range(SLOTS) if slot not in self._played]
        record = message(letters[RECORD], 0x0100 | (free[-1] if free else self._played[0]))
        clear = b"" if free else message(letters[ROOM], 1)
        return stop + record + clear + 2 * message(letters[ROOM], 0) + stop

    def heard(self, frame: Frame) -> None:
        """Take note of what the robot says of a recording that has ended: the script before it goes on no more.

        A phone keeps that for itself; behind one every stop is as thorough as the first.
        """
        if frame.subject == RECORD and is_message(frame.payload) and number(frame.payload) >> 8 == 2:
            self._may_play = False


def lost(stop: bytes) -> int | None:
    """The slot whose script is lost to these messages of `Playback.stop`."""
    at = stop.find(b"Z0001")
    return None if at < 0 else int(stop[at - 2 : at], 16)
