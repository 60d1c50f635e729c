"""Network namespaces for agents: each has a network of its own, separate from the machine's network.

They are made with `ip netns`, and joined by a wire of our own (`wire.py`), so no kernel support for `netem` is needed.
Their names contain the number and start time of the process that made them, so that the namespaces of a killed run are
found and removed at the next start.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import signal
import struct
import subprocess
import threading
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from torture.wire import Link, Wire

PREFIX = "pancakes-torture"
DEVICE = "wire0"
TUN = "/dev/net/tun"
NAMED = Path("/run/netns")  # where `ip netns` keeps them
NET = "10.78"
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_CLONE_NEWNET = 0x40000000


class NoNamespaces(Exception):
    """This machine cannot make network namespaces; the sentence says why, and what to do."""


class Place(NamedTuple):
    """A network namespace.

    Attributes:
        name: its name in `ip netns`.
        host: its address on the wire.
    """

    name: str
    host: str

    @property
    def command(self) -> tuple[str, ...]:
        """The prefix of a command that runs in the namespace."""
        return ("ip", "netns", "exec", self.name)


def check() -> None:
    """Check whether this machine can make namespaces, by making one.

    Raises:
        NoNamespaces: it cannot.
    """
    if os.geteuid() != 0:
        raise NoNamespaces("network namespaces can be made by root alone: run it with sudo")
    if shutil.which("ip") is None:
        raise NoNamespaces("network namespaces need the program `ip`: install it with `apt install iproute2`")
    try:
        os.close(os.open(TUN, os.O_RDWR))
    except OSError as error:
        raise NoNamespaces(
            f"network namespaces are joined through {TUN}, which cannot be used: {error.strerror}"
        ) from None
    with Namespaces() as places:
        places.add()


class Namespaces:
    """Namespaces on one wire. The thread that makes them is in the first one until it closes them.

    Threads and sockets that it makes meanwhile are in there, too, so it can reach the agents in the others.

    Attributes:
        places: all of them.
        wire: what joins them.

    Raises:
        NoNamespaces: one could not be made.
    """

    def __init__(self, seed: int = 0) -> None:
        remove_leftovers()
        self._stem = f"{PREFIX}-{os.getpid()}-{_born(os.getpid())}"
        self._home = os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
        self._lock = threading.Lock()
        self.places: list[Place] = []
        self.wire = Wire(seed)

    def __enter__(self) -> Namespaces:
        try:
            _enter_named(self.add().name)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add(self) -> Place:
        """Make a namespace. Any thread."""
        with self._lock:
            number = len(self.places) + 1
            place = Place(f"{self._stem}-{number}", f"{NET}.{number >> 8}.{number & 255}")
            self.places.append(place)
        _ip("netns", "add", place.name)
        _ip("-n", place.name, "link", "set", "lo", "up")
        self.wire.attach(place.host, _tun_in(place.name))
        _ip("-n", place.name, "link", "set", DEVICE, "txqueuelen", "2000", "up")
        _ip("-n", place.name, "addr", "add", f"{place.host}/16", "dev", DEVICE)
        return place

    def link(self, one: Place, other: Place) -> Link:
        """Return the part of the wire between two namespaces, which can be slow, lossy and cut."""
        return self.wire.link(one.host, other.host)

    def close(self) -> None:
        """Remove all namespaces, end the processes in them, and move the thread back."""
        if self._home >= 0:
            _enter(self._home)
            os.close(self._home)
            self._home = -1
        self.wire.close()
        for place in self.places:
            _remove(place.name)
        self.places.clear()


def remove_leftovers() -> list[str]:
    """Remove the namespaces of dead runs, with the agents in them, and return their names."""
    gone = []
    for path in sorted(NAMED.glob(f"{PREFIX}-*")):
        pid, born = path.name.removeprefix(f"{PREFIX}-").split("-")[:2]
        if _born(int(pid)) != int(born):
            _remove(path.name)
            gone.append(path.name)
    return gone


def _born(pid: int) -> int:
    """Return the start time of a process in ticks since the boot; 0: it does not exist. With the pid, it is unique."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except OSError:
        return 0


def _remove(name: str) -> None:
    """End all processes in a namespace that we made, and remove it. A second call does nothing."""
    found = subprocess.run(("ip", "netns", "pids", name), capture_output=True, text=True)
    for pid in found.stdout.split():
        if int(pid) != os.getpid():
            try:
                os.kill(int(pid), signal.SIGKILL)
            except ProcessLookupError:
                pass
    subprocess.run(("ip", "netns", "del", name), capture_output=True)


def _ip(*arguments: str) -> None:
    ended = subprocess.run(("ip", *arguments), capture_output=True, text=True)
    if ended.returncode:
        raise NoNamespaces(f"network namespaces cannot be made: `ip {' '.join(arguments)}`: {ended.stderr.strip()}")


def _tun_in(name: str) -> int:
    """Make the device that connects a namespace to the wire; closing the result removes it."""
    made: list[int | OSError] = []

    def make() -> None:  # in a thread of its own, which enters the namespace and ends
        try:
            _enter_named(name)
            tun = os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH", DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
            made.append(tun)
        except OSError as error:
            made.append(error)

    thread = threading.Thread(target=make)
    thread.start()
    thread.join()
    if isinstance(made[0], OSError):
        raise NoNamespaces(f"network namespaces are joined through {TUN}, which cannot be used: {made[0]}")
    return made[0]


def _enter_named(name: str) -> None:
    handle = os.open(NAMED / name, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _enter(handle)
    finally:
        os.close(handle)


def _enter(handle: int) -> None:
    """Move this thread to another namespace (`os.setns`, which Python has from 3.12 on)."""
    if ctypes.CDLL(None, use_errno=True).setns(handle, _CLONE_NEWNET):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
