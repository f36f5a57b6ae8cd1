"""A pseudo-terminal under a fixed name."""

import os
import select
import time
import tty
from contextlib import suppress
from pathlib import Path

from psiu_broker.errors import LinkAbsent, LinkBusy

READ_S = 0.1
"""How long `Terminal.finish` waits for a program to read what it was sent: a hang-up takes the rest away."""


class Terminal:
    """A new pseudo-terminal under the name `path`: raw, without echo, its far side closed until a program opens it.

    Raises LinkError where there can be none.
    """

    def __init__(self, path: str, group: int, mode: int) -> None:
        self.path = path
        self._group = group
        self._mode = mode
        try:
            self.master, slave = os.openpty()
        except OSError as error:
            raise LinkBusy(f"{path}: no pseudo-terminal to be had: {_words(error)}") from error
        try:
            try:
                self.name = os.ttyname(slave)
                tty.setraw(slave)
                os.fchown(slave, -1, group)
                os.fchmod(slave, mode)
            finally:
                os.close(slave)
            os.set_blocking(self.master, False)
        except OSError as error:
            os.close(self.master)
            raise LinkBusy(f"{path}: cannot be given to its group: {_words(error)}") from error

    def another(self) -> "Terminal":
        """One more of the same kind."""
        return Terminal(self.path, self._group, self._mode)

    def point(self) -> None:
        """Let `path` lead here, in one step; only a link to a pseudo-terminal is replaced.

        Raises:
            LinkError: something else has the name, or nothing may be written there.
        """
        path = Path(self.path)
        fresh = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            if os.path.lexists(path) and not _target(path).startswith("/dev/pts/"):
                raise LinkBusy(f"{path} is there and is no link to a pseudo-terminal: remove it or choose another name")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self.name)
            fresh.replace(path)
        except FileNotFoundError:
            raise LinkAbsent(f"{path}: there is no directory {path.parent}; waiting for it") from None
        except OSError as error:
            raise LinkBusy(f"{path}: cannot be made: {_words(error)}") from error

    @property
    def held(self) -> bool:
        """Whether any program has it open."""
        poll = select.poll()
        poll.register(self.master, 0)
        return not poll.poll(0)

    def remove(self) -> None:
        """Take the name away, if it leads here, and hang up; what was not read until then is lost."""
        path = Path(self.path)
        with suppress(OSError):
            if _target(path) == self.name:
                path.unlink()
        os.close(self.master)

    def finish(self) -> None:
        """`remove`, once the program has read all or is stuck; blocks."""
        with suppress(OSError):
            slave = os.open(self.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                deadline = time.monotonic() + READ_S
                while _is_readable(slave) and time.monotonic() < deadline:
                    time.sleep(READ_S / 20)
            finally:
                os.close(slave)
        self.remove()


def _is_readable(slave: int) -> bool:
    # By poll: it brings along what is still on its way from the master, which counting the bytes would not see.
    poll = select.poll()
    poll.register(slave, select.POLLIN)
    return bool(poll.poll(0))


def _target(path: Path) -> str:
    try:
        return str(path.readlink())
    except OSError:
        return ""


def _words(error: OSError) -> str:
    return os.strerror(error.errno or 0).lower()
