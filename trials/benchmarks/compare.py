"""What has become slower since an earlier run: the figures of both, by topic and name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import quantiles
from typing import Any

LEAST_CHANGE = 0.05
"""A smaller change is none, however little the rounds differ."""
ONE_RUN_CHANGE = 0.25
"""A figure that was measured only once shows no spread; so much counts as its noise."""

Record = Mapping[str, Any]


def slower(old: Sequence[Record], new: Sequence[Record]) -> list[str]:
    """Returns a line for each figure that became worse by more than the noise.

    It did if its value and its ratio to the baseline both did, by more than 5 %, and if the better half of the rounds
    is still worse than the worse half of the old ones (their quartiles do not overlap). The value is looked at because
    a baseline that happened to be faster makes nothing slower; so both runs should be of one machine.

    Args:
        old: the records of the earlier run.
        new: those of this run.
    """
    before = {_key(record): record for record in old if "value" in record}
    lines = []
    for record in new:
        then = before.get(_key(record))
        if then is None or "value" not in record:
            continue
        sides = [(then["value"], then["runs"], record["value"], record["runs"])]
        if then["ratio"] is not None and record["ratio"] is not None:
            sides.append((then["ratio"], _ratios(then), record["ratio"], _ratios(record)))
        if all(_is_worse(*side, sign=-1.0 if record["sense"] == "min" else 1.0) for side in sides):
            was, _, now, _ = sides[-1]
            unit = record["unit"] if len(sides) == 1 else "of the bare one"
            lines.append(f"{record['name']}: {was:.4g} -> {now:.4g} {unit}".rstrip())
    return lines


def _key(record: Record) -> tuple[str, str]:
    """Returns what a figure is known by: several topics measure a round trip."""
    return record.get("topic", ""), record["name"]


def _is_worse(was: float, runs_then: Sequence[float], now: float, runs: Sequence[float], sign: float) -> bool:
    change = sign * (now - was)
    if min(len(runs_then), len(runs)) < 2:
        return change > ONE_RUN_CHANGE * abs(was)
    return change > LEAST_CHANGE * abs(was) and _quartile(runs, sign, 0) > _quartile(runs_then, sign, 2)


def _ratios(record: Record) -> list[float]:
    return [ours / bare for ours, bare in zip(record["runs"], record["baseline_runs"], strict=True)]


def _quartile(runs: Sequence[float], sign: float, which: int) -> float:
    """Returns a quartile of the rounds, counted so that more is worse."""
    return quantiles((sign * run for run in runs), n=4, method="inclusive")[which]
