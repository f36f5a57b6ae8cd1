"""The closed set of fates of a frame, and the books that must balance."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

Verdict = Literal[
    "delivered",
    "answered",
    "no_route",
    "expired",
    "queue_full",
    "superseded",
    "duplicate",
    "same_way",
    "refused",
    "denied",
    "spoofed",
    "too_many_names",
    "quarantined",
    "storm",
    "link_down",
    "malformed",
]

DELIVERED: Final = "delivered"
"""Handed whole to the transport of at least one link."""
ANSWERED: Final = "answered"
"""It was for the broker itself, or for a robot that the broker speaks for, and was dealt with here."""
NO_ROUTE: Final = "no_route"
"""Nobody knows the destination, and nobody answered when it was asked for."""
EXPIRED: Final = "expired"
"""It waited longer than its age limit."""
QUEUE_FULL: Final = "queue_full"
"""The outbox was full and this frame was the least urgent."""
SUPERSEDED: Final = "superseded"
"""A newer set-point for the same robot, or a stop, took its place before it was sent."""
DUPLICATE: Final = "duplicate"
"""The same frame came by another way a moment ago."""
SAME_WAY: Final = "same_way"
"""The destination is on the way it came from, and has heard it already."""
REFUSED: Final = "refused"
"""The link or the protocol cannot carry it, or its source cannot be who it says."""
DENIED: Final = "denied"
"""A command that the policy keeps from its destination."""
SPOOFED: Final = "spoofed"
"""It came from elsewhere than where the configuration says that its source is."""
TOO_MANY_NAMES: Final = "too_many_names"
"""More names turned up on its link of late than may; its source was one too many."""
QUARANTINED: Final = "quarantined"
"""A robot on another link has its source's name, and had it first."""
STORM: Final = "storm"
"""Too many frames to everyone came from its link of late."""
LINK_DOWN: Final = "link_down"
"""The only link to the destination is down, or went down while the frame waited."""
MALFORMED: Final = "malformed"
"""Bytes that were no frame."""

UNREACHED: Final[frozenset[Verdict]] = frozenset({NO_ROUTE, LINK_DOWN, EXPIRED, QUEUE_FULL, REFUSED})
"""The verdicts of which a sender may be told that its robot was not reached."""

MEANINGS: Final[Mapping[Verdict, str]] = {
    DELIVERED: "it was handed to the line of at least one link",
    ANSWERED: "it was for the broker, or for a robot that the broker speaks for",
    NO_ROUTE: "nobody knows its destination, and nobody answered to that name",
    EXPIRED: "it waited longer than it may: max_age_s, question_max_age_s",
    QUEUE_FULL: "more waited for the link than may, and it was the least urgent: queue_frames",
    SUPERSEDED: "a stop or a newer set-point took its place before it was sent",
    DUPLICATE: "it came by another way a moment before",
    SAME_WAY: "its destination is where it came from, and has heard it",
    REFUSED: "its link or protocol cannot carry it, its robot is to be left alone, or nobody is called as its source",
    DENIED: "a rule keeps such commands from its destination: psiu why",
    SPOOFED: "the configuration puts its source elsewhere",
    TOO_MANY_NAMES: "more new names came on its link than may: new_names_per_minute",
    QUARANTINED: "another robot has its source's name: psiu conflicts",
    STORM: "too many frames to everyone came from its link",
    LINK_DOWN: "the link to its destination is down, or went down while it waited",
    MALFORMED: "bytes that were no frame",
}
"""In words, for people."""

KEPT: Final[frozenset[Verdict]] = frozenset({DELIVERED, ANSWERED})
"""The verdicts that are not a drop."""


@dataclass(slots=True)
class Account:
    """The books of one link: how many frames arrived on it, and what became of how many."""

    arrived: int = 0
    # No Counter: it takes three times as long, for each frame.
    fates: dict[Verdict, int] = field(default_factory=lambda: dict.fromkeys(get_args(Verdict), 0))

    def dropped(self) -> dict[Verdict, int]:
        return {verdict: count for verdict, count in self.fates.items() if verdict not in KEPT}

    def settled(self) -> int:
        return sum(self.fates.values())
