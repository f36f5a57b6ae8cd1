"""Why a serial port would not open, in one line for a person, as the exception that says what to do next."""

import errno
import grp
import os
import socket
import termios
from contextlib import suppress
from pathlib import Path

from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

ABSENT = {errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO, errno.ENOTDIR}
HELD = {errno.EBUSY, errno.EAGAIN}
FORBIDDEN = {errno.EACCES, errno.EPERM}
FAR_AWAY = {errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT, errno.ECONNRESET}


def explain(device: str, path: str, baudrate: int, error: Exception) -> LinkError:
    """What pyserial's `error` means for `device`, which is the file `path` ("" for a URL)."""
    code = _errno(error)
    text = f"{device}: {_reason(error)}"
    if code in ABSENT:
        dangling = path and Path(path).is_symlink()
        missing = "its device is gone" if dangling else "no such device"
        return LinkAbsent(f"{device}: {missing if code != errno.EIO else 'no device behind it'}; waiting for it")
    if code in HELD:
        held_by = holders(path)
        return LinkBusy(f"{device}: held by another process" + (f" ({'; '.join(held_by)})" if held_by else ""))
    if code in FORBIDDEN:
        return LinkBusy(f"{device}: permission denied{_permission_hint(path)}")
    if code == errno.ENOTTY:
        return LinkError(f"{device}: not a serial port")
    if code in FAR_AWAY or isinstance(error.__context__, socket.gaierror | TimeoutError):
        return LinkAbsent(text)
    if "baud" in str(error).lower() or isinstance(error, OverflowError):
        return LinkError(refused_baudrate(device, baudrate))
    return LinkError(text)


def refused_baudrate(device: str, baudrate: int, instead: int | None = None) -> str:
    """The line that names a rate which the driver cannot do."""
    return f"{device}: its driver refuses {baudrate} baud" + (f" (it set {instead})" if instead else "")


def holders(path: str) -> list[str]:
    """``pid 123, screen`` for each process that has `path` open, as far as we are allowed to see."""
    target = os.path.realpath(path)
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if path and any(_link(descriptor) == target for descriptor in (process / "fd").iterdir()):
                name = (process / "comm").read_text(errors="replace").strip()
                ours = int(process.name) == os.getpid()
                found.append("another link of this broker" if ours else f"pid {process.name}, {name}")
    return found


def _link(descriptor: Path) -> str:
    try:
        return str(descriptor.readlink())
    except OSError:
        return ""


def _permission_hint(path: str) -> str:
    try:
        status = Path(path).stat()
        group = grp.getgrgid(status.st_gid).gr_name
    except (OSError, KeyError):
        return ""
    if group == "root" or not status.st_mode & 0o060:
        return "; not opened to its group yet"
    return f"; only group {group} may open it: sudo usermod -aG {group} USER, then log in again"


def _errno(error: BaseException) -> int | None:
    """pyserial keeps the number in the exception, or only in the one that it was handling."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    if isinstance(error, termios.error) and error.args:
        return int(error.args[0])
    return _errno(error.__context__) if error.__context__ is not None else None


def _reason(error: Exception) -> str:
    cause = error.__context__
    if isinstance(cause, OSError) and cause.strerror:
        return cause.strerror.lower()
    code = _errno(error)
    return os.strerror(code).lower() if code else str(error).partition("\n")[0]
