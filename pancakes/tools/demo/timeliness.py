"""Whether the machine kept up with a mission that ran in real time, and where it did not. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

BEHIND_S: Final = 0.25
"""A world that lies further behind the clock than this, or a tick that is later, in mission seconds, is said to."""
MISSED_SHARE: Final = 0.01
"""So is a task that missed a larger share of its ticks, and more than one."""
NAMED: Final = 3
"""The most tasks that are named, those that missed most; of the others the number is told."""


@dataclass(frozen=True, slots=True)
class Ticks:
    """How a task's ticks came.

    Attributes:
        task: the task, as `agent/service/task`.
        ticks: how many came.
        missed: how many never did.
        late_max_s: how late the latest was, in mission seconds.
    """

    task: str
    ticks: int
    missed: int
    late_max_s: float

    def was_late(self) -> bool:
        """Returns whether so many were missed, or one was so late, that it may have changed the mission."""
        return self.missed > max(1.0, MISSED_SHARE * (self.ticks + self.missed)) or self.late_max_s > BEHIND_S


def ticks_of(agent: str, description: Mapping[str, Any]) -> list[Ticks]:
    """Returns how the ticks of an agent's tasks came, from its answer to `Describe`."""
    return [
        Ticks(f"{agent}/{it['service']}/{it['task']}", it["ticks"], it["missed"], it["lateness_max_s"])
        for it in description["tasks"]
        if it["ticks"] or it["missed"]
    ]


def late_ones(ticks: Iterable[Ticks]) -> list[dict[str, Any]]:
    """Returns the tasks that were late, as plain values, the worst first."""
    late = [it for it in ticks if it.was_late()]
    return [asdict(it) for it in sorted(late, key=lambda it: (-it.missed, -it.late_max_s, it.task))]


def how_slow(timing: Mapping[str, Any]) -> str:
    """Returns where the machine fell behind, as it stands in `timing.json`; empty where it kept up."""
    parts = []
    if timing.get("behind_max_s", 0.0) > BEHIND_S:
        parts.append(f"the world fell behind the clock by up to {timing['behind_max_s']:.2f} s of mission time")
    late = timing.get("late_tasks", ())
    for it in late[:NAMED]:
        missed = f"missed {it['missed']} of {it['ticks'] + it['missed']} ticks and " if it["missed"] else ""
        parts.append(f"{it['task']} {missed}was up to {it['late_max_s']:.2f} s late")
    if len(late) > NAMED:
        parts.append(f"{len(late) - NAMED} more tasks were late")
    return "; ".join(parts)


def verdict_line(verdict: str, slow: str) -> str:
    """Returns a mission's verdict, and where the machine was too slow for it, in one line."""
    if not slow:
        return verdict
    return f"{verdict}, {'though' if verdict == 'PASS' else 'and'} this machine was too slow: {slow}"


def hint_of(verdict: str, timings: Iterable[Mapping[str, Any]]) -> str:
    """Returns what the machine has to do with a mission that has failed in real time; empty: nothing.

    Where ticks were in time a mission may fail of the machine all the same: a message between two agents that comes
    late is no late tick.
    """
    live = [timing for timing in timings if timing.get("mode") == "live"]
    if verdict == "PASS" or not live:
        return ""
    worst = max(live, key=lambda timing: float(timing.get("busy", 0.0)))
    percent = 100 * float(worst.get("busy", 0.0))
    return (
        f"in real time the machine counts: its {worst.get('processors', 1)} processors were busy for {percent:.0f} %"
        f" of the mission. Try --speed {worst['speed'] / 2:g}, without other programs, or --virtual, which no load"
        " changes"
    )
