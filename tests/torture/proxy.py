"""A TCP proxy between two agents that reads what they say, and cuts the link or loses a packet at a chosen word."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable
from enum import Enum
from typing import Any

import msgspec

from pancakes.wire.codec import rows_from_payload
from pancakes.wire.framing import FrameReader
from pancakes.wire.messages import HELLO_NUMBER, Peers

LISTEN = 7  # where a hello has the address at which its sender may be dialled


class Verdict(Enum):
    """What becomes of a packet."""

    PASS = "pass"
    LOSE = "lose"
    """It does not arrive; what follows does."""
    END = "end"
    """It does not arrive, and nothing else on this connection: its sender is dead."""


Watch = Callable[[list[Any]], Verdict]
"""Is shown each packet, as the row that it is on the wire."""


class Proxy:
    """Stands between two agents.

    The address that each of them gives for itself is taken out of its hello, and what they tell about others is lost,
    so that there is no way around.

    Args:
        target: where the other agent listens, as `tcp://host:port`.
        watch: decides what becomes of each packet, in the connection's own thread; None: all pass.

    Attributes:
        address: where to dial it.
        cut: set once the link has been cut.
    """

    def __init__(self, target: str, watch: Watch | None = None) -> None:
        host, _, port = target.removeprefix("tcp://").rpartition(":")
        self._target = (host, int(port))
        self._watch = watch
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
            threading.Thread(target=self._carry_both, args=(near, far), daemon=True).start()

    def _carry_both(self, near: socket.socket, far: socket.socket) -> None:
        """Carries both ways until both have ended, and closes the two."""
        back = threading.Thread(target=self._carry, args=(far, near), daemon=True)
        back.start()
        self._carry(near, far)
        back.join()
        with self._lock:
            if (near, far) in self._pairs:
                self._pairs.remove((near, far))
        near.close()
        far.close()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        reader = FrameReader()
        try:
            while data := source.recv(1 << 18):
                for payload in reader.feed(data):
                    rows = rows_from_payload(payload)
                    if self._is_cut_by(rows):
                        return
                    kept, ends = self._judged(rows)
                    if kept != rows:
                        payload = msgspec.msgpack.encode(kept)
                    if kept:
                        sink.sendall(struct.pack(">I", len(payload)) + payload)
                    if ends:
                        return
        except OSError:
            pass
        finally:
            for one in (source, sink):
                try:
                    one.shutdown(socket.SHUT_RDWR)
                except OSError:  # it is closed already
                    pass

    def _is_cut_by(self, rows: list[list[Any]]) -> bool:
        if not self._word or not any(isinstance(row[0], str) and row[1] == self._word for row in rows):
            return False
        with self._lock:
            self._word, self._open = "", False
        self._break()
        self.cut.set()
        return True

    def _judged(self, rows: list[list[Any]]) -> tuple[list[list[Any]], bool]:
        """Returns the rows that arrive, and whether they are the last ones."""
        kept: list[list[Any]] = []
        for row in rows:
            if row[0] == HELLO_NUMBER:
                row = row[:LISTEN] + [""]
            elif row[0] == Peers.__struct_config__.tag:
                continue
            elif self._watch is not None and isinstance(row[0], str):
                verdict = self._watch(row)
                if verdict is Verdict.END:
                    return kept, True
                if verdict is Verdict.LOSE:
                    continue
            kept.append(row)
        return kept, False
