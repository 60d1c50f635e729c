"""What a soak's figures mean: pure, so that the verdict itself is tested."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import msgspec
from soak.vitals import Vitals

SLOPE_MIB_PER_H = 1.0
"""Memory may grow that fast, after the warm-up."""
GROWTH_MIB = 2.0
"""In a shorter span than `LONG_S` memory may grow by so much in all: the system gives and takes it by pages, and what
is bounded (accounts of moves, the senders that a task has heard) is still being filled.
"""
LONG_S = 2940.0
"""A span that is long enough for a slope: an hour without its first ten minutes, and without some samples' seconds."""
MORE_PIECES = 6000
"""So many more pieces of memory may be in use at rest: half of it for what is bounded and still being filled."""
FEWEST_SAMPLES = 10
SPARE_THREADS = 1
"""The second worker of an agent's pool is made when it is needed for the first time, and stays."""


class Sample(msgspec.Struct, frozen=True):
    """What was seen of one process at one time.

    Attributes:
        time_s: since the soak's beginning.
        vitals: what it used.
        workers: how many workers ran there; each holds a file open.
        state_files: how many files its state directory holds, without the ledgers of moves: of these it keeps 100.
        pieces: how many pieces of memory were in use when its rubbish was collected last; 0: it never was.
    """

    time_s: float
    vitals: Vitals
    workers: int = 0
    state_files: int = 0
    pieces: int = 0

    def least(self, other: Sample) -> Sample:
        """Returns the least of each figure of two samples."""
        mine, others = (msgspec.structs.asdict(it.vitals) for it in (self, other))
        vitals = Vitals(**{name: min(figure, others[name]) for name, figure in mine.items()})
        pieces = min(self.pieces or other.pieces, other.pieces or self.pieces)
        workers, files = min(self.workers, other.workers), min(self.state_files, other.state_files)
        return Sample(other.time_s, vitals, workers, files, pieces)


class Trend(msgspec.Struct, frozen=True):
    """How a figure went over time.

    Attributes:
        per_hour: its slope.
        span_s: the time that was looked at.
        growth: slope times span.
    """

    per_hour: float
    span_s: float

    @property
    def growth(self) -> float:
        """By how much it grew in the span that was looked at."""
        return self.per_hour * self.span_s / 3600


def trend(points: Sequence[tuple[float, float]]) -> Trend:
    """Returns the slope of a series: the median of the slopes between points of its first and of its last half.

    A few outliers (a collection of garbage that was due, a burst) do not move it, nor does one step in the middle of
    a long and level series.

    Args:
        points: (seconds, figure), in order, at least two.
    """
    half = (len(points) + 1) // 2
    early, late = points[:half], points[len(points) - half :]
    slopes = [(b - a) / (t - s) for s, a in early for t, b in late if t > s]
    return Trend(median(slopes) * 3600, points[-1][0] - points[0][0])


def memory_fault(name: str, samples: Sequence[Sample]) -> tuple[str, Trend | None]:
    """Judges the memory of a process that has lived through all of the samples, taken after the warm-up.

    Returns:
        A sentence about what is wrong, or an empty one; and the trend in MiB, None where there are too few samples.
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
    """Returns a sentence that says what a run whose memory was followed for so long can show, and what it cannot."""
    if span_s >= LONG_S:
        return f"no agent's memory grows by more than {SLOPE_MIB_PER_H:g} MiB/h"
    least = GROWTH_MIB * 3600 / max(span_s, 1.0)
    return (
        f"{span_s / 60:.0f} min show a leak of {least:.0f} MiB/h or more, and one of small objects where it comes to"
        f" {MORE_PIECES} of them; that memory grows by less than {SLOPE_MIB_PER_H:g} MiB/h takes an hour to see"
    )


def lost_pieces(name: str, before: Sample, after: Sample) -> str:
    """Compares the memory that an agent has in use at rest, before and after much has happened.

    It is counted in pieces, of which there is one for most objects. Whatever the system does with its pages, and
    however short the time, these are the same for the same work.

    Returns:
        A sentence about what is wrong, or an empty one.
    """
    more = after.pieces - before.pieces
    if not before.pieces or not after.pieces:
        return f"{name}: its rubbish was never collected, so nothing is known of its memory at rest"
    if more > MORE_PIECES:
        return f"{name}: {more} more pieces of memory are in use at rest, and {MORE_PIECES} would do"
    return ""


def leaks(name: str, before: Sample, after: Sample, records: int) -> list[str]:
    """Compares an agent that does nothing with itself, before and after much has happened.

    Args:
        name: its name.
        before: what was seen of it then.
        after: what was seen of it now.
        records: how many files it may have in its state directory: one for each task that was ever there, and a few.

    Returns:
        A sentence for each thing of which there is more.
    """
    was, now = before.vitals, after.vitals
    pairs = (
        ("threads", was.threads + SPARE_THREADS, now.threads),
        ("sockets", was.sockets, now.sockets),
        ("other open files", was.files - before.workers, now.files - after.workers),
    )
    found = [f"{name}: {there} {what}, and {here} would do" for what, here, there in pairs if there > here]
    if after.state_files > records:
        found.append(f"{name}: {after.state_files} files in its state directory, and {records} would do")
    return found
