"""Has the kernel ask whether the other side of a connection is there, if that says nothing.

A machine that loses its power ends no connection. One that only listens would wait for it for ever.
"""

from __future__ import annotations

import socket
from typing import Final

IDLE_S: Final = 5
"""After so long without a word the other side is asked, and then as often."""
TRIES: Final = 3


def keep_alive(sock: socket.socket) -> None:
    """Has a TCP connection break when the other side is gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    # Not every system has these; its own times hold then.
    for option, value in (("TCP_KEEPIDLE", IDLE_S), ("TCP_KEEPINTVL", IDLE_S), ("TCP_KEEPCNT", TRIES)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
