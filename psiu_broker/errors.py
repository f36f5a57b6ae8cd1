"""Every exception that the broker raises.

    PsiuError
    ├── ConfigurationError      the user's file is wrong: say where and stop (exit 78)
    ├── EncodeError             a frame of ours that this protocol or link cannot carry
    ├── BusError                the Zenoh session cannot open or was lost: reopen
    ├── LinkError               a link cannot work now: wait, then try again
    │   ├── LinkAbsent          the device or peer is not there yet
    │   ├── LinkBusy            another process holds it, or it is not ours to open yet
    │   └── LinkLost            it was there and went away
    └── CallError               a call that got no answer from its robot, with a `code` for programs

What a robot does wrong is never an exception: it is a `Malformed` or a verdict.
"""

from typing import Literal


class PsiuError(Exception):
    """The root of the tree above. `str()` is one clear line for a person."""


class ConfigurationError(PsiuError):
    """One or more mistakes in a configuration; each of `problems` is one whole line for the user."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class EncodeError(PsiuError):
    """A frame that cannot be written in this protocol: too long, a name with a wrong character, no such address."""


class BusError(PsiuError):
    """The Zenoh session could not be opened, or had to be given up."""


class LinkError(PsiuError):
    """A link cannot work now. The text is what `psiu links` shows after "waiting:"."""


class LinkAbsent(LinkError):
    """The device, address or peer is not there (yet)."""


class LinkBusy(LinkError):
    """Somebody else holds it, or we may not open it (yet)."""


class LinkLost(LinkError):
    """It worked and went away: unplugged, reset, out of reach."""


CallCode = Literal[
    "unknown_robot",
    "unknown_command",
    "refused",
    "link_down",
    "no_answer",
    "outcome_unknown",
    "impossible",
    "busy",
    "expired",
    "bad_request",
    "shutting_down",
]
"""Why a call has no answer: the closed list of `error` values on the bus."""


class CallError(PsiuError):
    """A call without an answer from its robot. `code` is for programs, `str()` for people."""

    def __init__(self, code: CallCode, message: str) -> None:
        super().__init__(message)
        self.code: CallCode = code
