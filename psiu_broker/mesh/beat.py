"""What every broker tells every other a few times a second: that it lives, and when it heard of them."""

from collections.abc import Hashable, Iterable
from hashlib import blake2b
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.messages import BROKER_NAME_MAX

Micros = Annotated[int, Field(ge=0, lt=2**63)]
Epoch = Annotated[int, Field(ge=0, lt=2**64)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Name = Annotated[str, Field(max_length=BROKER_NAME_MAX)]
Counts = Annotated[dict[int, Count], Field(max_length=16)]
"""By lane."""


class Beat(BaseModel):
    """One beat. Times are microseconds of the steady clock of the broker that is named."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    broker: str = Field(min_length=1, max_length=BROKER_NAME_MAX)
    epoch: int = Field(ge=0, lt=2**64, description="which life of the broker this is")
    zenoh_id: str = Field(default="", max_length=32)
    sent_us: Micros = Field(description="by the sender's clock")
    heard: dict[Name, tuple[Micros, Micros]] | None = Field(
        default=None,
        max_length=4096,
        description="for each broker the `sent_us` of its last beat, and how long ago that came; not in every beat",
    )
    sent: dict[Name, tuple[Epoch, Counts]] = Field(
        default={},
        max_length=4096,
        description="how many frames each broker, in which life of its, was sent, by lane; not in every beat",
    )
    claims: str = Field(default="", max_length=64, description="the digest of what the sender claims")
    unseen: list[Name] = Field(
        default=[], max_length=4096, description="whose announcements the sender lacks: they should declare anew"
    )


class Notice(BaseModel):
    """To the owner of a robot: we hear it too. Without a frame: declare what you have anew, we do not see it all."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    broker: str = Field(min_length=1, max_length=BROKER_NAME_MAX)
    quality: int = Field(default=0, ge=0, le=10, description="of the link that heard it")
    frame: str | None = Field(default=None, max_length=200_000, description="the frame's envelope, in hexadecimal")


def digest(tokens: Iterable[Hashable]) -> str:
    """A short text that is the same for the same tokens, whatever their order."""
    made = blake2b(digest_size=8)
    for text in sorted(map(repr, tokens)):
        made.update(text.encode("utf-8", "surrogatepass"))
    return made.hexdigest()
