"""Nobody but a broker relays.

Zenoh's rules judge what programs say, not what its routers tell one another of ways: one with a listener's certificate
could say that the way to every broker leads through it, and then pass nothing on. So whoever comes as a router and is
no broker by its certificate is hung up on, each time. Where the brokers are routers themselves, a message may still
meet it in that moment; a way that is lost for good, none does.
"""

import logging
from collections.abc import Collection
from typing import Any, Final

import zenoh

from psiu_broker.bus.access import TRUNKS
from psiu_broker.bus.hang_up import hang_up
from psiu_broker.bus.session import Session

logger = logging.getLogger(__name__)

RING: Final = 256


async def refuse_routers(session: Session, brokers: Collection[str], *, trunks: bool) -> None:
    """Hang up from now on on every router that is none of `brokers`, nor comes by one of our `trunks`.

    Raises:
        BusError: the session is closed or lost.
    """
    told: set[str] = set()

    def belongs(link: zenoh.Link) -> bool:
        return link.auth_identifier in brokers or (trunks and str(link.src).startswith(f"{TRUNKS}/"))

    def look(event: Any) -> None:
        """On Zenoh's news of a link: at once, in the thread that reads it."""
        link = event.link
        if event.kind != zenoh.SampleKind.PUT or belongs(link):
            return
        routers = {str(each.zid) for each in session.zenoh.info.transports() if each.whatami == zenoh.WhatAmI.ROUTER}
        if str(link.zid) in routers:
            hang_up([(str(link.src), str(link.dst))])
            name = link.auth_identifier or "somebody"
            if name not in told:
                told.add(name)
                logger.warning("%s comes as a router from %s, and is no broker: hung up", name, link.dst)

    def listen() -> Any:
        return session.zenoh.info.declare_link_events_listener(zenoh.handlers.RingChannel(RING), history=True)

    await session.serve(listen, look, lambda _: None, name="bus-routers")
