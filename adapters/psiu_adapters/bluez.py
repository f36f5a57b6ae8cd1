"""BlueZ's serial port profile: one registration carries every RFCOMM link of the process.

A second registration of one profile is refused, so the links share this one and connections are
told apart by the address in the path of their device.
"""

import asyncio
import contextlib
import os
import socket
from collections import defaultdict
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from dbus_fast import Message, Variant

from psiu_adapters.system_bus import CALL_TIMEOUT_S, OBJECT_MANAGER, TIMEOUT, Refused, SystemBus, explained
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError, LinkLost

SERIAL_PORT = "00001101-0000-1000-8000-00805f9b34fb"

MANAGER_PATH = "/org/bluez"
ADAPTER = "org.bluez.Adapter1"
DEVICE = "org.bluez.Device1"
AGENT_MANAGER = "org.bluez.AgentManager1"
PROFILE_MANAGER = "org.bluez.ProfileManager1"
PROFILE_PATH = "/org/psiu/serial_port"
AGENT_PATH = "/org/psiu/agent"
REJECTED = "org.bluez.Error.Rejected"

Objects = dict[str, dict[str, dict[str, Variant]]]
"""What BlueZ manages: path, interface, property."""


@dataclass(frozen=True)
class Acceptor:
    """Who takes the connections that nobody here asked for."""

    connected: Callable[[str, int], None]
    """Takes the address and the descriptor, which is then its own."""
    lost: Callable[[LinkError], None]
    """BlueZ has gone: nothing will come any more."""


class Bluez:
    """The process's end of BlueZ, for use between `bus.lease` and `bus.release`."""

    def __init__(self) -> None:
        self.bus = SystemBus(self._asked, self._gone)
        self._registering = asyncio.Lock()
        self._registered = False
        # A controller can search or pair for one of us at a time; calls it queues by itself.
        self._searching: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._expected: dict[str, asyncio.Future[int]] = {}
        self._connections: dict[str, int] = {}
        self._acceptors: dict[str, Acceptor] = {}
        self._agent_users = 0
        self._pins: dict[str, str] = {}

    @staticmethod
    def here() -> "Bluez":
        """The one of the running event loop."""
        return _here.setdefault(asyncio.get_running_loop(), Bluez())

    async def connect(self, address: str, *, controller: str, pin: str, discovery_s: float, timeout_s: float) -> int:
        """Find, pair if need be, and connect the serial port of `address`: a descriptor, to be given to `hang_up`.

        Raises:
            LinkError: in words for a person.
        """
        if address in self._expected or address in self._connections:
            raise LinkBusy(f"{address} is used by another link of this broker: keep one of them")
        arrived: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._expected[address] = arrived
        try:
            await self._register()
            path = device_path(controller, address)
            if not await self._is_paired(path, controller):
                async with self._searching[controller]:
                    if not await self._find(path, address, controller, discovery_s):
                        await self._pair(path, address, pin, timeout_s)
            await self._connect_profile(path, arrived, timeout_s)
            fd = arrived.result()
        except BaseException as error:
            if arrived.done() and arrived.exception() is None:
                hang_up(arrived.result())
            if isinstance(error, Refused):
                raise explained(error, address) from error
            raise
        finally:
            arrived.cancel()
            del self._expected[address]
        self._connections[address] = fd
        return fd

    async def accept(self, acceptor: Acceptor, *, controller: str) -> None:
        """Give `acceptor` what calls in, until `stop_accepting`.

        Raises:
            LinkError: in words for a person.
        """
        try:
            await self._register()
            _check_powered(await self._objects(), controller)
            await self._agent_up()
        except Refused as refused:
            raise explained(refused, controller) from refused
        if controller in self._acceptors:
            self._agent_down()
            raise LinkBusy(f"another link of this broker accepts connections on {controller}: keep one of them")
        self._acceptors[controller] = acceptor

    def stop_accepting(self, controller: str) -> None:
        """The opposite of a successful `accept`."""
        del self._acceptors[controller]
        self._agent_down()

    def keep(self, address: str, fd: int) -> None:
        """An acceptor uses `fd`: it is shut down when BlueZ asks for that."""
        self._connections[address] = fd

    def forget(self, address: str) -> None:
        """The descriptor of `address` is about to be closed."""
        self._connections.pop(address, None)

    async def appeared(self, address: str | None, controller: str) -> None:
        """Return when bluetoothd, the controller or the device of `address` has come, or was switched on or paired."""
        controller_path = f"{MANAGER_PATH}/{controller}"
        path = device_path(controller, address) if address else ""

        def relevant(message: Message) -> bool:
            if message.member == "NameOwnerChanged":
                return bool(message.body[2])
            if message.member == "InterfacesAdded":
                return message.body[0] in (controller_path, path)
            name = {controller_path: "Powered", path: "Paired"}.get(message.path or "")
            return name is not None and _value(message.body[1], name) is True

        with self.bus.watch(relevant) as seen:
            await seen

    def _gone(self, why: str) -> None:
        """Descriptors live on or fail by themselves; all else is void."""
        self._registered = False
        self._agent_users = 0
        for arrived in self._expected.values():
            if not arrived.done():
                arrived.set_exception(LinkLost(why))
                arrived.exception()
        for acceptor in tuple(self._acceptors.values()):
            acceptor.lost(LinkLost(why))

    async def _register(self) -> None:
        async with self._registering:
            if self._registered:
                return
            # No Role: one registration serves both directions.
            options = {"Name": Variant("s", "PSIU"), "AutoConnect": Variant("b", False)}
            body = [PROFILE_PATH, SERIAL_PORT, options]
            try:
                await self.bus.call(MANAGER_PATH, PROFILE_MANAGER, "RegisterProfile", "osa{sv}", body)
            except Refused as refused:
                if not refused.name.endswith("AlreadyExists"):
                    raise
            self._registered = True

    async def _objects(self) -> Objects:
        objects: Objects
        (objects,) = await self.bus.call("/", OBJECT_MANAGER, "GetManagedObjects")
        return objects

    async def _is_paired(self, path: str, controller: str) -> bool | None:
        """Whether the device of `path` is paired; None if BlueZ does not know it."""
        objects = await self._objects()
        _check_powered(objects, controller)
        device = objects.get(path, {}).get(DEVICE)
        return None if device is None else _value(device, "Paired") is True

    async def _find(self, path: str, address: str, controller: str, discovery_s: float) -> bool:
        """Whether the device is paired; searched for if BlueZ does not know it."""
        paired = await self._is_paired(path, controller)
        if paired is None:
            await self._discover(f"{MANAGER_PATH}/{controller}", path, discovery_s)
            paired = await self._is_paired(path, controller)
        if paired is None:
            raise LinkAbsent(f"{address} is not in reach: switch it on (searched for {discovery_s:g} s)")
        return paired

    async def _discover(self, controller_path: str, path: str, discovery_s: float) -> None:
        """Return when BlueZ knows the device of `path`, or when the time is over."""
        # Modules of Bluetooth 2 are found by an inquiry only.
        body = [{"Transport": Variant("s", "bredr")}]
        await self.bus.call(controller_path, ADAPTER, "SetDiscoveryFilter", "a{sv}", body)
        with self.bus.watch(lambda m: m.member == "InterfacesAdded" and m.body[0] == path) as seen:
            try:
                await self.bus.call(controller_path, ADAPTER, "StartDiscovery")
                await asyncio.wait({seen}, timeout=discovery_s)
            finally:
                self.bus.tell(controller_path, ADAPTER, "StopDiscovery")

    async def _pair(self, path: str, address: str, pin: str, timeout_s: float) -> None:
        self._pins[address] = pin
        try:
            async with self._agent():
                await self.bus.call(path, DEVICE, "Pair", timeout_s=timeout_s)
        except BaseException as error:
            if isinstance(error, Refused) and error.name.endswith("AlreadyExists"):
                return
            if not isinstance(error, Refused) or error.name == TIMEOUT:
                self.bus.tell(path, DEVICE, "CancelPairing")
            raise
        finally:
            del self._pins[address]

    async def _connect_profile(self, path: str, arrived: "asyncio.Future[int]", timeout_s: float) -> None:
        """Return when `arrived` has its descriptor, which comes before the reply to ConnectProfile."""

        def settled(message: Message) -> bool:
            changed = message.member == "PropertiesChanged" and message.path == path
            return changed and _value(message.body[1], "ServicesResolved") is True

        async def ask() -> None:
            await self.bus.call(path, DEVICE, "ConnectProfile", "s", [SERIAL_PORT], timeout_s=timeout_s)

        try:
            with self.bus.watch(settled) as seen:
                try:
                    await ask()
                except Refused as refused:
                    if not refused.name.endswith("InProgress"):
                        raise
                    # BlueZ reads the services of a device that it has just paired with.
                    await asyncio.wait({seen}, timeout=timeout_s)
                    await ask()
            async with asyncio.timeout(CALL_TIMEOUT_S):
                await asyncio.wait({arrived})
        except BaseException as error:
            stale = isinstance(error, Refused) and error.name.endswith("AlreadyConnected")
            if stale and arrived.done():
                return
            if stale or not isinstance(error, Refused) or error.name == TIMEOUT:
                self.bus.tell(path, DEVICE, "DisconnectProfile", "s", [SERIAL_PORT])
            if isinstance(error, TimeoutError):
                raise Refused(TIMEOUT, "connected, but no descriptor came") from None
            raise

    @contextlib.asynccontextmanager
    async def _agent(self) -> AsyncIterator[None]:
        await self._agent_up()
        try:
            yield
        finally:
            self._agent_down()

    async def _agent_up(self) -> None:
        """Be the default agent: only while somebody needs it, since the desktop's agent waits behind ours."""
        async with self._registering:
            self._agent_users += 1
            try:
                if self._agent_users == 1:
                    body = [AGENT_PATH, "KeyboardDisplay"]
                    await self.bus.call(MANAGER_PATH, AGENT_MANAGER, "RegisterAgent", "os", body)
                    await self.bus.call(MANAGER_PATH, AGENT_MANAGER, "RequestDefaultAgent", "o", [AGENT_PATH])
            except BaseException:
                self._agent_down()
                raise

    def _agent_down(self) -> None:
        self._agent_users = max(0, self._agent_users - 1)
        if not self._agent_users:
            self.bus.tell(MANAGER_PATH, AGENT_MANAGER, "UnregisterAgent", "o", [AGENT_PATH])

    def _asked(self, message: Message) -> Message | None:
        if message.path == PROFILE_PATH and message.interface == "org.bluez.Profile1":
            return self._profile(message)
        if message.path == AGENT_PATH and message.interface == "org.bluez.Agent1":
            return self._agent_answer(message)
        return None

    def _profile(self, message: Message) -> Message:
        if message.member == "Release":
            self._gone("bluetoothd has given up the serial port profile")
            return Message.new_method_return(message)
        address = _address(message.body[0])
        if message.member == "NewConnection":
            return self._new_connection(message, address, self._acceptor(message.body[0]))
        if message.member == "RequestDisconnection" and address in self._connections:
            hang_up(os.dup(self._connections[address]))
        return Message.new_method_return(message)

    def _acceptor(self, path: str) -> Acceptor | None:
        """Who accepts what the device of `path` calls."""
        return self._acceptors.get(path.removeprefix(f"{MANAGER_PATH}/").partition("/")[0])

    def _new_connection(self, message: Message, address: str, acceptor: Acceptor | None) -> Message:
        fd = message.unix_fds[message.body[1]]
        os.set_inheritable(fd, False)
        arrived = self._expected.get(address)
        if arrived is not None and not arrived.done():
            arrived.set_result(fd)
        elif acceptor is not None:
            acceptor.connected(address, fd)
        else:
            hang_up(fd)
            return Message.new_error(message, REJECTED, "no link of the broker waits for this device")
        return Message.new_method_return(message)

    def _agent_answer(self, message: Message) -> Message:
        """Yes to a device that we are pairing with, and to a paired one that calls an accepting link."""
        if message.member in ("Release", "Cancel"):
            return Message.new_method_return(message)
        pin = self._pins.get(_address(message.body[0]))
        if message.member == "AuthorizeService":
            if message.body[1].lower() == SERIAL_PORT and (
                self._acceptor(message.body[0]) is not None or pin is not None
            ):
                return Message.new_method_return(message)
        elif pin is not None:
            if message.member == "RequestPinCode":
                return Message.new_method_return(message, "s", [pin])
            if message.member != "RequestPasskey":
                return Message.new_method_return(message)
            if pin.isdecimal() and len(pin) <= 6:
                return Message.new_method_return(message, "u", [int(pin)])
        return Message.new_error(message, REJECTED, "not a device that the broker pairs with")


def hang_up(fd: int) -> None:
    """Disconnect and close `fd`: bluetoothd has a copy, so closing ours alone would leave the robot connected."""
    with socket.socket(fileno=fd) as connection, contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def device_path(controller: str, address: str) -> str:
    """The object path of `address` behind `controller`."""
    return f"{MANAGER_PATH}/{controller}/dev_{address.replace(':', '_')}"


def _address(path: str) -> str:
    return path.rpartition("/dev_")[2].replace("_", ":")


def _check_powered(objects: Objects, controller: str) -> None:
    """Raises LinkAbsent unless `controller` is there and switched on."""
    interfaces = objects.get(f"{MANAGER_PATH}/{controller}", {})
    if ADAPTER not in interfaces:
        there = ", ".join(sorted(p.rpartition("/")[2] for p, i in objects.items() if ADAPTER in i)) or "none"
        raise LinkAbsent(f"no Bluetooth controller {controller}: plug it in, or name another (there: {there})")
    if _value(interfaces[ADAPTER], "Powered") is not True:
        raise LinkAbsent(f"Bluetooth controller {controller} is switched off: bluetoothctl power on")


def _value(properties: dict[str, Variant], name: str) -> Any:
    found = properties.get(name)
    return None if found is None else found.value


_here: WeakKeyDictionary[asyncio.AbstractEventLoop, Bluez] = WeakKeyDictionary()
