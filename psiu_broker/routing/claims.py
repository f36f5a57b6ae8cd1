"""Which broker claims which robot, and who of them owns it: a rule that needs no vote.

A claim carries a `term`. Whoever takes a robot over claims it with a term higher than any it has
seen; the live claim with the highest term is the owner's, and where two are alike the broker whose
name sorts last. So all brokers that see the same claims name the same owner.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from psiu_broker.frame import Address

AGES_S: Final = (0, 30, 120)
"""A claim says how long ago its robot was heard no finer than this, so that a robot that talks changes nothing.

Each change is a token to every broker: with a step of 5 s, 1000 robots that talk every 7 s made 560 a second at each.
"""

TERM_MAX: Final = 2**53
"""Terms are below; more changes of owner than this are no robot's."""

BEST: Final = 10
"""The quality of a link on which every frame checked out."""


class Claim(NamedTuple):
    """One broker's word that a robot is behind one of its links."""

    robot: Address
    number: Address | None
    """Its PSIU HEXA address, where it has a name as well."""
    protocol: str
    link: str
    term: int
    quality: int
    """Of what is heard on the link, the tenths that check out: 0–10."""
    age_s: int | None
    """The one of `AGES_S` that has passed since it was heard; None: configured, never heard."""

    @property
    def addresses(self) -> tuple[Address, ...]:
        return (self.robot,) if self.number is None else (self.robot, self.number)


def age_of(heard_at: float | None, now: float) -> int | None:
    """How a claim says the age of a robot last heard at `heard_at`."""
    return None if heard_at is None else max(age_s for age_s in AGES_S if age_s <= max(now - heard_at, 0))


class Claims:
    """The live claims of all brokers, our own among them, bounded for each broker."""

    def __init__(self, *, capacity: int = 4096) -> None:
        self._capacity = capacity
        self._by_robot: dict[Address, dict[str, Claim]] = {}
        self._by_broker: dict[str, set[Address]] = {}
        self._terms: dict[Address, int] = {}

    def __iter__(self) -> Iterator[tuple[str, Claim]]:
        """Every robot's owner and its claim."""
        return (held for robot in self._by_robot if (held := self.owner(robot)) is not None)

    def set(self, broker: str, claim: Claim) -> bool:
        """Note or renew a claim; False where the broker has too many."""
        robots = self._by_broker.setdefault(broker, set())
        if claim.robot not in robots and len(robots) >= self._capacity:
            return False
        robots.add(claim.robot)
        self._by_robot.setdefault(claim.robot, {})[broker] = claim
        self._note_term(claim)
        return True

    def remove(self, broker: str, robot: Address) -> None:
        """The broker claims the robot no more."""
        self._by_broker.get(broker, set()).discard(robot)
        claims = self._by_robot.get(robot)
        if claims is not None and claims.pop(broker, None) is not None and not claims:
            del self._by_robot[robot]

    def remove_broker(self, broker: str) -> list[Address]:
        """The broker is gone; the robots that it claimed."""
        robots = list(self._by_broker.pop(broker, ()))
        for robot in robots:
            self.remove(broker, robot)
        return robots

    def owner(self, robot: Address) -> tuple[str, Claim] | None:
        claims = self._by_robot.get(robot)
        return max(claims.items(), key=_rank) if claims else None

    def of(self, broker: str) -> dict[Address, Claim]:
        """What the broker claims."""
        return {robot: self._by_robot[robot][broker] for robot in self._by_broker.get(broker, ())}

    def find(self, broker: str, robot: Address) -> Claim | None:
        return self._by_robot.get(robot, {}).get(broker)

    def next_term(self, robot: Address) -> int:
        """Higher than that of any claim of this robot that was seen."""
        return min(self._terms.get(robot, 0) + 1, TERM_MAX - 1)

    def _note_term(self, claim: Claim) -> None:
        term = max(self._terms.pop(claim.robot, 0), claim.term)
        self._terms[claim.robot] = term  # at the end: the one noted longest ago is forgotten first
        if len(self._terms) > 4 * self._capacity:
            del self._terms[next(iter(self._terms))]


def _rank(held: tuple[str, Claim]) -> tuple[int, str]:
    broker, claim = held
    return claim.term, broker
