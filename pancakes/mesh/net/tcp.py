"""Bytes over TCP, between machines."""

from __future__ import annotations

import os
import socket
from typing import Any, Final

from pancakes.mesh.address import parse_address
from pancakes.mesh.net.buffers import bound_buffers
from pancakes.mesh.net.stream_transport import Bound, Place, StreamTransport

_USER_TIMEOUT_MS: Final = 5000  # the kernel gives up a connection whose bytes are not acknowledged for so long


class TcpTransport(StreamTransport):
    """Connections over TCP."""

    def bind(self, address: str) -> Bound:
        family, place = self.places(address, look_up=True)[0]
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
        # Of a string Python would make the bytes by way of a codec for foreign alphabets, which takes 0.5 MiB.
        flags = 0 if look_up else socket.AI_NUMERICHOST
        found = socket.getaddrinfo(parts.host.encode(), parts.port, type=socket.SOCK_STREAM, flags=flags)
        return [(family, place) for family, _, _, _, place in found]

    def remote(self, sock: socket.socket, place: Any) -> str:
        return _address(place)

    def prepare(self, sock: socket.socket, dialled: str) -> str:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)
        bound_buffers(sock)
        return ""


def _address(place: Any) -> str:
    host, port = place[0], place[1]
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"
