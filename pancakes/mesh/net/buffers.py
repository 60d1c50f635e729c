"""How many bytes may be on their way over a connection, in the buffers of both kernels.

An urgent packet overtakes those that wait in an agent, but not those that a kernel has already. By itself Linux takes
megabytes, and where the reader is slower than its sender they are full all the time: a reply then waits behind all of
them. With these bounds it waits for as long as the reader needs for a quarter of a megabyte, and bulk over a short way
is hardly slower.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from typing import Final

NOT_SENT_BYTES: Final = 128 * 1024
"""So much may wait for the network at the sender; beyond that its socket counts as full."""
RECEIVE_BYTES: Final = 256 * 1024
"""So much may wait for the reader, or somewhat more: the kernel counts with overhead."""
SHORT_S: Final = 0.001
"""A round trip at which that is enough for 64 MB/s. Over a longer way the kernel finds the right size by itself."""

_ROUND_TRIP: Final = struct.Struct("68xI")  # tcpi_rtt of Linux's tcp_info, in microseconds


def bound_buffers(sock: socket.socket) -> None:
    """Bounds the buffers of a connection that has just come to stand; leaves them alone where the system cannot."""
    if not hasattr(socket, "TCP_NOTSENT_LOWAT") or not hasattr(socket, "TCP_INFO"):
        return
    with contextlib.suppress(OSError):  # it may be gone already, which its next use shows
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_BYTES)
        (round_trip_us,) = _ROUND_TRIP.unpack(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _ROUND_TRIP.size))
        if round_trip_us <= SHORT_S * 1e6:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
