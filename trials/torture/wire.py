"""The wire between network namespaces: what goes from one to the other passes here, is late, is lost, or is cut off."""

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
"""So many packets are on their way at once, at most; what comes then is lost, as in any queue that is full."""
_PACKET_BYTES = 65_535


@dataclass
class Link:
    """The stretch between two namespaces. Changed in any thread, read by the wire's.

    Attributes:
        delay_s: how much later each IP packet arrives, each way.
        loss: the share of IP packets that never arrive.
        cut: set once the link has been cut by a word.
        lost: how many packets did not arrive.
    """

    delay_s: float = 0.0
    loss: float = 0.0
    cut: threading.Event = field(default_factory=threading.Event)
    lost: int = 0
    _open: bool = True
    _word: bytes = b""

    def cut_at(self, word: str) -> None:
        """Cuts the link when the next packet of this type is on its way: nothing arrives from then on, either way.

        Nobody is told: no connection is reset, and who died does not say so.
        """
        text = word.encode()
        # As msgpack has it, its length first: `reserve` is not to be found in `reserved`.
        self._word = bytes((0xA0 | len(text),)) + text

    def heal(self) -> None:
        """Lets the two reach each other again."""
        self._open = True

    def passes(self, packet: bytes, draw: random.Random) -> bool:
        """Says whether an IP packet arrives. In the wire's thread."""
        if self._word and self._word in packet:
            self._word, self._open = b"", False
            self.cut.set()
        if self._open and not (self.loss and draw.random() < self.loss):
            return True
        self.lost += 1
        return False


class Wire:
    """Carries IP packets between devices, in a thread of its own.

    Args:
        seed: draws which are lost.
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
        """Lets the packets of a TUN device go to all others; the device is the wire's from now on."""
        self._devices[socket.inet_aton(host)] = device
        self._poll.register(device, select.EPOLLIN)

    def link(self, one: str, other: str) -> Link:
        """Returns the stretch between two addresses, the same for both ways; packets pass at once until it is made."""
        ends = socket.inet_aton(one), socket.inet_aton(other)
        link = self._links.get(ends)
        if link is None:
            link = self._links[ends] = self._links[ends[::-1]] = Link()
        return link

    def close(self) -> None:
        """Ends it, and removes the devices. A second time does nothing."""
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
            except OSError:  # its queue is full, or it is not up yet: lost
                pass


def _packets(device: int) -> list[bytes]:
    """Reads the IPv4 packets that wait, some of them where there are many: the other devices want their turn."""
    packets = []
    for _ in range(64):
        try:
            packet = os.read(device, _PACKET_BYTES)
        except OSError:
            break
        if packet[0] >> 4 == 4:
            packets.append(packet)
    return packets
