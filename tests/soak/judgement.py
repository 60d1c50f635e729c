"""What a soak's figures mean: pure, so that the verdict itself is tested."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import msgspec
from soak.vitals import Vitals

SLOPE_MIB_PER_H = 1.0
"""Memory may grow that fast, after the warm-up."""
GROWTH_MIB = 1.0
"""In a shorter span than `LONG_S` memory may grow by so much in all, since no slope can be told from noise."""
LONG_S = 3000.0
"""A span that is long enough for a slope: an hour without its first ten minutes."""
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
    """

    time_s: float
    vitals: Vitals
    workers: int = 0
    state_files: int = 0


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
