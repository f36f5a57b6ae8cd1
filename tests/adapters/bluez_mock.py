# ruff: noqa: N802
"""A dbusmock template: bluetoothd with a controller hci0, or with `controllers`, for the system's Python.

A robot is switched on when a Unix socket listens in the directory `robots` under its address
(underscores for colons). Parameters: robots, powered, known = {address: {"paired": bool, "pin": str,
"controller": str}}, hidden = the same, found by an inquiry. ConnectProfile to a robot that is off
fails at once, or with the PIN "silent" never answers. Interface org.psiu.Mock steers it.
"""

import socket
from pathlib import Path

import dbus
from dbusmock import mockobject
from gi.repository import GLib

BUS_NAME = "org.bluez"
MAIN_OBJ = "/"
SYSTEM_BUS = True
IS_OBJECT_MANAGER = True

OBJECT_MANAGER = "org.freedesktop.DBus.ObjectManager"
ADAPTER = "org.bluez.Adapter1"
DEVICE = "org.bluez.Device1"
STEER = "org.psiu.Mock"
CONTROLLER = "/org/bluez/hci0"

state = {"log": [], "profile": None, "agents": {}, "default": None, "robots": "", "hidden": {}, "pins": {}, "calls": {}}
state["behind"] = {}
state["waiting"] = []


def failure(name, text):
    return dbus.exceptions.DBusException(text, name="org.bluez.Error." + name)


def path_of(address):
    return "/org/bluez/" + state["behind"].get(address, "hci0") + "/dev_" + address.replace(":", "_")


def load(mock, parameters):
    state["root"] = mock
    state["robots"] = parameters["robots"]
    state["hidden"] = dict(parameters.get("hidden", {}))
    mock.AddObject("/org/bluez", "org.bluez.ProfileManager1", {}, [])
    for controller in parameters.get("controllers", ["hci0"]):
        powered = {"Powered": dbus.Boolean(parameters.get("powered", True))}
        mock.AddObject("/org/bluez/" + controller, ADAPTER, powered, [])
    for address, device in parameters.get("known", {}).items():
        add_device(address, device)


def add_device(address, device):
    root = state["root"]
    state["behind"][address] = device.get("controller", "hci0")
    properties = {"Address": dbus.String(address), "Paired": dbus.Boolean(device.get("paired", False))}
    properties["ServicesResolved"] = dbus.Boolean(False)
    state["pins"][path_of(address)] = device.get("pin", "1234")
    root.AddObject(path_of(address), DEVICE, properties, [])
    signal = [dbus.ObjectPath(path_of(address)), {DEVICE: properties}]
    root.EmitSignal(OBJECT_MANAGER, "InterfacesAdded", "oa{sa{sv}}", signal)


def note(what):
    state["log"].append(what)


@dbus.service.method("org.bluez.ProfileManager1", in_signature="osa{sv}", out_signature="", sender_keyword="sender")
def RegisterProfile(self, path, uuid, options, sender=None):
    note("RegisterProfile")
    if state["profile"] and state["profile"][0] in self.connection.list_names():
        raise failure("NotPermitted", "UUID already registered")
    if not options or "Role" in options:
        raise failure("InvalidArguments", "Invalid arguments in method call")
    state["profile"] = (sender, path)


@dbus.service.method("org.bluez.AgentManager1", in_signature="os", out_signature="", sender_keyword="sender")
def RegisterAgent(self, path, capability, sender=None):
    note("RegisterAgent " + capability)
    if sender in state["agents"]:
        raise failure("AlreadyExists", "Already Exists")
    state["agents"][sender] = path


@dbus.service.method("org.bluez.AgentManager1", in_signature="o", out_signature="", sender_keyword="sender")
def RequestDefaultAgent(self, path, sender=None):
    state["default"] = sender


@dbus.service.method("org.bluez.AgentManager1", in_signature="o", out_signature="", sender_keyword="sender")
def UnregisterAgent(self, path, sender=None):
    note("UnregisterAgent")
    if state["agents"].pop(sender, None) is None:
        raise failure("DoesNotExist", "Does Not Exist")
    state["default"] = None


@dbus.service.method(ADAPTER, in_signature="a{sv}", out_signature="")
def SetDiscoveryFilter(self, wanted):
    note("SetDiscoveryFilter " + wanted["Transport"])


@dbus.service.method(ADAPTER, in_signature="", out_signature="")
def StartDiscovery(self):
    note("StartDiscovery")

    def inquire():
        while state["hidden"]:
            add_device(*state["hidden"].popitem())

    GLib.timeout_add(20, inquire)


@dbus.service.method(ADAPTER, in_signature="", out_signature="")
def StopDiscovery(self):
    note("StopDiscovery")


def ask_agent(member, signature, arguments, done, failed):
    sender = state["default"]
    if sender not in state["agents"]:
        failed(failure("AuthenticationFailed", "Authentication Failed"))
        return
    state["root"].connection.call_async(
        sender, state["agents"][sender], "org.bluez.Agent1", member, signature, arguments, done, failed
    )


@dbus.service.method(DEVICE, in_signature="", out_signature="", async_callbacks=("done", "failed"))
def Pair(self, done=None, failed=None):
    note("Pair")
    if not Path(socket_of(self.path)).exists():
        raise failure("ConnectionAttemptFailed", "Page Timeout")

    def told(pin):
        note("PIN " + pin)
        if pin != state["pins"][self.path]:
            failed(failure("AuthenticationFailed", "Authentication Failed"))
            return
        self.UpdateProperties(DEVICE, {"Paired": dbus.Boolean(True)})
        done()

    def refused(_error):
        failed(failure("AuthenticationRejected", "Authentication Rejected"))

    ask_agent("RequestPinCode", "o", [self.path], told, refused)


@dbus.service.method(DEVICE, in_signature="", out_signature="")
def CancelPairing(self):
    note("CancelPairing")


def socket_of(path):
    return str(Path(state["robots"]) / path.rpartition("/dev_")[2])


def new_connection(path, done, failed):
    """Call the profile with a descriptor of the robot at `path`; like BlueZ, keep a copy until it is hung up."""
    robot = socket.socket(socket.AF_UNIX)
    try:
        robot.connect(socket_of(path))
    except ConnectionRefusedError:
        robot.close()
        failed(failure("Failed", "br-connection-refused"))
        return
    except FileNotFoundError:
        robot.close()
        failed(failure("Failed", "br-connection-page-timeout"))
        return
    state["calls"][path] = robot

    def hung_up(*_):
        note("hung up")
        robot.close()
        return False

    watch = GLib.io_add_watch(robot.fileno(), GLib.IOCondition.HUP | GLib.IOCondition.ERR, hung_up)

    def rejected(error):
        GLib.source_remove(watch)
        robot.close()
        note(f"rejected {error}")
        failed(failure("Failed", "br-connection-aborted-by-local"))

    owner, profile = state["profile"]
    arguments = [dbus.ObjectPath(path), dbus.types.UnixFd(robot), dbus.Dictionary({}, signature="sv")]
    state["root"].connection.call_async(
        owner, profile, "org.bluez.Profile1", "NewConnection", "oha{sv}", arguments, done, rejected
    )


@dbus.service.method(DEVICE, in_signature="s", out_signature="", async_callbacks=("done", "failed"))
def ConnectProfile(self, uuid, done=None, failed=None):
    note("ConnectProfile " + str(uuid)[:8])
    if not self.props[DEVICE]["Paired"]:
        raise failure("Failed", "br-connection-key-missing")
    if state["pins"][self.path] == "busy once":
        state["pins"][self.path] = ""
        GLib.timeout_add(50, lambda: self.UpdateProperties(DEVICE, {"ServicesResolved": dbus.Boolean(True)}))
        raise failure("InProgress", "Operation already in progress")
    if state["pins"][self.path] == "silent" and not Path(socket_of(self.path)).exists():
        state["waiting"].append((done, failed))
        return
    new_connection(self.path, done, failed)


@dbus.service.method(DEVICE, in_signature="s", out_signature="")
def DisconnectProfile(self, uuid):
    note("DisconnectProfile")


@dbus.service.method(STEER, in_signature="sb", out_signature="s", async_callbacks=("done", "failed"))
def Call(self, address, trusted, done=None, failed=None):
    """The device of `address` calls us: "connected", "rejected" or, unless `trusted`, "not authorized"."""

    def authorized(*_):
        new_connection(path_of(address), lambda *_: done("connected"), lambda _: done("rejected"))

    if trusted:
        authorized()
        return
    service = [dbus.ObjectPath(path_of(address)), "00001101-0000-1000-8000-00805f9b34fb"]
    ask_agent("AuthorizeService", "os", service, authorized, lambda _: done("not authorized"))


@dbus.service.method(STEER, in_signature="s", out_signature="", async_callbacks=("done", "failed"))
def Disconnect(self, address, done=None, failed=None):
    owner, profile = state["profile"]
    arguments = [dbus.ObjectPath(path_of(address))]
    self.connection.call_async(
        owner, profile, "org.bluez.Profile1", "RequestDisconnection", "o", arguments, lambda *_: done(), failed
    )


@dbus.service.method(STEER, in_signature="ss", out_signature="")
def AddDevice(self, address, pin):
    add_device(address, {"pin": pin, "paired": True})


@dbus.service.method(STEER, in_signature="b", out_signature="")
def SetPowered(self, powered):
    mockobject.objects[CONTROLLER].UpdateProperties(ADAPTER, {"Powered": dbus.Boolean(powered)})


@dbus.service.method(STEER, in_signature="", out_signature="as")
def Log(self):
    return dbus.Array(state["log"], signature="s")
