"""How often packets come, how evenly, and how large they are. Pure: packets and times go in, rows come out."""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from pancakes.mesh.wire.codec import Encoder
from pancakes.packet import Packet

WINDOW: Final = 1000
"""So many of the newest packets of one source and type are looked at, where nothing else is said."""

_ENCODER: Final = Encoder()


def size_of(packet: Packet) -> int:
    """Returns how many bytes a packet takes on the wire, apart from the name of its follower.

    In the main thread only. A frame around one or several packets adds a few more.
    """
    return len(_ENCODER.packet(replace(packet, destination="")))


class _Arrival(NamedTuple):
    """One packet: its time, for the intervals; the host time at which it came; its size."""

    time_s: float
    at_s: float
    size: int


@dataclass(slots=True)
class _PacketSeries:
    """The newest packets of one source and type."""

    newest: deque[_Arrival]
    packets: int = 0
    new: int = 0


class Throughput:
    """Looks at packets, those of each source and type by themselves.

    Args:
        began_s: when it was begun to listen, in host time.
        window: how many packets of each source and type are looked at.
        arrivals: whether intervals are those at which packets came, in host time, instead of those at which they were
            published, in the publisher's mission time.
    """

    def __init__(self, began_s: float, window: int = WINDOW, arrivals: bool = False) -> None:
        self._began_s = began_s
        self._window = window
        self._arrivals = arrivals
        self._series: dict[tuple[str, str], _PacketSeries] = {}
        self.packets = 0

    def add(self, packet: Packet, at_s: float, size: int = 0) -> None:
        """Takes a packet that came at a host time."""
        key = (packet.source, packet.type)
        it = self._series.get(key)
        time_s = at_s if self._arrivals else packet.stamp
        if it is None or time_s < it.newest[-1].time_s:
            # A mission time that goes back is that of an agent that was started anew.
            it = self._series[key] = _PacketSeries(deque(maxlen=self._window))
        it.newest.append(_Arrival(time_s, at_s, size))
        it.packets += 1
        it.new += 1
        self.packets += 1

    def rows(self, now_s: float, new_only: bool = False) -> list[dict[str, Any]]:
        """Returns a row for each source and type, by their names.

        Args:
            now_s: host time.
            new_only: leaves those out that nothing came of since the call before.

        Returns:
            For each `source`, `type`, `packets` (all of them), `window` (those that the rest is about), `rate_hz`,
            `min_s`, `max_s` and `std_dev_s` of the intervals (None where there is none), `bytes_per_s` of host time,
            `min_bytes`, `mean_bytes` and `max_bytes`.
        """
        rows = []
        for (source, kind), it in sorted(self._series.items()):
            if it.new or not new_only:
                head = {"source": source, "type": kind, "packets": it.packets, "window": len(it.newest)}
                rows.append({**head, **_intervals(it.newest), **_sizes(it, self._began_s, now_s)})
            it.new = 0
        return rows


def _intervals(newest: deque[_Arrival]) -> dict[str, float | None]:
    intervals = [after.time_s - before.time_s for before, after in pairwise(newest)]
    whole_s = sum(intervals)
    if not intervals or whole_s <= 0.0:  # a mission that is held stands at 0
        return {"rate_hz": None, "min_s": None, "max_s": None, "std_dev_s": None}
    rate_hz, spread_s = len(intervals) / whole_s, statistics.pstdev(intervals)
    return {"rate_hz": rate_hz, "min_s": min(intervals), "max_s": max(intervals), "std_dev_s": spread_s}


def _sizes(it: _PacketSeries, began_s: float, now_s: float) -> dict[str, float | None]:
    sizes = [arrival.size for arrival in it.newest]
    if it.packets == len(sizes):
        whole, since_s = sum(sizes), began_s
    else:  # the window begins with its first packet, which therefore does not count
        whole, since_s = sum(sizes[1:]), it.newest[0].at_s
    return {
        "bytes_per_s": whole / (now_s - since_s) if now_s > since_s else None,
        "min_bytes": min(sizes),
        "mean_bytes": sum(sizes) / len(sizes),
        "max_bytes": max(sizes),
    }
