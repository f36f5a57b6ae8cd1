"""RoboScript: a Robot Mitya's scripts as files that people read, on the wire, and in their slots."""

from psiu_broker.profiles.roboscript.captured import decompiled
from psiu_broker.profiles.roboscript.profile import ScriptedMitya, vocabulary
from psiu_broker.profiles.roboscript.reading import read
from psiu_broker.profiles.roboscript.recording import ABORT, UPLOAD
from psiu_broker.profiles.roboscript.script import (
    SLOTS,
    Action,
    Message,
    Problem,
    Script,
    Vocabulary,
    compiled,
    problem_lines,
)

__all__ = [
    "ABORT",
    "SLOTS",
    "UPLOAD",
    "Action",
    "Message",
    "Problem",
    "Script",
    "ScriptedMitya",
    "Vocabulary",
    "compiled",
    "decompiled",
    "problem_lines",
    "read",
    "vocabulary",
]
