"""The connection to gpsd, and the thread that reads it."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from pancakes.mesh.sockets import connect, keep_alive
from pancakes_pi.gps_reports import WATCH, report_in

FIRST_PAUSE_S: Final = 0.2
LONGEST_PAUSE_S: Final = 5.0
"""How long, in host time, a gpsd that is not there is left alone before it is tried again."""
CONNECT_S: Final = 2.0
LOOK_S: Final = 0.2
LONGEST_LINE: Final = 10_240
"""No report is longer (gpsd_json(5))."""

Say = Callable[[str, str], None]


class GpsListener(Protocol):
    """Hears gpsd. Called in the feed's thread."""

    def reported(self, report: Mapping[str, Any]) -> None:
        """A report has come."""
        ...


class GpsFeed:
    """Hears a gpsd; one that is not there, or goes away, is tried again until it is there. It says so once.

    A machine that loses its power, or a network that is cut, says nothing of that on a socket that only listens: the
    kernel asks the other side now and then, and `redial` makes a new connection.

    Args:
        host: where gpsd listens.
        port: its port.
        listener: what hears the reports.
        say: says lines on `log`.
    """

    def __init__(self, host: str, port: int, listener: GpsListener, say: Say) -> None:
        self._at = (host, port)
        self._name = f"gpsd at {host}:{port}"
        self._listener = listener
        self._say = say
        self._ended = threading.Event()
        self._again = threading.Event()
        threading.Thread(target=self._run, name=f"gps-{host}:{port}", daemon=True).start()

    def close(self) -> None:
        """Hears nothing more. Does not wait."""
        self._ended.set()

    def redial(self) -> None:
        """Gives the connection up, which may be dead, for a new one. Does not wait."""
        self._again.set()

    def _run(self) -> None:
        pause_s, complained, quiet = FIRST_PAUSE_S, False, False
        while not self._ended.is_set():
            connected = False
            self._again.clear()
            try:
                with connect(*self._at, CONNECT_S) as gpsd:
                    keep_alive(gpsd)
                    gpsd.settimeout(LOOK_S)
                    gpsd.sendall(WATCH)
                    connected = True
                    complained, pause_s = False, FIRST_PAUSE_S
                    if not quiet:
                        self._say("info", f"hears {self._name}")
                    quiet = False
                    self._hear(gpsd)
                if self._again.is_set() and not self._ended.is_set():
                    quiet = True  # that it was silent was told
                    continue
                reason = "it ended the connection"
            except OSError as error:
                reason = os.strerror(error.errno) if error.errno else str(error)
            quiet = False
            if self._ended.is_set():
                return
            if connected:
                self._say("error", f"{self._name} is gone ({reason}); trying until it is there again")
            elif not complained:
                self._say("warning", f"{self._name} is not there ({reason}); trying until it is")
            complained = True
            self._ended.wait(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _hear(self, gpsd: socket.socket) -> None:
        waiting = b""
        while not (self._ended.is_set() or self._again.is_set()):
            try:
                data = gpsd.recv(4096)
            except TimeoutError:
                continue
            if not data:
                return
            *lines, waiting = (waiting + data).split(b"\n")
            for line in lines:
                if report := report_in(line):
                    self._listener.reported(report)
            if len(waiting) > LONGEST_LINE:
                raise OSError("it does not speak like gpsd")
