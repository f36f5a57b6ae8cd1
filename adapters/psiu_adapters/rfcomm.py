"""Bluetooth serial ports (RFCOMM): robots that we call, and phones and robots that call us."""

import asyncio
import re
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from psiu_adapters import rfcomm_socket
from psiu_adapters.bluez import Acceptor, Bluez, hang_up
from psiu_adapters.descriptor import DescriptorTransport
from psiu_adapters.system_bus import NoBluez
from psiu_broker.adapter import Adapter, Peer, Receiver, Transport
from psiu_broker.errors import LinkError

GUESSED_CHANNEL = 1
"""Where HC-05 and its kin have their serial port; used when nobody can look it up."""


def _bluetooth_address(value: str) -> str:
    if not re.fullmatch(r"([0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}", value):
        raise ValueError('not a Bluetooth address: six hex pairs such as "98:D3:31:00:00:01"')
    return value.upper()


class Rfcomm(Adapter):
    """A robot at `address`, or with `accept` everyone paired who calls this computer's serial port."""

    address: Annotated[str, AfterValidator(_bluetooth_address)] | None = Field(
        None, description='The robot\'s Bluetooth address, "98:D3:31:00:00:01"'
    )
    accept: bool = Field(False, description="Wait for paired phones and robots to call; each is a peer of its own")
    channel: int | None = Field(None, ge=1, le=30, description="RFCOMM channel; without it the robot is asked (SPP)")
    pin: str = Field(
        "1234", min_length=1, max_length=16, repr=False, description="What an unpaired robot asks for; HC-05: 1234"
    )
    controller: str = Field("hci0", pattern=r"^hci\d+$", description="This computer's Bluetooth controller")
    route: Literal["auto", "bluez", "socket"] = Field(
        "auto", description="bluez: over D-Bus, finds and pairs; socket: the kernel's, needs a paired robot"
    )
    discovery_s: float = Field(10.0, ge=0, le=60, description="How long to search for a robot that BlueZ does not know")
    connect_timeout_s: float = Field(20.0, gt=0, le=120, description="How long pairing and connecting may each take")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if (self.address is None) == (not self.accept):
            raise ValueError('give either address = "98:D3:31:00:00:01" (we call) or accept = true (they call)')
        if self.accept and self.route == "socket":
            raise ValueError('accept = true needs BlueZ: leave route = "socket" out')
        if self.channel is not None and (self.accept or self.route == "bluez"):
            raise ValueError('channel is for calling by route = "socket": BlueZ looks it up, leave one of them out')
        return self

    @property
    def many_peers(self) -> bool:
        return self.accept

    @property
    def reliable_stream(self) -> bool:
        return True

    def peer_named(self, text: str) -> Peer:
        return _bluetooth_address(text) if self.accept else super().peer_named(text)

    async def open(self, receiver: Receiver) -> Transport:
        if self.address is None:
            return await self._accept(receiver)
        if self.route == "socket" or self.channel is not None:
            return await self._by_socket(self.address, receiver)
        try:
            return await self._by_bluez(self.address, receiver)
        except NoBluez as no_bluez:
            if self.route == "bluez":
                raise
            try:
                return await self._by_socket(self.address, receiver)
            except LinkError as error:
                raise type(error)(f"{error} (and by BlueZ: {no_bluez})") from no_bluez

    async def changed(self) -> None:
        if self.route == "socket":
            await super().changed()
        bluez = Bluez.here()
        try:
            await bluez.bus.lease()
        except LinkError:
            await super().changed()
        try:
            await bluez.appeared(self.address, self.controller)
        finally:
            await bluez.bus.release()

    async def _by_bluez(self, address: str, receiver: Receiver) -> Transport:
        bluez = Bluez.here()
        await bluez.bus.lease()
        try:
            fd = await bluez.connect(
                address,
                controller=self.controller,
                pin=self.pin,
                discovery_s=self.discovery_s,
                timeout_s=self.connect_timeout_s,
            )
            return Called(fd, receiver, address, {"route": "bluez", "controller": self.controller}, bluez)
        except BaseException:
            await bluez.bus.release()
            raise

    async def _by_socket(self, address: str, receiver: Receiver) -> Transport:
        channel = self.channel or GUESSED_CHANNEL
        fd = await rfcomm_socket.connect(address, channel, self.connect_timeout_s)
        facts: dict[str, str | int | float] = {"route": "socket", "channel": channel}
        if self.channel is None:
            facts["remark"] = (
                f"no BlueZ to look the channel up: {GUESSED_CHANNEL} is a guess, set channel if it is wrong"
            )
        return Called(fd, receiver, address, facts)

    async def _accept(self, receiver: Receiver) -> Transport:
        bluez = Bluez.here()
        await bluez.bus.lease()
        try:
            transport = Accepting(receiver, self.controller, bluez)
            await bluez.accept(Acceptor(transport.connected, transport.stopped), controller=self.controller)
        except BaseException:
            await bluez.bus.release()
            raise
        return transport


class Called(DescriptorTransport):
    """The connection to a robot that we called."""

    def __init__(
        self,
        fd: int,
        receiver: Receiver,
        address: str,
        facts: Mapping[str, str | int | float],
        bluez: Bluez | None = None,
    ) -> None:
        rfcomm_socket.hold_little(fd)
        super().__init__(fd, receiver, close=lambda: hang_up(fd), name=address)
        self._address = address
        self._facts = facts
        self._bluez = bluez

    async def close(self) -> None:
        bluez, self._bluez = self._bluez, None
        try:
            if bluez is not None:
                bluez.forget(self._address)
            await super().close()
        finally:
            if bluez is not None:
                await bluez.bus.release()

    def status(self) -> Mapping[str, str | int | float]:
        return {"address": self._address, **self._facts}


class Accepting(Transport):
    """The connections of all who called us, each a peer by its Bluetooth address."""

    def __init__(self, receiver: Receiver, controller: str, bluez: Bluez) -> None:
        self._receiver = receiver
        self._controller = controller
        self._bluez = bluez
        self._callers: dict[Peer, DescriptorTransport] = {}
        self._closing: set[asyncio.Task[None]] = set()
        self._open = True
        self._lost = False

    @property
    def peers(self) -> Collection[Peer]:
        return self._callers.keys()

    def write(self, data: bytes, peer: Peer) -> bool:
        caller = self._callers.get(peer)
        return True if caller is None else caller.write(data, peer)

    async def close(self) -> None:
        if not self._open:
            return
        self._open = False
        self._bluez.stop_accepting(self._controller)
        try:
            for address in list(self._callers):
                self._drop(address)
            while self._closing:
                await asyncio.wait(self._closing)
        finally:
            await self._bluez.bus.release()

    def status(self) -> Mapping[str, str | int | float]:
        return {"route": "bluez", "controller": self._controller, "connected": len(self._callers)}

    def connected(self, address: str, fd: int) -> None:
        """`address` has called; a call of its own that is still there is dead."""
        if address in self._callers:
            self._caller_lost(address)
        self._bluez.keep(address, fd)

        def lost() -> None:
            # Said a turn late: by now the device may have called again, or the link be closed.
            if self._callers.get(address) is caller:
                self._caller_lost(address)

        rfcomm_socket.hold_little(fd)
        caller = DescriptorTransport(
            fd, _One(self._receiver, lost), peer=address, close=lambda: hang_up(fd), name=address
        )
        self._callers[address] = caller

    def stopped(self, error: LinkError) -> None:
        """BlueZ has gone, so nobody can call any more."""
        if self._open and not self._lost:
            self._lost = True
            self._receiver.lost(error)

    def _caller_lost(self, address: str) -> None:
        self._drop(address)
        if self._open:
            self._receiver.peer_lost(address)

    def _drop(self, address: Peer) -> None:
        self._bluez.forget(str(address))
        task = asyncio.get_running_loop().create_task(self._callers.pop(address).close())
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)


class _One:
    """The receiver of one caller: its loss is not the link's."""

    def __init__(self, receiver: Receiver, lost: Callable[[], None]) -> None:
        self.received = receiver.received
        self.writable = receiver.writable
        self.peer_lost = receiver.peer_lost
        self._lost = lost

    def lost(self, _error: LinkError, /) -> None:
        self._lost()
