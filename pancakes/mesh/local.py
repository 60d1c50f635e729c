"""The transport of `local://NAME` addresses: Unix sockets between processes of one machine, without keys.

The kernel reports whose process is at the other end, so access goes by user and group. The socket lies in a directory
of the user's own, below the runtime directory.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.address import DEFAULT_FLEET, LOCAL, Reach, TransportFacts, parse_address
from pancakes.mesh.event_loop import Loop
from pancakes.mesh.sockets import NOT_SENT_BYTES, Place
from pancakes.mesh.stream import Bound, StreamTransport
from pancakes.settings import FilePath
from pancakes.util.runtime_dir import is_at, make_directory, open_to, runtime_dir, usable

if TYPE_CHECKING:
    from pancakes.security.keys import Keys


DIRECTORY: Final = "local"
"""The sockets are in this directory of the runtime directory."""
_SUFFIX: Final = ".sock"
_LONGEST_PATH: Final = 100
"""The path of a Unix socket has 107 bytes on Linux, 103 elsewhere."""
_TRIES: Final = 5
"""The last agent of a fleet may take the fleet's directory away while another one is about to listen there."""
_SO_PEERGROUPS: Final = 59
"""`SO_PEERGROUPS`: the groups of the process at the other end. Python has no name for it."""
_CREDENTIALS: Final = struct.Struct("3i")  # process, user, group
_GROUPS_BYTES: Final = 1024
"""The largest buffer that Python accepts: 256 groups."""


class LocalTransport(StreamTransport):
    """Connections between processes of one user, or of one group, on one machine."""

    class Settings(StreamTransport.Settings):
        """The settings of local connections.

        Attributes:
            group: members of this group may connect as well; `[agent] local_group` says which. Empty: only its user.
            directory: the parent of the directory `local` with the sockets; empty: the runtime directory.
        """

        group: str = ""
        directory: FilePath = ""

    def __init__(self, loop: Loop, settings: Settings, keys: Keys | None = None) -> None:
        super().__init__(loop, settings, keys)
        self._group = settings.group
        # A logout removes the directory of a person's session, and the next login makes it again.
        self._base = Path(settings.directory) if settings.directory else runtime_dir()

    @classmethod
    def facts(cls, address: str, keyed: bool) -> TransportFacts:
        return TransportFacts(Reach.USER, cost=0.9)

    def bind(self, address: str) -> Bound:
        path = self._path(address)
        for left in reversed(range(_TRIES)):
            for directory in self._directories(path):
                make_directory(directory, self._group)
            try:
                return self._bound(address, path)
            except FileNotFoundError:
                if not left:
                    raise
        raise AssertionError("the last try returns, or raises")

    def _bound(self, address: str, path: Path) -> Bound:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with _alone_in(path.parent), _short(path) as short:
                _clear_away(path, short)
                sock.bind(short)
                if self._group:
                    open_to(path, self._group, 0o660)
                else:
                    os.chmod(path, 0o600)
                sock.listen(128)
                made = os.stat(path)
        except BaseException:
            sock.close()
            raise
        return Bound(sock, address, lambda: _remove(path, made), lambda: is_at(path, made))

    def places(self, address: str, look_up: bool) -> list[Place]:
        return [(socket.AF_UNIX, self._path(address))]

    def _path(self, address: str) -> Path:
        """Return the path of the socket that an address of this transport names.

        Raises:
            ValueError: it is not such an address.
        """
        parts = parse_address(address)
        if parts.scheme != LOCAL:
            raise ValueError(f"{address!r} is no address within one machine: write it as {LOCAL}://NAME")
        if parts.path.startswith("/"):
            return Path(parts.path)
        name = parts.path.removeprefix(f"{DEFAULT_FLEET}/")
        return self._base / DIRECTORY / f"{name}{_SUFFIX}"

    def _directories(self, path: Path) -> list[Path]:
        """Return the directories on the way to a socket that are Pancakes' own, the outermost first."""
        found = [it for it in reversed(path.parents) if it.is_relative_to(self._base)]
        return found or [path.parent]

    def connect(self, sock: socket.socket, place: Any) -> None:
        try:
            for directory in self._directories(place):
                usable(directory, named=not place.is_relative_to(self._base))
            with _short(place) as short:
                sock.connect(short)
        except FileNotFoundError:
            raise ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED)) from None

    def remote(self, sock: socket.socket, place: Any) -> str:
        try:
            return f"{LOCAL}://process-{_peer(sock)[0]}"
        except OSError:
            return f"{LOCAL}://process"

    def prepare(self, sock: socket.socket, dialled: str) -> str:
        with contextlib.suppress(OSError):  # as `bound_buffers` does for TCP
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, NOT_SENT_BYTES)
        try:
            process, user, group = _peer(sock)
            if user in (os.getuid(), 0):
                return ""
            if dialled:  # a person who named the directory of another user trusts that user
                is_let_in = user == os.stat(self._path(dialled).parent).st_uid
            else:
                is_let_in = bool(self._group) and _number(self._group) in (group, *_groups(sock))
        except OSError as error:
            return f"the system does not say whose process is at its other end: {error.strerror or error}"
        if is_let_in:
            return ""
        return f"at its other end is the process {process} of another user (uid {user})"


@contextlib.contextmanager
def _short(path: Path) -> Iterator[str]:
    """Yield a path short enough for the operating system: through the open directory if necessary."""
    if len(os.fsencode(path)) <= _LONGEST_PATH:
        yield str(path)
        return
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{directory}/{path.name}"
    finally:
        os.close(directory)


@contextlib.contextmanager
def _alone_in(directory: Path) -> Iterator[None]:
    """Keep other agents from listening in a directory meanwhile; they wait for a moment."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _clear_away(path: Path, short: str) -> None:
    """Remove the socket of an agent that has died.

    Raises:
        PancakesError: a running agent has it, or it is not a socket.
    """
    if not os.path.lexists(path):
        return
    if not path.is_socket():
        raise PancakesError(f"{path} is no socket, and no agent has put it there")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(short)
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:
            pass
    raise PancakesError("address already in use: another agent of this name runs here")


def _remove(path: Path, made: os.stat_result) -> None:
    """Remove a closed socket, unless another agent has put its own there, and the fleet's directory if empty."""
    with contextlib.suppress(OSError):
        if is_at(path, made):
            path.unlink()
            if path.parent.parent.name == DIRECTORY:
                path.parent.rmdir()


def _peer(sock: socket.socket) -> tuple[int, int, int]:
    """Return process, user and group at the other end.

    Raises:
        OSError: the system does not say.
    """
    option = getattr(socket, "SO_PEERCRED", None)
    if option is None:
        raise OSError(errno.ENOSYS, "it has no SO_PEERCRED")
    process, user, group = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, option, _CREDENTIALS.size))
    return process, user, group


def _groups(sock: socket.socket) -> tuple[int, ...]:
    found = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _GROUPS_BYTES)
    return struct.unpack(f"{len(found) // 4}I", found)


def _number(group: str) -> int:
    import grp

    try:
        return grp.getgrnam(group).gr_gid
    except (KeyError, ValueError):  # ValueError: a NUL is in it
        return -1
