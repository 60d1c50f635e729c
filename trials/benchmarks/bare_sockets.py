"""The baseline of two processes: a blocking socket in each, and the same packets as msgpack.

    python -m benchmarks.bare_sockets far PORT_FD
    python -m benchmarks.bare_sockets near PORT REPORT_FD ROUND_TRIPS PACKETS SIZE

What arrives one way is received in large pieces and decoded packet by packet.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
import time
from typing import Any

import msgpack

_LENGTH = struct.Struct(">I")
_COALESCED_BYTES = 65_536


class Wire:
    """Packets over one blocking socket."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock = sock
        self._pack = msgpack.Packer().pack
        self._buffer = b""

    def encode(self, kind: str, number: int, data: bytes) -> bytes:
        """Returns a packet as it travels, with all that one of ours has."""
        body = {"number": number, "data": data}
        row = ["bench", kind, "near/client/Near", "far/client/Far", time.monotonic(), number, None, body, None]
        packed: bytes = self._pack(row)
        return _LENGTH.pack(len(packed)) + packed

    def receive(self) -> list[list[Any]]:
        """Waits for bytes, and returns the packets that they complete."""
        while True:
            data = self.sock.recv(262_144)
            if not data:
                return []
            data = self._buffer + data
            packets = []
            at, end = 0, len(data)
            while end - at >= 4:
                (length,) = _LENGTH.unpack_from(data, at)
                if end - at - 4 < length:
                    break
                packets.append(msgpack.unpackb(data[at + 4 : at + 4 + length]))
                at += 4 + length
            self._buffer = data[at:]
            if packets:
                return packets


def far(port_fd: int) -> None:
    """Answers pings, and acknowledges the last of what comes one way with the µs of processor time since the first."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        os.write(port_fd, f"{json.dumps({'port': server.getsockname()[1]})}\n".encode())
        connection, _ = server.accept()
    wire = Wire(connection)
    began_cpu_s = 0.0
    while packets := wire.receive():
        for packet in packets:
            kind, body = packet[1], packet[7]
            if kind == "ping":
                wire.sock.sendall(wire.encode("pong", body["number"], body["data"]))
            elif body["number"] == 0:
                began_cpu_s = time.process_time()
            elif body["number"] < 0:
                wire.sock.sendall(wire.encode("got", round((time.process_time() - began_cpu_s) * 1e6), b""))


def near(port: int, report_fd: int, round_trips: int, packets: int, size: int) -> None:
    """Measures round trips, then packets one way: a send for each, then many in one, whose processor time is told."""
    wire = Wire(socket.create_connection(("127.0.0.1", port)))
    data = bytes(size)
    times_s = []
    for number in range(round_trips):
        asked_s = time.perf_counter()
        wire.sock.sendall(wire.encode("ping", number, data))
        wire.receive()
        times_s.append(time.perf_counter() - asked_s)
    rates, cpu_us = [], []
    for most_bytes in (0, _COALESCED_BYTES):
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        waiting: list[bytes] = []
        waiting_bytes = 0
        for number in range(packets):
            waiting.append(wire.encode("load", number if number + 1 < packets else -1, data))
            waiting_bytes += len(waiting[-1])
            if waiting_bytes > most_bytes or number + 1 == packets:
                wire.sock.sendall(b"".join(waiting))
                waiting.clear()
                waiting_bytes = 0
        (got,) = wire.receive()
        rates.append(packets / (time.perf_counter() - began_s))
        cpu_us = [(time.process_time() - began_cpu_s) / packets * 1e6, got[7]["number"] / packets]
    report = {"times_s": times_s, "per_s": rates[0], "coalesced_per_s": rates[1], "cpu_us": cpu_us}
    os.write(report_fd, f"{json.dumps(report)}\n".encode())


if __name__ == "__main__":
    side, *numbers = sys.argv[1:]
    (far if side == "far" else near)(*map(int, numbers))
