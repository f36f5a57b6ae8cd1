"""Trunks: the Zenoh session between two brokers, carried over any reliable stream.

Zenoh's own link is a Unix socket at both ends; the bytes travel between them in chunks over the
adapter's stream, so that the Zenoh connection may end and begin while the stream stays.
"""

from psiu_broker.trunk.trunk import Trunk
from psiu_broker.trunk.trunks import Endpoints, Trunks

__all__ = ["Endpoints", "Trunk", "Trunks"]
