"""A serial port that the broker offers to programs on this computer, as if a board were plugged in there."""

import asyncio
import grp
import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property
from pathlib import Path

from pydantic import Field

from psiu_adapters.aside import Aside
from psiu_adapters.descriptor import DescriptorTransport
from psiu_adapters.openings import Openings
from psiu_adapters.terminal import Terminal
from psiu_broker.adapter import Adapter, Peer, Receiver, Transport
from psiu_broker.errors import LinkError, LinkLost

POLL_S = 1.0
LOOK_S = 0.1
"""How often it is looked whether a program has come, where inotify does not tell."""

log = logging.getLogger(__name__)


class Pty(Adapter):
    """A serial port that the broker offers, for a program to open."""

    path: str = Field(
        pattern=r"^/.*[^/]$",
        description="the name that programs open, such as /run/psiu-broker/board; a link is made there",
    )
    group: str | None = Field(
        default=None, min_length=1, description="who may open it beside the broker's own user; it must be in it"
    )
    mode: str | None = Field(
        default=None,
        pattern=r"^0?[0-7]{3}$",
        description='its rights as chmod writes them; else "0600", with a group "0660"',
    )

    async def open(self, receiver: Receiver) -> Transport:
        made = await self._aside.run(self._make, unwanted=Terminal.remove)
        try:
            return Board(made, receiver)
        except BaseException:
            await self._aside.run(made.remove)
            raise

    async def changed(self) -> None:
        before = self._seen()
        while self._seen() == before:  # noqa: ASYNC110 - the place may be on a file system that tells nothing
            await asyncio.sleep(POLL_S)

    @cached_property
    def _aside(self) -> Aside:
        return Aside(f"{self.path} opens")

    def _make(self) -> Terminal:
        """Blocks: the names of groups may come from a server.

        Raises:
            LinkError: there can be none under this name.
        """
        group = -1
        if self.group is not None:
            try:
                group = grp.getgrnam(self.group).gr_gid
            except KeyError:
                raise LinkError(f"{self.path}: this computer has no group {self.group}") from None
        mode = int(self.mode or ("0600" if self.group is None else "0660"), 8)
        return Terminal(self.path, group, mode)

    def _seen(self) -> tuple[object, ...]:
        """What is there now of the name; it differs once somebody made room for it."""
        path = Path(self.path)
        return tuple(_identity(each) for each in (path, path.parent))


class Board(Transport):
    """The open port. A program that opens it is the peer None, there until all who have it open have closed it.

    It comes with an empty piece, before anything that it says, and is `peer_lost` when it leaves. The next
    one finds another pseudo-terminal under the name: what the last one did not read, how it set the line
    and that it locked it would stay with the old one. Only a program that opens it before it was seen that
    the last one left finds the old one as that left it: to set it right then could undo what this one set.
    """

    def __init__(self, terminal: Terminal, receiver: Receiver) -> None:
        """Give `terminal` its name.

        Raises:
            LinkError: it cannot have it.
        """
        self._terminal = terminal
        self._receiver = receiver
        self._loop = asyncio.get_running_loop()
        self._visit: _Visit | None = None
        self._visits = 0
        self._holders = 0
        self._closed = False
        self._timer: asyncio.Handle | None = None
        self._openings = _openings()
        try:
            self._offer(terminal)
        except BaseException:
            self._stop()
            raise
        if self._openings is not None:
            self._loop.add_reader(self._openings.fd, self._noticed)
        else:
            # Nobody is told of before the link has its transport.
            self._timer = self._loop.call_soon(self._look)

    @property
    def peers(self) -> Collection[Peer]:
        return () if self._visit is None else (None,)

    def write(self, data: bytes, peer: Peer) -> bool:
        return True if self._visit is None else self._visit.write(data, peer)

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._stop()
        try:
            if self._visit is not None:
                await self._visit.close()
        finally:
            await Aside(f"{self._terminal.path} closes").run(self._terminal.finish)

    def status(self) -> Mapping[str, str | int | float]:
        return {
            "device": self._terminal.name,
            "program": "none" if self._visit is None else "here",
            "programs_so_far": self._visits,
        }

    def _offer(self, terminal: Terminal) -> None:
        """Let programs find `terminal`, and be told of them."""
        if self._openings is not None:
            self._openings.watch(terminal.name)
        terminal.point()

    def _noticed(self) -> None:
        """Programs opened or closed it; that the last one has closed it is seen by the hang-up."""
        for opened in self._news():
            if opened and self._visit is not None and not self._holders:
                # One closed it and another opened it before there was a hang-up to be seen.
                self._visit.stop()
                self._left()
            self._holders = self._holders + 1 if opened else max(0, self._holders - 1)
            if opened:
                self._come()

    def _look(self) -> None:
        self._timer = self._loop.call_later(LOOK_S, self._look)
        if self._terminal.held:
            self._come()

    def _news(self) -> Iterator[bool]:
        return iter(()) if self._openings is None else self._openings.news()

    def _come(self) -> None:
        if self._visit is not None:
            return

        def hung_up() -> None:
            # Said a turn late after a write: by now another may be there.
            if self._visit is visit:
                self._hung_up()

        visit = self._visit = _Visit(self._terminal, _Told(self._receiver, hung_up))
        self._visits += 1
        self._receiver.received(b"", None)

    def _left(self) -> None:
        self._visit = None
        self._receiver.peer_lost(None)

    def _hung_up(self) -> None:
        """The last program has closed it."""
        self._left()
        old = self._terminal
        try:
            fresh = old.another()
            try:
                self._offer(fresh)
                if old.held:
                    # Somebody opened it meanwhile, and must not be hung up on.
                    self._offer(old)
                else:
                    self._terminal, fresh = fresh, old
            finally:
                fresh.remove()
        except (LinkError, OSError) as error:
            self._stop()
            self._receiver.lost(LinkLost(str(error)))
            return
        self._holders = 0
        if self._terminal.held:
            self._holders = 1
            self._come()

    def _stop(self) -> None:
        """Notice nobody from now on."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._openings is not None:
            self._loop.remove_reader(self._openings.fd)
            self._openings.close()
            self._openings = None


class _Visit(DescriptorTransport):
    """The time between the first opening and the last closing of one pseudo-terminal."""

    def __init__(self, terminal: Terminal, receiver: Receiver) -> None:
        # The descriptor is the terminal's.
        super().__init__(terminal.master, receiver, close=lambda: None, name=terminal.path)

    def stop(self) -> None:
        """End at once."""
        self._stop()


class _Told:
    """The receiver of one visit, whose end is not the link's."""

    def __init__(self, receiver: Receiver, hung_up: Callable[[], None]) -> None:
        self.received = receiver.received
        self.writable = receiver.writable
        self.peer_lost = receiver.peer_lost
        self._hung_up = hung_up

    def lost(self, _error: LinkError, /) -> None:
        self._hung_up()


def _openings() -> Openings | None:
    """None where there is no inotify to be had, and it must be looked instead."""
    try:
        return Openings()
    except (OSError, AttributeError) as error:
        log.warning("no inotify (%s): programs are noticed within %g s", error, LOOK_S)
        return None


def _identity(path: Path) -> tuple[int, ...]:
    try:
        status = path.lstat()
    except OSError:
        return ()
    return (status.st_dev, status.st_ino, status.st_ctime_ns)
