"""One far end of a trunk: who it is, and one Zenoh connection after another between its session and ours."""

import asyncio
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Literal, Protocol

from psiu_broker.errors import LinkAbsent, LinkError, LinkLost
from psiu_broker.trunk.local import Door, Local, Meeting
from psiu_broker.trunk.wire import END, ENDED, Greeting, Reader, chunk

GREETING_S: Final = 20.0
"""How long an open stream may be without a greeting: the far end may open it much later than we."""

ANSWER_S: Final = 10.0
"""How long the far end may take to say that it ended a connection that we ended."""


Phase = Literal["idle", "under way", "ending", "closed"]
"""Of the Zenoh connection: no byte of it yet; begun; ended by us and not yet by the far end; and there is no more."""


class Host(Protocol):
    """The trunk, as its channels see it. None of these waits or raises."""

    def greeted(self, channel: "Channel") -> None:
        """The far end is another broker: `Channel.far`."""

    def failed(self, channel: "Channel", error: LinkError) -> None:
        """The channel has closed itself: only a new stream will do."""

    def overran(self, channel: "Channel") -> None:
        """Zenoh read too slowly, and lost its connection."""


class Channel:
    """Greets at once; `write` is the transport's, for this far end."""

    def __init__(self, own: Greeting, meeting: Meeting, host: Host, write: Callable[[bytes], bool]) -> None:
        self.far: Greeting | None = None
        self.silent = True
        """Nothing has been heard: the far end may not have opened the stream yet."""
        self._own = own
        self._meeting = meeting
        self._host = host
        self._write = write
        self._loop = asyncio.get_running_loop()
        self._reader = Reader()
        self._refused: deque[bytes] = deque()
        """What the transport had no room for; while there is any, nothing is taken from Zenoh."""
        self._phase: Phase = "idle"
        self._local: Local | None = None
        self._door: Door | None = None
        self._dials = False
        self._timer: asyncio.TimerHandle | None = None
        self._within(GREETING_S, LinkAbsent("the far end says nothing; is there a psiu-broker with a trunk?"))
        self._put(own.line)

    def received(self, data: bytes) -> None:
        self.silent = False
        try:
            for each in () if self._phase == "closed" else self._reader.feed(data):
                if self._phase == "closed":
                    return
                if isinstance(each, Greeting):
                    self._met(each)
                elif each == ENDED:
                    self._far_ended()
                else:
                    self._far_said(each)
        except LinkError as error:
            self._fail(error)

    def writable(self) -> None:
        while self._refused and self._write(self._refused[0]):
            self._refused.popleft()
        self._watch()

    def move(self, meeting: Meeting) -> None:
        """The broker has another session, which is at `meeting`; the connection with the former one is over."""
        self._meeting = meeting
        if self._phase == "closed":
            return
        self._close_door()
        self._end()

    def close(self) -> None:
        """Leave Zenoh alone at once, so that it notices at once; harmless twice."""
        self._phase = "closed"
        self._in_time()
        self._close_door()
        if self._local is not None:
            self._local.close()
            self._local = None
        self._refused.clear()

    # The far end.

    def _met(self, far: Greeting) -> None:
        """Raises LinkBusy."""
        self._dials = self._own.dials(far)
        self._in_time()
        self.far = far
        self._host.greeted(self)
        self._watch()

    def _far_said(self, data: bytes) -> None:
        """Raises LinkLost."""
        if self._phase == "idle":
            if self._dials or self._refused:
                raise LinkLost("the far end speaks out of turn")
            self._phase = "under way"
            with suppress(OSError):
                self._local = Local.connect(self._meeting.session, self._zenoh_said, self._end)
        if self._phase == "under way":
            self._hand_over(data)

    def _far_ended(self) -> None:
        """Raises LinkLost."""
        if self._phase == "idle":
            raise LinkLost("the far end ends what has not begun")
        if self._phase == "under way":
            self._put(END)
        self._in_time()
        self._hang_up("idle")

    # Zenoh.

    def _hand_over(self, data: bytes) -> None:
        taken = False
        if self._local is not None:
            with suppress(OSError):
                taken = self._local.write(data)
                if not taken:
                    self._host.overran(self)
        if taken:
            self._watch()
        else:
            self._end()

    def _zenoh_came(self, connection: socket.socket) -> None:
        self._local = Local(connection, self._zenoh_said, self._end)
        self._watch()

    def _zenoh_said(self, data: bytes) -> None:
        self._phase = "under way"
        self._put(chunk(data))
        self._watch()

    def _end(self) -> None:
        """This end's part of the connection is over; the far end's must be, before there is another."""
        if self._phase == "under way":
            self._put(END)
            self._within(ANSWER_S, LinkLost("the far end does not answer"))
            self._hang_up("ending")
        else:
            self._hang_up(self._phase)

    def _hang_up(self, phase: Phase) -> None:
        if self._local is not None:
            self._local.close()
            self._local = None
        self._phase = phase
        self._watch()

    # Both.

    def _watch(self) -> None:
        """Listen to Zenoh where there is somebody to tell and room to tell it."""
        if self._local is not None:
            self._local.read(not self._refused)
        elif self._dials and self._phase == "idle":
            if self._door is None:
                try:
                    self._door = Door(self._meeting.door, self._zenoh_came)
                except OSError as error:
                    self._fail(LinkError(f"no socket for Zenoh at {self._meeting.door}: {error.strerror}"))
                    return
            self._door.ready()

    def _close_door(self) -> None:
        if self._door is not None:
            self._door.close()
            self._door = None

    def _put(self, data: bytes) -> None:
        if self._refused or not self._write(data):
            self._refused.append(data)

    def _within(self, limit_s: float, error: LinkError) -> None:
        self._in_time()
        self._timer = self._loop.call_later(limit_s, self._fail, error)

    def _in_time(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _fail(self, error: LinkError) -> None:
        self.close()
        self.far = None
        self._host.failed(self, error)
