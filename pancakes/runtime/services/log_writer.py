"""What the tasks have in common that write down what is said on `log`: each source has no more than its share."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from pancakes.events import LogLine, level_of
from pancakes.packet import LOG, Packet, type_name
from pancakes.runtime.services.shares import Kind, LeftOut, Shares, sentence_of
from pancakes.task import Task

KIB = 1024


class LogWriter(Task):
    """Writes lines somewhere, and a count in place of those that go beyond a source's share.

    A subclass has `share_kib_s` among its settings, gives `write_some` all packets, and writes one in `put`.
    """

    blocking = True  # a disk, a terminal or a pipe may make it wait

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._shares = Shares(self.settings.share_kib_s * KIB)
        self._waits = False

    def on_settings(self) -> None:
        self._tell(self._shares.stopped(self.kernel.host.now()))
        self._shares = Shares(self.settings.share_kib_s * KIB)

    def on_stop(self) -> None:
        self.drain()
        self._tell(self._shares.stopped(self.kernel.host.now()))

    @abstractmethod
    def put(self, packet: Packet) -> int:
        """Writes one packet; returns how many bytes that took, about."""

    def write_some(self, packet: Packet) -> None:
        """Writes a packet where its source has something left of its share, or counts it."""
        now_s = self.kernel.host.now()
        self._tell(self._shares.ended(now_s))
        kind = Kind(packet.source, level_of(packet.body) in ("warning", "error"))
        if self._shares.admits(kind, now_s):
            self._shares.spend(kind, self.put(packet))
        elif not self._waits:
            self._wait()

    def _wait(self) -> None:
        """Has the counts told as soon as their time has passed, also where nothing more is said."""
        until_s = self._shares.next_s()
        self._waits = until_s is not None
        if until_s is not None:
            self.after_host(max(0.0, until_s - self.kernel.host.now()), self._time_has_passed)

    def _time_has_passed(self) -> None:
        self._tell(self._shares.ended(self.kernel.host.now()))
        self._wait()

    def _tell(self, told: list[LeftOut]) -> None:
        for left_out in told:
            body = LogLine("warning", sentence_of(left_out))
            self.put(Packet(LOG, type_name(body), left_out.kind.source, "", self.now(), 0, body))
