"""The wire between network namespaces: it passes, delays, loses or cuts off their packets."""

from __future__ import annotations

import heapq
import os
import random
import select
import socket
import threading
import time
from dataclasses import dataclass, field

QUEUE = 20_000
"""The most packets on their way at once; further ones are lost, as in any full queue."""
_PACKET_BYTES = 65_535


@dataclass
class Link:
    """The part of the wire between two namespaces. Any thread may change it; the wire's thread reads it.

    Attributes:
        delay_s: how much later each IP packet arrives, each way.
        loss: the share of IP packets that never arrive.
        cut: set once the link has been cut by `cut_at`.
        lost: how many packets did not arrive.
    """

    delay_s: float = 0.0
    loss: float = 0.0
    cut: threading.Event = field(default_factory=threading.Event)
    lost: int = 0
    _open: bool = True
    _word: bytes = b""

    def cut_at(self, word: str) -> None:
        """Cut the link when the next packet of this type is on its way: from then on, nothing arrives, either way.

        Nobody is told: no connection is reset, and who died does not say so.
        """
        text = word.encode()
        # With the length first, as in msgpack, so that `reserve` is not found in `reserved`.
        self._word = bytes((0xA0 | len(text),)) + text

    def heal(self) -> None:
        """Restore the link."""
        self._open = True

    def passes(self, packet: bytes, draw: random.Random) -> bool:
        """Return whether an IP packet arrives. In the wire's thread."""
        if self._word and self._word in packet:
            self._word, self._open = b"", False
            self.cut.set()
        if self._open and not (self.loss and draw.random() < self.loss):
            return True
        self.lost += 1
        return False


class Wire:
    """Forwards IP packets between devices, in a thread of its own.

    Args:
        seed: the seed of the lost packets.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(f"wire/{seed}")
        self._devices: dict[bytes, int] = {}
        self._links: dict[tuple[bytes, bytes], Link] = {}
        self._poll = select.epoll()
        self._wake, self._woken = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._poll.register(self._wake, select.EPOLLIN)
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="wire", daemon=True)
        self._thread.start()

    def attach(self, host: str, device: int) -> None:
        """Connect a TUN device to all others; the wire owns the device from now on."""
        self._devices[socket.inet_aton(host)] = device
        self._poll.register(device, select.EPOLLIN)

    def link(self, one: str, other: str) -> Link:
        """Return the part between two addresses, the same for both ways; without one, packets pass at once."""
        ends = socket.inet_aton(one), socket.inet_aton(other)
        link = self._links.get(ends)
        if link is None:
            link = self._links[ends] = self._links[ends[::-1]] = Link()
        return link

    def close(self) -> None:
        """End the wire, and remove the devices. A second call does nothing."""
        if self._ended:
            return
        self._ended = True
        os.write(self._woken, b".")
        self._thread.join()
        self._poll.close()
        for handle in (*self._devices.values(), self._wake, self._woken):
            os.close(handle)

    def _run(self) -> None:
        late: list[tuple[float, int, bytes]] = []  # when it is due, its number, the packet
        number = 0
        while not self._ended:
            now_s = time.monotonic()
            while late and late[0][0] <= now_s:
                self._deliver(heapq.heappop(late)[2])
            timeout_s = max(0.0, late[0][0] - now_s) if late else None
            for handle, _ in self._poll.poll(timeout_s):
                for packet in _packets(handle) if handle != self._wake else ():
                    link = self._links.get((packet[12:16], packet[16:20]))
                    if link is not None and not link.passes(packet, self._random):
                        continue
                    if link is None or not link.delay_s:
                        self._deliver(packet)
                    elif len(late) < QUEUE:
                        number += 1
                        heapq.heappush(late, (time.monotonic() + link.delay_s, number, packet))

    def _deliver(self, packet: bytes) -> None:
        device = self._devices.get(packet[16:20])
        if device is not None:
            try:
                os.write(device, packet)
            except OSError:  # the queue is full or the device is not up yet: the packet is lost
                pass


def _packets(device: int) -> list[bytes]:
    """Read some of the waiting IPv4 packets, so that the other devices get their turn, too."""
    packets = []
    for _ in range(64):
        try:
            packet = os.read(device, _PACKET_BYTES)
        except OSError:
            break
        if packet[0] >> 4 == 4:
            packets.append(packet)
    return packets
