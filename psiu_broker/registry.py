"""The adapters that are installed, ours and other people's, found by their entry points."""

import logging
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from psiu_broker.adapter import Adapter

GROUP = "psiu_broker.adapters"

log = logging.getLogger(__name__)


class UnknownAdapter(KeyError):
    """No adapter of this name is installed, or it cannot be loaded; `str()` is one line for the user.

    `suggestion` is the installed name that was probably meant, or None.
    """

    def __init__(self, message: str, suggestion: str | None = None) -> None:
        super().__init__(message)
        self.suggestion = suggestion

    def __str__(self) -> str:
        return str(self.args[0])


def adapter_names() -> list[str]:
    """The names of the installed adapters, sorted; none of them is imported for this."""
    return sorted(_found())


def adapter_class(name: str) -> type[Adapter]:
    """The adapter called `name`.

    Raises:
        UnknownAdapter: nothing of this name is installed, or what is installed is broken.
    """
    found = _found()
    if name not in found:
        near = get_close_matches(name, found, n=1)
        known = ", ".join(sorted(found)) or "none is installed"
        raise UnknownAdapter(f"there is no adapter {name!r} (known: {known})", near[0] if near else None)
    entry = found[name]
    try:
        loaded = entry.load()
    except (Exception, SystemExit) as error:
        # Somebody else's module may fail in any way when it is imported, and only its own links may suffer.
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise UnknownAdapter(f"the adapter {name!r} ({entry.value}) cannot be loaded: {reason}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, Adapter)):
        raise UnknownAdapter(f"the adapter {name!r} ({entry.value}) is not a psiu_broker.adapter.Adapter")
    return loaded


@cache
def _found() -> dict[str, EntryPoint]:
    """Entry points by name; of two with one name the first on the import path counts, aloud."""
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=GROUP):
        first = found.setdefault(entry.name, entry)
        if first.value != entry.value:
            log.warning("two adapters are called %r: %s is used, %s is not", entry.name, first.value, entry.value)
    return found
