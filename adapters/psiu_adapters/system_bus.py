"""The D-Bus system bus as the way to bluetoothd: calls with a deadline, signals to wait for."""

import asyncio
import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from dbus_fast import BusType, DBusFastError, Message, MessageFlag, MessageType
from dbus_fast.aio import MessageBus

from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

CALL_TIMEOUT_S = 10.0

BLUEZ = "org.bluez"
BUS = "org.freedesktop.DBus"
OBJECT_MANAGER = "org.freedesktop.DBus.ObjectManager"
PROPERTIES = "org.freedesktop.DBus.Properties"

MATCHES = (
    f"type='signal',sender='{BLUEZ}',interface='{OBJECT_MANAGER}',member='InterfacesAdded'",
    f"type='signal',sender='{BLUEZ}',interface='{PROPERTIES}',member='PropertiesChanged'",
    f"type='signal',sender='{BUS}',member='NameOwnerChanged',arg0='{BLUEZ}'",
)


class NoBluez(LinkAbsent):
    """There is no D-Bus or no bluetoothd: BlueZ is no way at all for now."""


class Refused(Exception):
    """An error reply of BlueZ, or none within the time: `name` is a D-Bus error name or `TIMEOUT`."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(f"{name} {text}")
        self.name = name
        self.text = text


TIMEOUT = "timeout"

REASONS: Sequence[tuple[str, type[LinkError], str]] = (
    (
        "serviceunknown|namehasnoowner|noreply|error.spawn|nosuchunit|loadfailed",
        NoBluez,
        "bluetoothd is not running: systemctl start bluetooth",
    ),
    ("accessdenied", LinkBusy, "D-Bus keeps this user from bluetoothd: add it to the group bluetooth"),
    (
        "uuid already registered",
        LinkBusy,
        'another program has registered the serial port profile: stop it, or set route = "socket"',
    ),
    ("notready|not-powered", LinkAbsent, "the Bluetooth controller is switched off: bluetoothctl power on"),
    (
        "authentication|key-missing",
        LinkAbsent,
        "{0} would not pair: see that pin is right, then bluetoothctl remove {0}",
    ),
    ("refused", LinkBusy, "{0} refuses the connection: see that nothing else is connected to it"),
    ("inprogress|busy|alreadyconnected", LinkBusy, "{0} is busy: another program connects or pairs with it"),
    ("profile-unavailable|notavailable", LinkAbsent, "{0} shows no serial port: if it has one, set channel"),
    ("unknownobject|unknownmethod|doesnotexist", LinkAbsent, "{0} is not known to BlueZ any more: switch it on"),
    (
        "page-timeout|page timeout|host is down|connectionattemptfailed|no route|timed out|^timeout",
        LinkAbsent,
        "{0} does not answer: switch it on and bring it into reach",
    ),
)
"""What BlueZ says (a pattern in name and text, lower case), and what it means for the user; first match."""


def explained(refused: Refused, who: str) -> LinkError:
    """What `refused` means for the person who wants `who` (an address or a controller)."""
    said = str(refused).lower()
    for pattern, kind, text in REASONS:
        if re.search(pattern, said):
            return kind(text.format(who))
    return LinkAbsent(f"{who}: BlueZ says {refused.text or refused.name}")


class SystemBus:
    """One connection, made by the first `lease` and ended by the last `release`.

    `asked` answers a method call (None: not ours); `gone` is told whenever what was registered is void.
    """

    def __init__(self, asked: Callable[[Message], Message | None], gone: Callable[[str], None]) -> None:
        self._asked = asked
        self._gone = gone
        self._bus: MessageBus | None = None
        self._ended: asyncio.Future[Any] | None = None
        self._users = 0
        self._connecting = asyncio.Lock()
        self._watches: list[tuple[Callable[[Message], bool], asyncio.Future[None]]] = []

    async def lease(self) -> None:
        """Connect unless it is done.

        Raises:
            NoBluez: there is no system bus.
        """
        async with self._connecting:
            if self._bus is None:
                await self._connect()
            self._users += 1

    async def release(self) -> None:
        """The last one disconnects, by which BlueZ forgets all that is ours."""
        self._users -= 1
        if self._users or self._bus is None or self._ended is None:
            return
        ended = self._ended
        self._leave()
        await asyncio.wait({ended}, timeout=1)

    async def call(
        self,
        path: str,
        interface: str,
        member: str,
        signature: str = "",
        body: Sequence[Any] = (),
        *,
        timeout_s: float = CALL_TIMEOUT_S,
        destination: str = BLUEZ,
    ) -> list[Any]:
        """The reply's body.

        Raises:
            Refused: an error reply, or none in `timeout_s`.
            NoBluez: the bus has gone.
        """
        if self._bus is None or not self._bus.connected:
            raise NoBluez("D-Bus has gone: waiting for it")
        message = Message(destination, path, interface, member, signature=signature, body=list(body))
        try:
            async with asyncio.timeout(timeout_s):
                reply = await self._bus.call(message)
        except TimeoutError:
            raise Refused(TIMEOUT, f"no answer to {member} in {timeout_s:g} s") from None
        except (OSError, EOFError, DBusFastError) as error:
            raise NoBluez(f"D-Bus has gone ({error}): waiting for it") from error
        if reply is None:
            raise NoBluez("D-Bus has gone: waiting for it")
        if reply.message_type is MessageType.ERROR:
            raise Refused(reply.error_name or "", str(reply.body[0]) if reply.body else "")
        return list(reply.body)

    def tell(self, path: str, interface: str, member: str, signature: str = "", body: Sequence[Any] = ()) -> None:
        """A call whose answer nobody waits for: how what was begun is broken off."""
        if self._bus is not None and self._bus.connected:
            flags = MessageFlag.NO_REPLY_EXPECTED
            self._bus.send(Message(BLUEZ, path, interface, member, signature=signature, body=list(body), flags=flags))

    @contextlib.contextmanager
    def watch(self, wanted: Callable[[Message], bool]) -> Iterator["asyncio.Future[None]"]:
        """A future that is done by the first signal that is `wanted`, or when the bus goes away."""
        seen: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        watch = (wanted, seen)
        self._watches.append(watch)
        try:
            yield seen
        finally:
            self._watches.remove(watch)
            seen.cancel()

    async def _connect(self) -> None:
        try:
            async with asyncio.timeout(CALL_TIMEOUT_S):
                bus = MessageBus(bus_type=BusType.SYSTEM, negotiate_unix_fd=True)
                await bus.connect()
        except (OSError, EOFError, DBusFastError) as error:
            raise NoBluez(f"there is no D-Bus system bus ({error}): start dbus") from error
        self._bus = bus
        self._ended = asyncio.ensure_future(bus.wait_for_disconnect())  # type: ignore[no-untyped-call]
        self._ended.add_done_callback(lambda ended: self._bus_ended(bus, ended))
        bus.add_message_handler(self._handle)
        try:
            for rule in MATCHES:
                await self.call("/org/freedesktop/DBus", BUS, "AddMatch", "s", [rule], destination=BUS)
        except BaseException as error:
            self._leave()
            if isinstance(error, Refused):
                raise NoBluez(f"the D-Bus system bus refuses us: {error.text}") from error
            raise

    def _leave(self) -> None:
        if self._bus is not None:
            self._bus.disconnect()
        self._bus = None
        self._ended = None
        self._gone("the broker has left D-Bus")

    def _bus_ended(self, bus: MessageBus, ended: "asyncio.Future[Any]") -> None:
        if not ended.cancelled():
            ended.exception()
        if self._bus is bus:
            self._bus = None
            self._ended = None
            self._gone("D-Bus has gone")
            for _, seen in self._watches:
                if not seen.done():
                    seen.set_result(None)

    def _handle(self, message: Message) -> Message | bool | None:
        """Everything that comes over the bus passes here; None: not for us."""
        if message.message_type is MessageType.METHOD_CALL:
            reply = self._asked(message)
            return True if reply is not None and message.flags & MessageFlag.NO_REPLY_EXPECTED else reply
        if message.message_type is MessageType.SIGNAL:
            if message.member == "NameOwnerChanged" and message.body[0] == BLUEZ and message.body[1]:
                self._gone("bluetoothd has stopped or started anew")
            for wanted, seen in list(self._watches):
                if not seen.done() and wanted(message):
                    seen.set_result(None)
        return None
