"""Judge the figures of a soak. Pure, so that the judgement itself is tested."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import msgspec
from soak.vitals import Vitals

SLOPE_MIB_PER_H = 1.0
"""How fast memory may grow after the warm-up."""
GROWTH_MIB = 2.0
"""How much memory may grow in all in a span shorter than `LONG_S`: the system assigns memory in pages, and bounded
buffers (ledgers of migrations, the senders that a task has heard) are still being filled.
"""
LONG_S = 2940.0
"""A span that is long enough to judge a slope: an hour without its first ten minutes and the time of some samples."""
MORE_PIECES = 6000
"""How many more memory blocks may be in use at rest; half of them for bounded buffers that are still being filled."""
FEWEST_SAMPLES = 10
SPARE_THREADS = 1
"""An agent's pool may get a second worker thread when it is first needed; it stays."""


class Sample(msgspec.Struct, frozen=True):
    """A sample of one process.

    Attributes:
        time_s: the time since the beginning of the soak.
        vitals: the resources that it used.
        workers: how many workers ran there; each holds a file open.
        state_files: how many files its state directory has, without the ledgers of migrations, of which it keeps 100.
        pieces: how many memory blocks were in use at its last garbage collection; 0: there was none.
    """

    time_s: float
    vitals: Vitals
    workers: int = 0
    state_files: int = 0
    pieces: int = 0

    def least(self, other: Sample) -> Sample:
        """Return the least of each figure of two samples."""
        mine, others = (msgspec.structs.asdict(it.vitals) for it in (self, other))
        vitals = Vitals(**{name: min(figure, others[name]) for name, figure in mine.items()})
        pieces = min(self.pieces or other.pieces, other.pieces or self.pieces)
        workers, files = min(self.workers, other.workers), min(self.state_files, other.state_files)
        return Sample(other.time_s, vitals, workers, files, pieces)


class Trend(msgspec.Struct, frozen=True):
    """The trend of a figure.

    Attributes:
        per_hour: its slope.
        span_s: the time between the first and the last sample.
    """

    per_hour: float
    span_s: float

    @property
    def growth(self) -> float:
        """How much it grew: slope times span."""
        return self.per_hour * self.span_s / 3600


def trend(points: Sequence[tuple[float, float]]) -> Trend:
    """Return the slope of a series: the median of the slopes between points of its first and of its last half.

    A few outliers (a late garbage collection, a burst) do not change it, nor does one step in the middle of a long
    level series.

    Args:
        points: (seconds, figure), in order, at least two.
    """
    half = (len(points) + 1) // 2
    early, late = points[:half], points[len(points) - half :]
    slopes = [(b - a) / (t - s) for s, a in early for t, b in late if t > s]
    return Trend(median(slopes) * 3600, points[-1][0] - points[0][0])


def memory_fault(name: str, samples: Sequence[Sample]) -> tuple[str, Trend | None]:
    """Judge the memory of a process that ran through all samples, which were taken after the warm-up.

    Returns:
        A sentence about the fault, empty if there is none; and the trend in MiB, None if there are too few samples.
    """
    if len(samples) < FEWEST_SAMPLES:
        return f"{name}: only {len(samples)} samples of its memory", None
    found = trend([(sample.time_s, sample.vitals.rss_kib / 1024) for sample in samples])
    if found.span_s >= LONG_S:
        if found.per_hour > SLOPE_MIB_PER_H:
            return f"{name}: its memory grows by {found.per_hour:.2f} MiB/h", found
    elif found.growth > GROWTH_MIB:
        return f"{name}: its memory grew by {found.growth:.2f} MiB in {found.span_s:.0f} s", found
    return "", found


def shown(span_s: float) -> str:
    """Return a sentence about which leaks a run of this length can show."""
    if span_s >= LONG_S:
        return f"no agent's memory grows by more than {SLOPE_MIB_PER_H:g} MiB/h"
    least = GROWTH_MIB * 3600 / max(span_s, 1.0)
    return (
        f"{span_s / 60:.0f} min show a leak of at least {least:.0f} MiB/h, or of at least {MORE_PIECES} small objects;"
        f" a run of an hour shows a growth of {SLOPE_MIB_PER_H:g} MiB/h"
    )


def lost_pieces(name: str, before: Sample, after: Sample) -> str:
    """Compare the memory of an agent at rest, before and after many actions.

    Memory is counted in blocks, about one per object. Unlike the system's pages, their number is the same for the same
    work, however short the time.

    Returns:
        A sentence about the fault; empty if there is none.
    """
    more = after.pieces - before.pieces
    if not before.pieces or not after.pieces:
        return f"{name}: it had no garbage collection, so its memory at rest is unknown"
    if more > MORE_PIECES:
        return f"{name}: {more} more pieces of memory are in use at rest, at most {MORE_PIECES} are allowed"
    return ""


def leaks(name: str, before: Sample, after: Sample, records: int) -> list[str]:
    """Compare the resources of an agent at rest, before and after many actions.

    Args:
        name: its name.
        before: its sample before.
        after: its sample after.
        records: how many files its state directory may have: one for each task that was ever there, and some others.

    Returns:
        A sentence for each resource of which there is more.
    """
    was, now = before.vitals, after.vitals
    pairs = (
        ("threads", was.threads + SPARE_THREADS, now.threads),
        ("sockets", was.sockets, now.sockets),
        ("other open files", was.files - before.workers, now.files - after.workers),
    )
    found = [f"{name}: {count} {what}, at most {limit} are allowed" for what, limit, count in pairs if count > limit]
    if after.state_files > records:
        found.append(f"{name}: {after.state_files} files in its state directory, at most {records} are allowed")
    return found
