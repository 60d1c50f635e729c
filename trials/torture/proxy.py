"""A proxy between two agents that reads their packets, and cuts the link or loses a packet at a chosen message."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
from collections.abc import Callable
from enum import Enum
from typing import Any

import msgspec

from pancakes.mesh.address import is_local
from pancakes.mesh.codec import FrameReader, unpacked
from pancakes.mesh.messages import HELLO_NUMBER, Gossip

RUN = 0
"""The beginning of the array of a run of packets; see `pancakes.mesh.codec`."""

_NUMBERS = itertools.count()

LISTEN = 7  # the index of the sender's addresses in a hello


class Verdict(Enum):
    """What the proxy does with a packet."""

    PASS = "pass"
    LOSE = "lose"
    """Lose it; later packets arrive."""
    END = "end"
    """Lose it and everything else on this connection: its sender is dead."""


Watch = Callable[[list[Any]], Verdict]
"""Called with each packet: [channel, type, source, destination, stamp, seq, cause, body, fence]."""


def _listener(target: str) -> tuple[socket.socket, str]:
    """Return a socket that accepts connections in place of `target`, and its address."""
    if is_local(target):
        made = socket.socket(socket.AF_UNIX)
        path = f"{target.removeprefix('local://')}-{next(_NUMBERS)}"
        made.bind(path)
        made.listen()
        return made, f"local://{path}"
    made = socket.create_server(("127.0.0.1", 0))
    return made, f"tcp://127.0.0.1:{made.getsockname()[1]}"


def _connected(target: str) -> socket.socket:
    if is_local(target):
        made = socket.socket(socket.AF_UNIX)
        try:
            made.connect(target.removeprefix("local://"))
        except BaseException:
            made.close()
            raise
        return made
    host, _, port = target.removeprefix("tcp://").rpartition(":")
    made = socket.create_connection((host, int(port)), 2.0)
    made.settimeout(None)
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return made


class Proxy:
    """A proxy between two agents.

    Each agent's addresses are removed from its hello, and its gossip about other agents is dropped, so that no
    connection can bypass the proxy.

    Args:
        target: the address of the other agent, `tcp://host:port` or `local:///path`; the proxy has the same scheme.
        watch: decides what to do with each packet, in the connection's own thread; None: all pass.

    Attributes:
        address: the address of the proxy.
        cut: set once the link has been cut.
    """

    def __init__(self, target: str, watch: Watch | None = None) -> None:
        self._target = target
        self._watch = watch
        self._listener, self.address = _listener(target)
        self.cut = threading.Event()
        self._open = True
        self._word = ""
        self._flows = (threading.Event(), threading.Event())
        for flow in self._flows:
            flow.set()
        self._lock = threading.Lock()
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._ended = False
        threading.Thread(target=self._accept, daemon=True).start()

    def cut_at(self, word: str) -> None:
        """Cut the link when the next packet of this type is on its way; neither it nor anything after it arrives."""
        with self._lock:
            self._word = word

    def heal(self) -> None:
        """Restore the link."""
        with self._lock:
            self._open = True

    def hold(self, there: bool, back: bool) -> None:
        """Hold all data, or release it: nothing is lost, everything is late, and neither end notices.

        Args:
            there: whether to hold the data from the agent that dials.
            back: whether to hold the data from the other one.
        """
        for flow, held in zip(self._flows, (there, back), strict=True):
            if held:
                flow.clear()
            else:
                flow.set()

    def close(self) -> None:
        """End it, and all connections."""
        self._ended = True
        self.hold(False, False)
        self._listener.close()
        self._break()

    def _break(self) -> None:
        with self._lock:
            pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for one in pair:
                try:
                    # Close with a reset, so that data on its way is lost, as on a cut link.
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
                far = _connected(self._target)
            except OSError:
                near.close()
                continue
            with self._lock:
                self._pairs.append((near, far))
            threading.Thread(target=self._carry_both, args=(near, far), daemon=True).start()

    def _carry_both(self, near: socket.socket, far: socket.socket) -> None:
        """Forward both ways until both have ended, and close both."""
        back = threading.Thread(target=self._carry, args=(far, near, self._flows[1]), daemon=True)
        back.start()
        self._carry(near, far, self._flows[0])
        back.join()
        with self._lock:
            if (near, far) in self._pairs:
                self._pairs.remove((near, far))
        near.close()
        far.close()

    def _carry(self, source: socket.socket, sink: socket.socket, flow: threading.Event) -> None:
        reader = FrameReader()
        try:
            while data := source.recv(1 << 18):
                flow.wait()
                for payload in reader.feed(data):
                    messages = unpacked(payload)
                    if self._is_cut_by(messages):
                        return
                    kept, ends = self._judged(messages)
                    if kept:
                        whole = bytes(payload) if kept == messages else msgspec.msgpack.encode(kept)
                        sink.sendall(struct.pack(">I", len(whole)) + whole)
                    if ends:
                        return
            flow.wait()  # the end of the data is held, too
        except OSError:
            pass
        finally:
            for one in (source, sink):
                try:
                    one.shutdown(socket.SHUT_RDWR)
                except OSError:  # already closed
                    pass

    def _is_cut_by(self, messages: list[list[Any]]) -> bool:
        if not self._word or not any(message[0] == RUN and message[2] == self._word for message in messages):
            return False
        with self._lock:
            self._word, self._open = "", False
        self._break()
        self.cut.set()
        return True

    def _judged(self, messages: list[list[Any]]) -> tuple[list[list[Any]], bool]:
        """Return the messages that may arrive, and whether they are the last ones."""
        kept: list[list[Any]] = []
        for message in messages:
            if message[0] == HELLO_NUMBER:
                kept.append(message[:LISTEN] + [[]])
            elif message[0] == RUN and self._watch is not None:
                rows, ends = self._judged_run(message, self._watch)
                if rows:
                    kept.append([*message[:-1], rows])
                if ends:
                    return kept, True
            elif message[0] != Gossip.__struct_config__.tag:
                kept.append(message)
        return kept, False

    def _judged_run(self, run: list[Any], watch: Watch) -> tuple[list[list[Any]], bool]:
        """Return the rows of a run that may arrive, and whether they are the last ones."""
        kept: list[list[Any]] = []
        for row in run[-1]:
            verdict = watch([*run[1:5], *row, run[5]])
            if verdict is Verdict.END:
                return kept, True
            if verdict is Verdict.PASS:
                kept.append(row)
        return kept, False
