"""What is done where brokers have lost sight of one another: Zenoh does, and does not always mend it.

Against the same trouble more is done each time: ask and declare anew, then connect anew with that
broker, at last with everybody. Each remedy is itself a trouble for others for a moment.
"""

import logging
import random
from collections.abc import Callable
from math import inf
from typing import Final, Literal

from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.bus import MeshBus, NoBus
from psiu_broker.mesh.neighbour import NEWCOMER_S, SILENT_S, UNHEARD_MAX, Neighbour, Neighbours, Remedy

log = logging.getLogger(__name__)

ANEW_EVERY_S: Final = 1.5
SILENT: Final = "announced and silent"
CUT_ALL_MAX: Final = 2
HANG_UP_EVERY_S: Final = 8.0
"""Ending every link is for what nothing else mends."""
DIFFERS_S: Final = 1.0
STRANGERS_MAX: Final = 256

Trouble = Literal["silent", "deaf", "unclear", "heard in part"]


class _Stranger:
    """A broker that is heard and not announced."""

    def __init__(self, name: str, zenoh_id: str, now: float) -> None:
        self.name = name
        self.zenoh_id = zenoh_id
        self.since = self.heard_at = now
        self.remedy = Remedy()


class Remedies:
    """Notices who has lost sight of us, or we of them, and does something about it.

    Args:
        unclear: called again and again with a broker whose claims are not what it says they are.
    """

    def __init__(self, own: str, neighbours: Neighbours, unclear: Callable[[Neighbour, float], None]) -> None:
        self.declared_anew = 0
        self._own = own
        self._neighbours = neighbours
        self._unclear = unclear
        self._bus: MeshBus = NoBus()
        self._strangers: dict[str, _Stranger] = {}
        self._awake_since = -inf
        self._hung_up_at = -inf
        self._anew_at = -inf
        self._anew_wanted: str | None = None
        """Why everything should be declared anew."""

    def attach(self, bus: MeshBus, now: float) -> None:
        """Everything is declared on `bus` now, for the first time."""
        self._bus = bus
        self._anew_wanted = None
        self._anew_at = now

    def detach(self) -> None:
        self._bus = NoBus()

    def woke(self, now: float) -> None:
        """We were not there for a while: that nobody was heard meanwhile means nothing."""
        self._awake_since = now

    def stranger(self, beat: Beat, now: float) -> None:
        """A beat of a broker that is not announced to us."""
        stranger = self._strangers.get(beat.broker)
        if stranger is None and len(self._strangers) < STRANGERS_MAX:
            stranger = self._strangers[beat.broker] = _Stranger(beat.broker, beat.zenoh_id, now)
        if stranger is not None:
            stranger.heard_at = now

    def known(self, name: str) -> None:
        """The broker is announced to us, after all."""
        self._strangers.pop(name, None)

    def unseen(self, now: float) -> list[str]:
        """The brokers that are heard and not announced, or announced otherwise than they say."""
        strangers = [each.name for each in self._strangers.values() if now - each.since > NEWCOMER_S]
        return strangers + [each.name for each in self._neighbours if self._trouble(each, now) == "unclear"]

    def tick(self, now: float) -> None:
        """To be called at each beat of ours."""
        for neighbour in self._neighbours:
            trouble = self._trouble(neighbour, now)
            if trouble is None:
                neighbour.remedy.over()
            elif neighbour.remedy.is_due(now):
                self._remedy(neighbour.name, neighbour.zenoh_id, neighbour.remedy, f"announced and {trouble}", now)
                if trouble == "unclear":
                    self._unclear(neighbour, now)
        for stranger in list(self._strangers.values()):
            if now - stranger.heard_at > SILENT_S:
                del self._strangers[stranger.name]
            elif now - stranger.since > NEWCOMER_S and stranger.remedy.is_due(now):
                self.ask_anew(stranger.name)
                self._remedy(stranger.name, stranger.zenoh_id, stranger.remedy, "heard and not announced", now)
        self._declare_what_is_wanted(now)

    def ask_anew(self, name: str) -> None:
        log.info("mesh: asking %s to declare anew what it has", name)
        self._bus.put_notice(name, Notice(broker=self._own))

    def declare_anew(self, now: float, why: str) -> None:
        """Declare everything anew, now or as soon as it was not just done."""
        self._anew_wanted = why
        self._declare_what_is_wanted(now)

    def _declare_what_is_wanted(self, now: float) -> None:
        why = self._anew_wanted
        if why is not None and now - self._anew_at >= ANEW_EVERY_S:
            self._anew_wanted = None
            self._anew_at = now
            self.declared_anew += 1
            log.warning("mesh: declaring everything anew: %s", why)
            self._bus.declare_anew()

    def _trouble(self, neighbour: Neighbour, now: float) -> Trouble | None:
        patience_s = SILENT_S if neighbour.beat_at is not None else NEWCOMER_S
        if now - max(neighbour.last_sign(), self._awake_since) > patience_s:
            return "silent"
        if neighbour.deaf_since is not None and now - neighbour.deaf_since > NEWCOMER_S:
            return "deaf"
        if neighbour.differs_since is not None and now - neighbour.differs_since > DIFFERS_S:
            return "unclear"
        if neighbour.unheard >= UNHEARD_MAX:
            return "heard in part"  # its beats come, and the frames that it counts in them do not
        return None

    def _remedy(self, name: str, zenoh_id: str, remedy: Remedy, trouble: str, now: float) -> None:
        """Do more each time against the same trouble with a broker: declare anew, then connect anew.

        In steps, because each remedy is itself a trouble for others for a moment; the last one, which
        ends every link, is for a broker that is announced and silent, and for twice at most. A link to
        one that is silent is ended first of all: Zenoh should have ended it, and what is declared would
        wait for room in it, and everything else for that.
        """
        linked = zenoh_id in self._bus.linked
        first = linked and trouble == SILENT and remedy.steps == 1
        if remedy.steps <= 2 and not first:
            self.declare_anew(now, f"{name} is {trouble}")
        elif linked:
            log.warning("mesh: connecting anew: %s is %s", name, trouble)
            self._bus.hang_up(zenoh_id)
        elif (
            trouble == SILENT
            and remedy.cut_all < CUT_ALL_MAX
            and now - self._hung_up_at >= HANG_UP_EVERY_S * random.uniform(1, 2)  # noqa: S311 - spreads, no secret
        ):
            remedy.cut_all += 1
            self._hung_up_at = now
            log.warning("mesh: connecting anew with everybody: %s is %s", name, trouble)
            self._bus.hang_up(None)
