"""A TCP proxy between two agents that reads what they say, cuts the link at a chosen word, and can be slow."""

from __future__ import annotations

import queue
import random
import socket
import struct
import threading
import time

import msgspec

from pancakes.wire.codec import rows_from_payload
from pancakes.wire.framing import FrameReader
from pancakes.wire.messages import HELLO_NUMBER

LISTEN = 7  # where a hello has the address at which its sender may be dialled


class Proxy:
    """Stands between two agents.

    The address that each of them gives for itself is taken out of its hello, so that there is no way around.

    Args:
        target: where the other agent listens, as `tcp://host:port`.
        delay_s: how much later each frame arrives, each way.
        loss: the share of frames that have to be sent again, which on a stream is a delay of all that follow.
        again_s: how long that takes.
        seed: draws which frames are lost.

    Attributes:
        address: where to dial it.
        cut: set once the link has been cut.
    """

    def __init__(self, target: str, delay_s: float = 0.0, loss: float = 0.0, again_s: float = 0.0, seed: int = 0):
        host, _, port = target.removeprefix("tcp://").rpartition(":")
        self._target = (host, int(port))
        self._delay_s, self._loss, self._again_s = delay_s, loss, again_s
        self._random = random.Random(f"proxy/{seed}")
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.cut = threading.Event()
        self._open = True
        self._word = ""
        self._lock = threading.Lock()
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._ended = False
        threading.Thread(target=self._accept, daemon=True).start()

    def cut_at(self, word: str) -> None:
        """Cuts the link when the next packet of this type is on its way; it does not arrive, and nothing after it."""
        with self._lock:
            self._word = word

    def heal(self) -> None:
        """Lets the two reach each other again."""
        with self._lock:
            self._open = True

    def close(self) -> None:
        """Ends it, and all connections."""
        self._ended = True
        self._listener.close()
        self._break()

    def _break(self) -> None:
        with self._lock:
            pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for one in pair:
                try:
                    # With a reset: what was on its way is lost, as on a link that was cut.
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    one.shutdown(socket.SHUT_RDWR)
                except OSError:
                    pass
                one.close()

    def _accept(self) -> None:
        while not self._ended:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                with self._lock:
                    if not self._open:
                        raise OSError("the link is cut")
                far = socket.create_connection(self._target, 2.0)
                far.settimeout(None)
            except OSError:
                near.close()
                continue
            for one in (near, far):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._pairs.append((near, far))
            for source, sink in ((near, far), (far, near)):
                later: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
                threading.Thread(target=self._read, args=(source, later), daemon=True).start()
                threading.Thread(target=self._write, args=(later, sink), daemon=True).start()

    def _read(self, source: socket.socket, later: queue.SimpleQueue[tuple[float, bytes]]) -> None:
        reader = FrameReader()
        due_s = 0.0
        try:
            while data := source.recv(1 << 18):
                for payload in reader.feed(data):
                    lost = self._random.random() < self._loss
                    due_s = max(due_s, time.monotonic() + self._delay_s + (self._again_s if lost else 0.0))
                    rows = rows_from_payload(payload)
                    if any(row[0] == HELLO_NUMBER for row in rows):
                        rows = [row[:LISTEN] + [""] if row[0] == HELLO_NUMBER else row for row in rows]
                        payload = msgspec.msgpack.encode(rows)
                    if self._word and any(isinstance(row[0], str) and row[1] == self._word for row in rows):
                        with self._lock:
                            self._word, self._open = "", False
                        self._break()
                        self.cut.set()
                        return
                    later.put((due_s, struct.pack(">I", len(payload)) + payload))
        except OSError:
            pass
        finally:
            later.put((due_s, b""))

    def _write(self, later: queue.SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        try:
            while True:
                due_s, data = later.get()
                time.sleep(max(0.0, due_s - time.monotonic()))
                if not data:
                    sink.shutdown(socket.SHUT_RDWR)
                    return
                sink.sendall(data)
        except OSError:
            pass
