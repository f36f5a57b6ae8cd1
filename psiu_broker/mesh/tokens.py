"""What brokers have declared: each claim is a token on the bus, and of some no news comes that they went."""

from collections.abc import Callable, Iterator
from math import inf
from typing import Final

from psiu_broker.frame import Address
from psiu_broker.mesh.beat import digest
from psiu_broker.routing.claims import Claim

CLAIMS_MAX: Final = 4096
"""Of one broker."""
EDITIONS_MAX: Final = 16
LIVES_MAX: Final = 1024


class Tokens:
    """The claims that one life of a broker has declared now: some twice for a moment, while all is declared anew."""

    __slots__ = ("_claims", "_digest", "_round", "asked_at", "renewed")

    def __init__(self) -> None:
        self._claims: dict[Address, list[tuple[int, Claim]]] = {}
        """With the round of asking in which they were declared, the oldest first."""
        self._digest: str | None = None
        self._round = 0
        self.asked_at = -inf
        self.renewed = False
        """Since the last `ask`, the broker has declared itself anew, and so all its claims."""

    def __iter__(self) -> Iterator[Claim]:
        """The newest claim of each robot."""
        return (held[-1][1] for held in self._claims.values())

    @property
    def digest(self) -> str:
        if self._digest is None:
            self._digest = digest({claim for held in self._claims.values() for _, claim in held})
        return self._digest

    def add(self, claim: Claim) -> None:
        self._digest = None
        if claim.robot in self._claims or len(self._claims) < CLAIMS_MAX:
            held = self._claims.setdefault(claim.robot, [])
            if len(held) < EDITIONS_MAX:
                held.append((self._round, claim))

    def remove(self, claim: Claim) -> Claim | None:
        """The claim that the broker still has for the robot."""
        self._digest = None
        held = self._claims.get(claim.robot, [])
        declared = next((each for each in held if each[1] == claim), None)
        if declared is not None:
            held.remove(declared)
        if not held:
            self._claims.pop(claim.robot, None)
            return None
        return held[-1][1]

    def ask(self, now: float) -> None:
        """The broker is asked to declare anew what it has."""
        self.asked_at = now
        self._round += 1
        self.renewed = False

    def sweep(self) -> list[Address]:
        """Forget what was not declared anew since we asked; of which robots."""
        self._digest = None
        self.renewed = False
        self.asked_at = -inf
        changed = []
        for robot, held in list(self._claims.items()):
            kept = [each for each in held if each[0] == self._round]
            if kept != held:
                changed.append(robot)
                self._claims[robot] = kept
                if not kept:
                    del self._claims[robot]
        return changed

    def find(self, robot: Address) -> Claim | None:
        held = self._claims.get(robot)
        return held[-1][1] if held else None


class AllTokens:
    """By broker and life, also of those that are not announced (yet, or any more).

    Args:
        lives: whether a broker is there in that life; its tokens are never forgotten for others'.
    """

    def __init__(self, lives: Callable[[str, int], bool]) -> None:
        self._of: dict[tuple[str, int], Tokens] = {}
        self._lives = lives

    def of(self, broker: str, epoch: int) -> Tokens:
        tokens = self._of.get((broker, epoch))
        if tokens is None:
            if len(self._of) >= LIVES_MAX:
                gone = (each for each in self._of if not self._lives(*each))
                self._of.pop(next(gone, (broker, epoch)), None)
            tokens = self._of[broker, epoch] = Tokens()
        return tokens

    def clear(self) -> None:
        self._of.clear()
