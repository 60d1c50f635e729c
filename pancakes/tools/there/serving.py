"""The program that Pancakes runs on a host: it is asked over its standard input, and ends with that.

A request is a line of JSON, `{"id": 1, "do": "look", ...}`, and so is its reply, `{"id": 1, "result": ...}` or
`{"id": 1, "fault": "a clause about the host"}`. What happens there by itself is told as `{"event": "ended", ...}`; each
few seconds `{"event": "alive"}` is. Before each of them stands the marker that `main` is given, behind whatever the
user's shell, or what that has left in the background, prints.
"""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

from pancakes.tools.there.deploying import Deploying
from pancakes.tools.there.host_folders import HostFault, end_process, prepare_environment
from pancakes.tools.there.launched_agents import LaunchedAgents
from pancakes.tools.there.looking import look

SILENCE_S = 20.0
"""A launcher from which nothing came for so long has gone, with its network perhaps: its agents end."""
ALIVE_S = 5.0
"""So often the launcher hears that this program lives, also while it does something that takes long."""
MOST_WAITING = 1 << 20
"""So many bytes wait for the launcher; then the agents wait until they can print on."""
_CHUNK = 65_536


class Serving:
    """Reads requests and carries them out, in one thread, until the standard input ends.

    Args:
        marker: what stands before each answer.
    """

    def __init__(self, marker: bytes) -> None:
        self._marker = marker
        self._out = bytearray()
        self._lock = threading.Lock()
        self._begun = b""
        self._ends = False
        self._heard_s = time.monotonic()
        self._agents = LaunchedAgents(self._emit)
        deploying = Deploying()
        self._calls: dict[str, Callable[..., Any]] = {
            "alive": lambda: None,
            "look": look,
            "end_process": end_process,
            "start": self._agents.start,
            "end": self._agents.end,
            "kill": self._agents.kill,
            **deploying.calls,
        }

    def run(self) -> None:
        """Serves until the launcher has gone, and leaves no agent of a launch behind."""
        reader, writer = os.pipe()
        for end in (reader, writer):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            signal.signal(number, self._told_to_end)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        os.set_blocking(1, False)
        threading.Thread(target=self._live, daemon=True).start()
        try:
            while not self._ends:
                self._turn(reader)
        finally:
            self._agents.end_all()

    def _turn(self, woken: int) -> None:
        calls: dict[int, Callable[[], Any]] = {0: self._read, woken: lambda: os.read(woken, _CHUNK)}
        if len(self._out) < MOST_WAITING:
            calls.update(self._agents.pipes())
        readable, writable, _ = select.select(list(calls), [1] if self._out else [], [], 1.0)
        for handle in readable:
            calls[handle]()
        self._agents.look()
        if writable:
            self._write()
        if self._agents and time.monotonic() - self._heard_s > SILENCE_S:
            self._ends = True

    def _write(self) -> None:
        with self._lock:
            try:
                del self._out[: os.write(1, self._out[:_CHUNK])]
            except BlockingIOError:
                pass
            except OSError:
                self._ends = True

    def _live(self) -> None:
        """Tells that this program lives, in a thread of its own: the other may be at something that takes long."""
        while True:
            time.sleep(ALIVE_S)
            if not self._out:
                self._emit("alive")
                self._write()

    def _told_to_end(self, number: int, frame: Any) -> None:
        self._ends = True

    def _read(self) -> None:
        data = os.read(0, 1 << 20)
        self._heard_s = time.monotonic()
        if not data:
            self._ends = True
        *lines, self._begun = (self._begun + data).split(b"\n")
        for line in lines:
            self._carry_out(json.loads(line))
        self._heard_s = time.monotonic()  # what was asked for may have taken long

    def _carry_out(self, request: dict[str, Any]) -> None:
        number, call = request.pop("id"), self._calls[request.pop("do")]
        try:
            self._say({"id": number, "result": call(**request)})
        except HostFault as fault:
            self._say({"id": number, "fault": str(fault)})
        except OSError as error:
            self._say({"id": number, "fault": _fault_of(error)})

    def _emit(self, event: str, **values: Any) -> None:
        self._say({"event": event, **values})

    def _say(self, what: dict[str, Any]) -> None:
        with self._lock:
            self._out += b"\n" + self._marker + json.dumps(what).encode() + b"\n"


def _fault_of(error: OSError) -> str:
    where = f" ({os.fsdecode(error.filename)})" if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"has no room left on its disk{where}: make room there"
    return f"refuses: {(error.strerror or str(error)).lower()}{where}"


def main(marker: bytes) -> None:
    """Begins.

    Args:
        marker: see above.
    """
    prepare_environment()
    Serving(marker).run()
