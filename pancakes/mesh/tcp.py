"""The transport of `tcp://` addresses: TLS between members of a fleet, or plain TCP if `insecure` is set."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from pancakes.mesh.address import TransportFacts, is_loopback, parse_address, reach_of, spelt
from pancakes.mesh.admission import Handshakes
from pancakes.mesh.event_loop import Loop
from pancakes.mesh.sockets import Place, bound_buffers, keep_alive
from pancakes.mesh.stream import Bound, StreamConnection, StreamTransport
from pancakes.mesh.transport import ConnectionHandler

if TYPE_CHECKING:
    from pancakes.mesh.tls import TlsLayer
    from pancakes.security.keys import Keys


_USER_TIMEOUT_MS: Final = 5000  # the kernel gives up a connection whose bytes are not acknowledged for this time


class TcpTransport(StreamTransport):
    """Connections over TCP: encrypted, between bearers of certificates of the fleet.

    Args:
        loop: the transport's thread.
        settings: see `Settings`.
        keys: see `SchemeTransport`.
    """

    class Settings(StreamTransport.Settings):
        """The settings of TCP connections.

        Attributes:
            insecure: whether it connects without keys too: what is said can then be read, changed and made up by all
                that reach the network.
        """

        insecure: bool = False

    def __init__(self, loop: Loop, settings: Settings, keys: Keys | None = None) -> None:
        super().__init__(loop, settings, keys)
        self._insecure = settings.insecure
        self._handshakes: Handshakes[TlsLayer] = Handshakes(loop.now())
        if keys is not None:
            # Imported now, while nothing waits for this thread: it takes some milliseconds.
            from pancakes.mesh.tls import TlsConnection

            self._tls = TlsConnection

    @classmethod
    def facts(cls, address: str, keyed: bool) -> TransportFacts:
        return TransportFacts(reach_of(address), encrypted=keyed)

    def connection(
        self, sock: socket.socket, remote: str, handler: ConnectionHandler, dialled: bool
    ) -> StreamConnection:
        if self.keys is None:
            return super().connection(sock, remote, handler, dialled)
        over = self._handshakes.over
        made = self._tls(self, sock, remote, handler, keys=self.keys, dialled=dialled, shaken=over)
        if not dialled and (oldest := self._handshakes.begun(made)) is not None:
            oldest.dispose("it was slow to say who it is, and others wait")
        return made

    def bind(self, address: str) -> Bound:
        places = self.places(address, look_up=True)
        # The first of a name's addresses that others reach: a machine's name may also lead to its loopback.
        family, place = min(places, key=lambda it: is_loopback(_address(it[1])))
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            if os.name == "posix":
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(place)
            sock.listen(128)
        except BaseException:
            sock.close()
            raise
        return Bound(sock, _address(sock.getsockname()), lambda: None)

    def places(self, address: str, look_up: bool) -> list[Place]:
        parts = parse_address(address)
        if parts.scheme != "tcp" or parts.path:
            raise ValueError(f"{address!r} is no address of TCP: write it as tcp://host:port")
        if self.keys is None and not self._insecure:
            raise ValueError(needs_keys(address))
        # As bytes: for a string, Python would load a codec for other alphabets, which takes 0.5 MiB.
        flags = 0 if look_up else socket.AI_NUMERICHOST
        found = socket.getaddrinfo(parts.host.encode(), parts.port, type=socket.SOCK_STREAM, flags=flags)
        return [(family, place) for family, _, _, _, place in found]

    def remote(self, sock: socket.socket, place: Any) -> str:
        return _address(place)

    def prepare(self, sock: socket.socket, dialled: str) -> str:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)
        keep_alive(sock)
        bound_buffers(sock)
        if self.keys is not None and not dialled and not self._handshakes.may_begin(self.loop.now()):
            return "too many begin at once to say who they are"
        return ""


def needs_keys(address: str, name: str = "NAME") -> str:
    """Return why a connection over TCP needs keys, as a sentence.

    Args:
        address: the address.
        name: the agent's name.
    """
    return f"{address!r} needs keys: run pancakes keys join, or use local://{name} for this machine only"


def _address(place: Any) -> str:
    """Return the address of a place.

    A link-local address includes its interface, because it could not be dialled without it.
    """
    host, port, interface = place[0], place[1], place[3] if len(place) > 3 else 0
    if interface and "%" not in host:
        with suppress(OSError):  # it has ended meanwhile
            host += f"%{socket.if_indextoname(interface)}"
    return spelt(f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}")
