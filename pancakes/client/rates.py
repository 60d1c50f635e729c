"""Measure the rates, the lateness and the processor shares that agents and tasks achieve.

Pure: descriptions (the results of `Describe`) go in, rows come out. `RateMeter` compares each description with those
before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

SPAN_S: Final = 10.0
"""Rates are measured over this much mission time, or since the first description if that is less."""
FEWEST_TICKS: Final = 2.0
"""No rate is given for fewer ticks than this: one tick more or less would change it too much."""

Described = Mapping[str, Any]
"""The `result` of `Describe` of an agent, or of one of its tasks."""


@dataclass(frozen=True, slots=True)
class _TaskSample:
    """The counters of a task in one description: mission time, ticks so far, and the sum of their lateness."""

    mission_s: float
    ticks: int
    lateness_sum_s: float


class RateMeter:
    """Compare each description of the agents with those before it."""

    def __init__(self) -> None:
        self._agents: dict[tuple[str, str], Described] = {}
        self._tasks: dict[tuple[Any, ...], deque[_TaskSample]] = {}

    def update(self, described: Iterable[Described]) -> list[dict[str, Any]]:
        """Take what the agents report about themselves now.

        Returns:
            A row for each agent, by fleet and name. `processor_share` (of one processor), `lateness_s` (mean of all
            ticks) and a task's `achieved_hz` and `lateness_s` are None while there is nothing to compare with. The
            `state` is "no answer" if an agent answered before and does not now.
        """
        now = {(it["fleet"], it["agent"]): it for it in described}
        rows = [
            self._agent(now[key], self._agents.get(key)) if key in now else _silent(self._agents[key])
            for key in sorted({*now, *self._agents})
        ]
        self._agents.update(now)
        return rows

    def _agent(self, now: Described, before: Described | None) -> dict[str, Any]:
        tasks = [self._task(now, task) for task in now["tasks"]]
        ticked = [task for task in tasks if task["lateness_s"] is not None]
        ticks = sum(task.pop("_ticks") for task in tasks)
        late_s = sum(task.pop("_late_s") for task in tasks)
        process = now["process"]
        return {
            "agent": now["agent"],
            "fleet": now["fleet"],
            "role": now["role"],
            "state": "held" if now["held"] else "ready" if now["ready"] else "starting",
            "mission_s": now["mission_s"],
            "processor_share": _processor_share(now, before),
            "memory_mib": process["memory_mib"] if process is not None else None,
            "lateness_s": late_s / ticks if ticked and ticks else None,
            "links": sum(peer["role"] != "client" for peer in now["mesh"]["peers"]),
            "missed": sum(task["missed"] for task in tasks),
            "dropped": sum(task["dropped"] for task in tasks),
            "battery_level": now["battery_level"],
            "tasks": tasks,
        }

    def _task(self, agent: Described, task: Described) -> dict[str, Any]:
        # A new incarnation counts from 0, and a new rate is measured by itself.
        name = (agent["fleet"], task["agent"], task["service"], task["task"])
        key = (*name, task["incarnation"], task["rate_hz"])
        samples = self._tasks.get(key)
        if samples is None or agent["mission_s"] < samples[-1].mission_s or task["ticks"] < samples[-1].ticks:
            self._tasks = {other: it for other, it in self._tasks.items() if other[:4] != name}
            samples = self._tasks[key] = deque()
        samples.append(_TaskSample(agent["mission_s"], task["ticks"], task["lateness_sum_s"]))
        while samples[-1].mission_s - samples[0].mission_s > SPAN_S and len(samples) > 2:
            samples.popleft()
        first, last = samples[0], samples[-1]
        ticks = last.ticks - first.ticks
        late_s = last.lateness_sum_s - first.lateness_sum_s
        return {
            **{column: task[column] for column in ("agent", "service", "task", "type", "state", "rate_hz")},
            "rest": task.get("rest", ""),
            "achieved_hz": _rate_hz(task["rate_hz"], ticks, last.mission_s - first.mission_s),
            "lateness_s": late_s / ticks if ticks else None,
            "missed": task["missed"],
            "dropped": task["dropped"],
            "restarts": max(0, task["incarnation"] - 1),
            "_ticks": ticks,
            "_late_s": late_s,
        }


def _rate_hz(wanted_hz: float | None, ticks: int, span_s: float) -> float | None:
    if wanted_hz is None or span_s <= 0.0:
        return None
    return ticks / span_s if max(ticks, wanted_hz * span_s) >= FEWEST_TICKS or not wanted_hz else None


def _processor_share(now: Described, before: Described | None) -> float | None:
    is_process = now["process"]
    was_process = before["process"] if before is not None else None
    if is_process is None or was_process is None or is_process["pid"] != was_process["pid"]:
        return None
    span_s = is_process["uptime_s"] - was_process["uptime_s"]
    return max(0.0, is_process["processor_s"] - was_process["processor_s"]) / span_s if span_s > 0.0 else None


def _silent(before: Described) -> dict[str, Any]:
    nothing = dict.fromkeys(("mission_s", "processor_share", "memory_mib", "lateness_s", "links", "missed", "dropped"))
    known = {name: before[name] for name in ("agent", "fleet", "role")}
    return {**known, "state": "no answer", **nothing, "battery_level": None, "tasks": []}
