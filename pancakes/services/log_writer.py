"""Write what is said on `log`, with at most a share for each source, and count what goes beyond it.

`LogWriter` is the base of the tasks that do; `Shares` decides whose line is written."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from pancakes.events import LogLine, level_of
from pancakes.packet import LOG, Packet, type_name
from pancakes.task import Task

if TYPE_CHECKING:
    pass


WINDOW_S: Final = 5.0
"""A share is counted over this many seconds of host time, so that a source may write much at once, now and then."""


class Kind(NamedTuple):
    """What has a share of its own: the plain lines of a source, and its urgent ones, so that no flood hides an error.

    Attributes:
        source: its address.
        urgent: whether these are its warnings and errors.
    """

    source: str
    urgent: bool


class LeftOut(NamedTuple):
    """What went beyond a share.

    Attributes:
        kind: the source of the lines, and whether they are urgent.
        lines: how many lines.
        in_s: over how many seconds.
    """

    kind: Kind
    lines: int
    in_s: float


class _Window(msgspec.Struct):
    """What one kind has used of its share since `began_s`."""

    began_s: float
    bytes: int = 0
    left_out: int = 0


class Shares:
    """Says which lines are written, and counts those that are not.

    The share of a kind is counted from its first line on. Once it is used up, all that follows is left out until
    `WINDOW_S` have passed. The line that uses it up is written whole.

    Args:
        bytes_per_s: the share of each kind; 0: there is no limit.
    """

    def __init__(self, bytes_per_s: float) -> None:
        self._most = bytes_per_s * WINDOW_S
        self._windows: dict[Kind, _Window] = {}  # those that began first come first

    def admits(self, kind: Kind, now_s: float) -> bool:
        """Return whether a line may be written; where not, it is counted. `ended` must have been asked just before."""
        if not self._most:
            return True
        window = self._windows.get(kind)
        if window is None:
            window = self._windows[kind] = _Window(now_s)
        if window.bytes < self._most:
            return True
        window.left_out += 1
        return False

    def spend(self, kind: Kind, size: int) -> None:
        """Count the bytes of a line that was admitted."""
        window = self._windows.get(kind)
        if window is not None:
            window.bytes += size

    def ended(self, now_s: float) -> list[LeftOut]:
        """End the windows whose time has passed; return what was left out in them, in their order."""
        told = []
        while self._windows:
            kind, window = next(iter(self._windows.items()))
            if now_s < window.began_s + WINDOW_S:
                break
            del self._windows[kind]
            if window.left_out:
                told.append(LeftOut(kind, window.left_out, WINDOW_S))
        return told

    def stopped(self, now_s: float) -> list[LeftOut]:
        """End all windows at once; return as `ended` does."""
        told = [
            LeftOut(kind, window.left_out, now_s - window.began_s)
            for kind, window in self._windows.items()
            if window.left_out
        ]
        self._windows.clear()
        return told

    def next_s(self) -> float | None:
        """Return when the first window ends in which something was left out; None: nothing was."""
        for window in self._windows.values():
            if window.left_out:
                return window.began_s + WINDOW_S
        return None


def sentence_of(left_out: LeftOut) -> str:
    """Return what stands in place of the lines that were left out."""
    lines = "1 more line" if left_out.lines == 1 else f"{left_out.lines:,} more lines"
    were = "was" if left_out.lines == 1 else "were"
    return f"{lines} in the last {max(left_out.in_s, 0.1):.2g} s {were} left out"


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
        self._tell(self._shares.stopped(self._actor.kernel.host.now()))
        self._shares = Shares(self.settings.share_kib_s * KIB)

    def on_stop(self) -> None:
        self._actor.drain()
        self._tell(self._shares.stopped(self._actor.kernel.host.now()))

    @abstractmethod
    def put(self, packet: Packet) -> int:
        """Write one packet; return how many bytes that took, about."""

    def write_some(self, packet: Packet) -> None:
        """Write a packet if its source has something left of its share; otherwise count it."""
        now_s = self._actor.kernel.host.now()
        self._tell(self._shares.ended(now_s))
        kind = Kind(packet.source, level_of(packet.body) in ("warning", "error"))
        if self._shares.admits(kind, now_s):
            self._shares.spend(kind, self.put(packet))
        elif not self._waits:
            self._wait()

    def _wait(self) -> None:
        """Have the counts told as soon as their time has passed, even if nothing more is said."""
        until_s = self._shares.next_s()
        self._waits = until_s is not None
        if until_s is not None:
            self.after_host(max(0.0, until_s - self._actor.kernel.host.now()), self._time_has_passed)

    def _time_has_passed(self) -> None:
        self._tell(self._shares.ended(self._actor.kernel.host.now()))
        self._wait()

    def _tell(self, told: list[LeftOut]) -> None:
        for left_out in told:
            body = LogLine("warning", sentence_of(left_out))
            self.put(Packet(LOG, type_name(body), left_out.kind.source, "", self.now(), 0, body))
