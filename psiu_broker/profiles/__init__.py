"""Robots as callers see them, whatever they speak: commands, answers, and frames in words."""

from psiu_broker.profiles.describe import Description, describe
from psiu_broker.profiles.hexa import HexaProfile
from psiu_broker.profiles.node import Node
from psiu_broker.profiles.profile import Notice, Profile, Reading, Reply, Request
from psiu_broker.profiles.psiu import PsiuProfile
from psiu_broker.profiles.responder import Responder

__all__ = [
    "Description",
    "HexaProfile",
    "Node",
    "Notice",
    "Profile",
    "PsiuProfile",
    "Reading",
    "Reply",
    "Request",
    "Responder",
    "describe",
]
