"""Namespaces of the kernel's network and cables between them, made with `ip netns`, which needs root.

All traffic stays inside: a namespace has its own loopback and its ends of the cables, and nothing else.
"""

import contextlib
import ctypes
import itertools
import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, TypeVar

Result = TypeVar("Result")

_PREFIX: Final = "psiu-lab-"
_NETWORKS: Final = itertools.count(1)
_PATIENCE_S: Final = 10.0
_CLONE_NEWNET: Final = 0x40000000
_FILTER: Final = """
table inet lab {
    set lost { type ifname; }
    chain in { type filter hook input priority 0; iifname @lost drop; }
    chain out { type filter hook output priority 0; oifname @lost drop; }
}
"""


def obstacle() -> str | None:
    """Why there can be no network here; None if there can."""
    missing = [tool for tool in ("ip", "ss", "nft", "setpriv") if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} is not installed (Debian: iproute2, nftables, util-linux)"
    if os.geteuid() != 0:
        return "only root may make network namespaces"
    name = f"{_PREFIX}{os.getpid()}-probe"
    try:
        _run("ip", "netns", "add", name)
        try:
            _run("ip", "netns", "exec", name, "nft", "-f", "-", text=_FILTER)
            _run("ip", "-n", name, "link", "add", "c0", "type", "veth", "peer", "name", "c1")
        finally:
            _run("ip", "netns", "del", name)
    except OSError as error:
        return f"the kernel or this container refuses: {error}"
    return None


class Cable:
    """One veth pair between the nodes `a` and `b`, with a /30 of its own."""

    def __init__(self, number: int, a: int, b: int, namespaces: Sequence[str]) -> None:
        self.a, self.b = a, b
        self.whole = True
        self._device = f"c{number}"
        self._addresses = {a: f"10.77.{number}.1", b: f"10.77.{number}.2"}
        self._namespaces = {a: namespaces[a], b: namespaces[b]}

    def lay(self) -> None:
        """Make both ends and bring them up."""
        near, far = (("netns", namespace, "name", self._device) for namespace in self._namespaces.values())
        _run("ip", "link", "add", *near, "type", "veth", "peer", *far)
        for node, namespace in self._namespaces.items():
            commands = f"address add {self._addresses[node]}/30 dev {self._device}\nlink set {self._device} up\n"
            _run("ip", "-n", namespace, "-batch", "-", text=commands)

    def address(self, node: int) -> str:
        """The address of the end at `node`."""
        return self._addresses[node]

    def joins(self, group: Iterable[int]) -> bool:
        """Whether it leads out of `group`."""
        return len({self.a, self.b} & set(group)) == 1

    def pull(self, end: int) -> None:
        """Take the interface at one end down: nothing arrives, and nobody is told at the far end's sockets."""
        self.whole = False
        _run("ip", "-n", self._namespaces[end], "link", "set", self._device, "down")

    def plug(self, end: int) -> None:
        """Undo `pull`."""
        _run("ip", "-n", self._namespaces[end], "link", "set", self._device, "up")
        self.whole = True

    def lose(self) -> None:
        """Drop every packet, both ways; the interfaces stay up."""
        self.whole = False
        self._nft("add")

    def keep(self) -> None:
        """Undo `lose`."""
        self._nft("delete")
        self.whole = True

    def reset(self, end: int) -> None:
        """End every TCP connection over it; both sides are told."""
        _in(self._namespaces[end], "ss", "-tnHK", "src", self._addresses[end])

    def __str__(self) -> str:
        return f"{self.a + 1}-{self.b + 1}"

    def _nft(self, verb: str) -> None:
        _in(self._namespaces[self.a], "nft", verb, "element", "inet", "lab", "lost", f'{{ "{self._device}" }}')


class Network:
    """`nodes` namespaces with a cable for each pair of `joined`; a context manager that leaves nothing behind.

    What a run that was killed has left is removed first.
    """

    def __init__(self, nodes: int, joined: Sequence[tuple[int, int]]) -> None:
        own = f"{_PREFIX}{os.getpid()}-{next(_NETWORKS)}"
        self.namespaces: Final = [f"{own}-{node + 1}" for node in range(nodes)]
        self.cables: Final = [Cable(number, a, b, self.namespaces) for number, (a, b) in enumerate(joined)]

    def __enter__(self) -> "Network":
        _remove_stale()
        try:
            for namespace in self.namespaces:
                _run("ip", "netns", "add", namespace)
                _run("ip", "-n", namespace, "link", "set", "lo", "up")
                _in(namespace, "nft", "-f", "-", text=_FILTER)
            for cable in self.cables:
                cable.lay()
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._remove()

    def cables_of(self, node: int) -> list[Cable]:
        return [cable for cable in self.cables if node in (cable.a, cable.b)]

    def inside(self, node: int, work: Callable[[], Result]) -> Result:
        """Do `work` inside the namespace; sockets that it makes stay there."""
        return _inside(self.namespaces[node], work)

    def command(self, node: int, *words: str | Path) -> list[str]:
        """`words` as a command that runs inside the namespace, in one process, and is killed when ours is gone."""
        return ["ip", "netns", "exec", self.namespaces[node], "setpriv", "--pdeathsig", "KILL", *map(str, words)]

    def _remove(self) -> None:
        for namespace in self.namespaces:
            _remove_namespace(namespace)


def _remove_stale() -> None:
    """Remove the namespaces of runs that ended without doing so, and what still runs in them."""
    for line in _run("ip", "netns", "list").splitlines():
        name = line.partition(" ")[0]
        owner = name.removeprefix(_PREFIX).partition("-")[0]
        if name.startswith(_PREFIX) and owner.isdigit() and not Path(f"/proc/{owner}").exists():
            _remove_namespace(name)


def _remove_namespace(name: str) -> None:
    """End what runs in the namespace, and remove it with its ends of cables; harmless if there is none."""
    with contextlib.suppress(OSError):
        for process in _run("ip", "netns", "pids", name).split():
            if int(process) != os.getpid():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(process), signal.SIGKILL)
        _run("ip", "netns", "del", name)


def _inside(namespace: str, work: Callable[[], Result]) -> Result:
    """Run `work` on a thread that has entered the namespace: only threads can, and a socket stays where it was made."""
    results: list[Result] = []
    errors: list[BaseException] = []

    def enter() -> None:
        try:
            _enter(namespace)
            results.append(work())
        except BaseException as error:  # told to the caller below
            errors.append(error)

    thread = threading.Thread(target=enter, name=f"in {namespace}")
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]


def _enter(namespace: str) -> None:
    """Move this thread into the namespace, for good."""
    libc = ctypes.CDLL(None, use_errno=True)  # os.setns came with Python 3.12
    with Path(f"/run/netns/{namespace}").open() as there:
        if libc.setns(there.fileno(), _CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), f"setns {namespace}")


def _in(namespace: str, *words: str, text: str = "") -> str:
    return _run("ip", "netns", "exec", namespace, *words, text=text)


def _run(*words: str, text: str = "") -> str:
    """The output of a command. Raises OSError with its own words if it fails."""
    ran = subprocess.run(words, input=text, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    if ran.returncode != 0:
        raise OSError(f"{' '.join(words)}: {ran.stderr.strip() or ran.returncode}")
    return ran.stdout
