"""One trunk's life: open by its adapter, back off, greet, carry, come back."""

import logging
import time
from collections.abc import Callable
from typing import ClassVar

from psiu_broker.adapter import Peer, Transport
from psiu_broker.config import TrunkConfiguration
from psiu_broker.errors import LinkError
from psiu_broker.kept import FIRST_PAUSE_S, Kept
from psiu_broker.trunk.channel import Channel
from psiu_broker.trunk.local import Meeting
from psiu_broker.trunk.wire import Greeting

log = logging.getLogger(__name__)


class Trunk(Kept):
    """A trunk that keeps itself alive. It has one far end, or where its adapter takes callers, one for each."""

    kind: ClassVar[str] = "trunk"

    def __init__(
        self,
        configuration: TrunkConfiguration,
        broker: str,
        epoch: str,
        meeting: Meeting,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(configuration.name, configuration.adapter, clock)
        self.configuration = configuration
        self.bytes_in = self.bytes_out = 0
        self.overruns = 0
        """Zenoh connections that were given up because our session did not read."""
        self._own = Greeting(broker, epoch, configuration.adapter.many_peers)
        self._meeting = meeting
        self._channels: dict[Peer, Channel] = {}

    @property
    def far(self) -> list[str]:
        """The brokers that this trunk reaches now."""
        return sorted(channel.far.broker for channel in self._channels.values() if channel.far is not None)

    def move(self, meeting: Meeting) -> None:
        """The broker has another Zenoh session, which is at `meeting`."""
        self._meeting = meeting
        for channel in list(self._channels.values()):
            channel.move(meeting)

    # What the transport tells us: adapter.Receiver.

    def received(self, data: bytes, peer: Peer) -> None:
        if self._lost is None or self._lost.done():
            return  # a channel has failed, and its transport is not closed yet
        self.bytes_in += len(data)
        (self._channels.get(peer) or self._channel(peer)).received(data)

    def writable(self) -> None:
        for channel in list(self._channels.values()):
            channel.writable()

    def peer_lost(self, peer: Peer) -> None:
        channel = self._channels.pop(peer, None)
        if channel is not None:
            who = peer if channel.far is None else channel.far.broker
            channel.close()
            self._look(f"{who} has gone; waiting for a broker to call")

    def connected(self, transport: Transport) -> None:
        self._transport = transport
        self.writable()  # who spoke before now has its greeting still to come
        if not self._own.many:
            for peer in transport.peers:
                if peer not in self._channels:
                    self._channel(peer)
            self._look("connected; waiting for the far end to say who it is")
        else:
            self._look("waiting for a broker to call")

    # What the channels tell us: channel.Host.

    def greeted(self, channel: Channel) -> None:
        self.pause_s = FIRST_PAUSE_S
        log.info("trunk %s: %s is at the far end", self.name, channel.far and channel.far.broker)
        self._look(None)

    def failed(self, channel: Channel, error: LinkError) -> None:
        if not self._own.many:
            if channel.silent:
                self.pause_s = FIRST_PAUSE_S  # else two ends that open the stream in turns might never meet
            self.lost(error)
            return
        # The others go on; this one is heard no more until it calls again.
        who = next((peer for peer, each in self._channels.items() if each is channel), None)
        log.warning("trunk %s: %s: %s", self.name, who, error)
        self._look(f"{who}: {error}")

    def overran(self, channel: Channel) -> None:
        self.overruns += 1
        log.warning("trunk %s: Zenoh does not read; its connection is given up", self.name)

    # Inside.

    def _channel(self, peer: Peer) -> Channel:
        channel = self._channels[peer] = Channel(self._own, self._meeting, self, lambda data: self._write(data, peer))
        return channel

    def _write(self, data: bytes, peer: Peer) -> bool:
        if self._transport is None or not self._transport.write(data, peer):
            return False
        self.bytes_out += len(data)
        return True

    def _look(self, reason: str | None) -> None:
        """Open where there is anybody at a far end, else waiting for `reason`."""
        if self._transport is not None:
            if self.far:
                self._set_state("open", None)
            else:
                self._set_state("waiting" if self._own.many else "opening", reason)

    def _down(self, reason: str) -> None:
        if self._transport is None and not self._channels:
            return
        self._transport = None
        channels, self._channels = self._channels, {}
        for channel in channels.values():
            channel.close()
        self._set_state("waiting", reason)
