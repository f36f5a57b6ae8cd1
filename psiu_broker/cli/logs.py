"""The daemon's log: stderr, one line a record."""

import logging
import os
import sys
from collections.abc import Mapping
from typing import Final

_PRIORITIES: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7))


def log_to_stderr(level: int, environment: Mapping[str, str] = os.environ) -> None:
    """Log from `level` on. The journal, where stderr is it, keeps the time itself and is told the priority."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JournalFormatter() if _is_journal(environment) else LineFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level)
    # Its lines about selectors and slow callbacks are about us, not about robots.
    logging.getLogger("asyncio").setLevel(max(level, logging.WARNING))


class LineFormatter(logging.Formatter):
    """``2026-11-22 04:06:14.123 WARNING link radio: …``, whatever the message or the traceback holds."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s.%(msecs)03d %(levelname)s %(message)s", "%Y-%m-%d %H:%M:%S")

    def format(self, record: logging.LogRecord) -> str:
        return " | ".join(line for line in super().format(record).splitlines() if line)


class JournalFormatter(LineFormatter):
    """``<4>link radio: …``: the journal adds the rest (sd-daemon(3))."""

    def __init__(self) -> None:
        logging.Formatter.__init__(self, "%(message)s")

    def format(self, record: logging.LogRecord) -> str:
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{super().format(record)}"


def _is_journal(environment: Mapping[str, str]) -> bool:
    """Whether stderr is the stream that the service manager named; a child's may be another (systemd.exec(5))."""
    try:
        stream = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return environment.get("JOURNAL_STREAM") == f"{stream.st_dev}:{stream.st_ino}"
