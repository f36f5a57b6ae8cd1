"""Robots as callers see them, whatever they speak: commands, answers, and frames in words."""

from psiu_broker.profiles.describe import describe
from psiu_broker.profiles.hexa import HexaProfile
from psiu_broker.profiles.node import Node
from psiu_broker.profiles.profile import SENT, Description, Notice, Profile, Reading, Reply, Request, RobotOptions
from psiu_broker.profiles.psiu import PsiuProfile
from psiu_broker.profiles.responder import Responder

__all__ = [
    "SENT",
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
    "RobotOptions",
    "describe",
]
