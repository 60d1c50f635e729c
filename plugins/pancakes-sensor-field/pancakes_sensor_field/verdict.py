"""The verdict on a mission in a sensor field: did the alarm come in time, from only one task, and what was saved?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import Holder, holders
from pancakes_sensor_field.record import Record, Row, Table, find_task, read_record


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a mission.

    Attributes:
        raised_within_s: time from a fire's start to the alarm; it may come earlier, because motion is seen first.
        gap_s: time in which no agent ran the alarm, at a migration.
        overlap_s: how well the mission clocks of two agents agree.
        saved_share: what a sleeping node must save, as a share of what it would use always on; one that ran the
            alarm had to stay awake for that.
    """

    raised_within_s: float = 20.0
    gap_s: float = 1.0
    overlap_s: float = 0.05
    saved_share: float = 0.35


SEEN_BEFORE_S = 30.0
"""An alarm is for a fire if it comes no earlier than this before the fire breaks out."""


def judge_sensor_field(run: Run, limits: Limits = Limits()) -> dict[str, Any]:
    """Judge a mission in which fires break out and the alarm migrates.

    Args:
        run: the mission; it left `field.csv` and `events.jsonl`.
        limits: its limits.

    Returns:
        The contents of `summary.json`.

    Raises:
        PancakesError: the files or the configurations cannot be read.
    """
    record = read_record(run.out)
    field = find_task(run.configs, "sensor_field.Field")[2]["settings"]
    first, name, task = find_task(run.configs, "sensor_field.Alarm")
    rule = task.get("migrate") or {}
    held = holders(record, name, run.ended_s)
    gaps = [later.start_s - earlier.end_s for earlier, later in pairwise(held)]
    asked = [line for event in record.told("migration", task=name) for line in event.fields.get("lines", ())]
    arrived = next(record.told("task_arrived", task=name), None)
    tallies = list(record.told("tally"))
    alarms = _alarms(record, field["fires"])
    summary: dict[str, Any] = {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "alarms": alarms,
        "false_alarms": sum(1 for alarm in alarms if alarm["fire"] is None),
        "missed_fires": _missed(alarms, field["fires"], run.ended_s - limits.raised_within_s),
        "holders": [asdict(holder) for holder in held],
        "gap_s": max((max(gap, 0.0) for gap in gaps), default=None),
        "overlap_s": max((max(-gap, 0.0) for gap in gaps), default=0.0),
        "battery_fell_s": _fell(record.nodes.get(first, ()), rule.get("below")),
        "bids": [{"agent": line["peer"], "cost": line["cost"]} for line in asked if line.get("cost") is not None],
        "refusals": [
            {"agent": line["peer"], "reason": line.get("reason", "")} for line in asked if line["answer"] == "refused"
        ],
        "state_moved": _state(arrived.fields.get("state", {})) if arrived is not None else None,
        "reports": dict(tallies[-1].fields["heard"]) if tallies else {},
        "reports_told_s": tallies[-1].t_s if tallies else None,
        "energy": _energy(record, run.configs, field),
    }
    reasons = [f"the mission broke off: {run.ended_because}"] if run.ended_because else []
    reasons += _alarm_reasons(summary, limits)
    reasons += _move_reasons(summary, name, held, limits)
    reasons += _report_reasons(summary, list(field["nodes"]), first, run.ended_s)
    reasons += _energy_reasons(summary, [holder.agent for holder in held], limits)
    summary["said"] = _said(summary, name)
    return {"verdict": "FAIL" if reasons else "PASS", "reasons": reasons, **_rounded(summary)}


# What happened ---------------------------------------------------------------------------------------------------


def _alarms(record: Record, fires: Mapping[str, Table]) -> list[dict[str, Any]]:
    """Return each alarm, with the fire that it was for: the latest that had begun, if no other alarm was for it."""
    alarms: list[dict[str, Any]] = []
    cleared = {event.fields["number"]: event.t_s for event in record.told("alarm_cleared")}
    for event in record.told("alarm_raised"):
        burning = [name for name, it in fires.items() if it["starts_s"] - SEEN_BEFORE_S <= event.t_s <= it["ends_s"]]
        fire = next((name for name in burning if name not in [alarm["fire"] for alarm in alarms]), None)
        alarms.append(
            {
                "number": event.fields["number"],
                "agent": event.agent,
                "fire": fire,
                "raised_s": event.t_s,
                "after_s": event.t_s - fires[fire]["starts_s"] if fire is not None else None,
                "cleared_s": cleared.get(event.fields["number"]),
                "moving": list(event.fields["moving"]),
                "hot": list(event.fields["hot"]),
            }
        )
    return alarms


def _missed(alarms: Sequence[Table], fires: Mapping[str, Table], until_s: float) -> list[str]:
    alarmed = [alarm["fire"] for alarm in alarms]
    return [name for name, fire in fires.items() if fire["starts_s"] <= until_s and name not in alarmed]


def _fell(rows: Sequence[Row], below: float | None) -> float | None:
    """Return when a battery first was below a level; None: never."""
    if below is None:
        return None
    return next((row.t_s for row in rows if row.level is not None and row.level < below), None)


def _state(state: Table) -> dict[str, Any]:
    nodes = state.get("nodes", {})
    return {
        "alarms": state.get("alarms"),
        "open": state.get("open"),
        "reports": {name: node.get("received") for name, node in sorted(nodes.items())},
    }


def _energy(record: Record, configs: Mapping[str, Table], field: Table) -> dict[str, dict[str, float]]:
    """Return the energy that each sleeping node used, and what it would have used always on.

    Always on means: its radio always listens, all its sensors are asked at their busy rates, and it sends no more than
    it did.
    """
    energy = {}
    for agent, config in configs.items():
        duty = next((task for task in config["tasks"].values() if task["type"] == "sensor_field.DutyCycle"), None)
        rows = [row for row in record.nodes.get(agent, ()) if row.spent_j is not None]
        if duty is None or not duty["settings"].get("sleep_s") or len(rows) < 2:
            continue
        battery, last = field["nodes"][agent]["battery"], rows[-1]
        busy_hz = {target.rpartition("/")[2]: rates["busy_hz"] for target, rates in duty["settings"]["rates"].items()}
        sensing_w = sum(battery["sample_j"].get(device, 0.0) * hz for device, hz in busy_hz.items())
        always_j = (battery["idle_w"] + battery["listen_w"] + sensing_w) * last.t_s + (last.sending_j or 0.0)
        spent_j = last.spent_j or 0.0
        energy[agent] = {
            "spent_j": spent_j,
            "always_on_j": always_j,
            "saved_share": 1.0 - spent_j / always_j,
            "listened_share": sum(1 for row in rows if row.listening) / len(rows),
        }
    return energy


# What is wrong with it -------------------------------------------------------------------------------------------


def _alarm_reasons(summary: Table, limits: Limits) -> list[str]:
    reasons = [f"no alarm told of the fire {name}" for name in summary["missed_fires"]]
    if not summary["alarms"]:
        reasons.append("there never was an alarm")
    for alarm in summary["alarms"]:
        if alarm["fire"] is None:
            reasons.append(f"alarm {alarm['number']} was false")
        elif alarm["after_s"] > limits.raised_within_s:
            reasons.append(
                f"alarm {alarm['number']} came {alarm['after_s']:.1f} s after the fire {alarm['fire']} broke out,"
                f" later than {limits.raised_within_s:g} s"
            )
    return reasons


def _move_reasons(summary: Table, name: str, held: Sequence[Holder], limits: Limits) -> list[str]:
    reasons = []
    if not held:
        return [f"no agent ever ran {name}"]
    if summary["battery_fell_s"] is None:
        reasons.append(f"the battery of {held[0].agent} never fell so far that {name} had to move")
    elif len(held) == 1:
        reasons.append(f"{name} never moved: {held[0].agent} held it to the end")
    if len(held) > 2:
        reasons.append(f"{name} had {len(held)} holders, not two")
    if summary["gap_s"] is not None and summary["gap_s"] > limits.gap_s:
        reasons.append(f"no agent ran {name} for {summary['gap_s']:.2f} s, more than {limits.gap_s:g} s")
    if summary["overlap_s"] > limits.overlap_s:
        reasons.append(f"two agents ran {name} at once, for {summary['overlap_s']:.2f} s")
    if len(held) > 1 and summary["state_moved"] is None:
        reasons.append(f"{held[1].agent} did not say what it began with")
    numbers = [alarm["number"] for alarm in summary["alarms"]]
    if numbers != list(range(1, len(numbers) + 1)):
        reasons.append(f"alarms were numbered {numbers}: what {name} had counted did not move with it")
    return reasons


def _report_reasons(summary: Table, nodes: Sequence[str], gateway: str, ended_s: float) -> list[str]:
    told_s, reports = summary["reports_told_s"], summary["reports"]
    if told_s is None:
        return ["no agent gave account of the reports"]
    reasons = []
    if ended_s - told_s > 25.0:
        reasons.append(f"no agent gave account of the reports after {told_s:.0f} s")
    reasons += [f"no report of {node} ever came" for node in nodes if node != gateway and node not in reports]
    for node, (received, highest) in reports.items():
        if received < highest:
            reasons.append(f"{highest - received} of {highest} reports of {node} were lost")
        elif received > highest:
            reasons.append(f"{received - highest} reports of {node} came twice")
    return reasons


def _energy_reasons(summary: Table, hosts: Sequence[str], limits: Limits) -> list[str]:
    if not summary["energy"]:
        return ["nothing is known of the energy of the nodes"]
    return [
        f"{node} saved {energy['saved_share']:.0%} of its energy, less than {limits.saved_share:.0%}"
        for node, energy in summary["energy"].items()
        if energy["saved_share"] < limits.saved_share and node not in hosts
    ]


def _said(summary: Table, name: str) -> list[str]:
    """Return the results as lines for a terminal."""
    said = []
    for alarm in summary["alarms"]:
        if alarm["fire"] is not None:
            when = f"{abs(alarm['after_s']):.1f} s {'after' if alarm['after_s'] >= 0 else 'before'}"
            said.append(f"alarm {alarm['number']}, {when} the fire {alarm['fire']} broke out, from {alarm['agent']}")
    said += [
        f"{name} at {holder['agent']} from {holder['start_s']:.1f} to {holder['end_s']:.1f} s"
        for holder in summary["holders"]
    ]
    for node, energy in summary["energy"].items():
        said.append(
            f"{node} used {energy['spent_j']:.1f} J, always on {energy['always_on_j']:.1f} J:"
            f" {energy['saved_share']:.0%} saved; its radio listened {energy['listened_share']:.0%} of the time"
        )
    return said


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 6)
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return value
