"""The verdict on the experiment of the paper (§4, Figures 4 to 6), in the manner of Robotarium."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import Holder, holders
from pancakes_encirclement.holding import gap_s, overlap_s, radius_error
from pancakes_encirclement.laps import ON_CIRCLE_SHARE
from pancakes_encirclement.record import Record, Row, read_record
from pancakes_encirclement.scenario import Scenario, read_scenario

SETTLING_S = 30.0
"""The radius counts from this long after a robot first came to the circle."""


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a mission.

    Attributes:
        radius_error_m: mean distance from the circle.
        gap_s: time between the last motor command of the old holder and the first of the new.
        home_error_m: distance from home at the end.
        centre_error_m: distance of the migrated centre from the sensor node.
    """

    radius_error_m: float = 0.02
    gap_s: float = 0.5
    home_error_m: float = 0.10
    centre_error_m: float = 0.15


def judge_encirclement(run: Run, limits: Limits = Limits()) -> dict[str, Any]:
    """Judge the mission in which `ScanTarget` migrates from the first robot to the second.

    Args:
        run: the mission; it left `trajectory.csv` and `events.jsonl`.
        limits: its limits.

    Returns:
        The contents of `summary.json`.

    Raises:
        PancakesError: the files or the configurations cannot be read.
    """
    return judge(read_record(run.out), read_scenario(run.configs), run, limits)


def judge(record: Record, scenario: Scenario, run: Run, limits: Limits) -> dict[str, Any]:
    """Judge the files that were read; see `judge_encirclement`."""
    held = holders(record, scenario.scan, run.ended_s)
    old, new = (held[0].agent, held[1].agent) if len(held) > 1 else (scenario.first, "")
    centre = place(record, scenario.sensor)
    homes = {robot: position for robot in scenario.robots if (position := place(record, robot)) is not None}
    errors = {
        holder.agent: radius_error(
            _while_held(record, holder), centre or (0.0, 0.0), scenario.radius_m, ON_CIRCLE_SHARE, SETTLING_S
        )
        for holder in held
    }
    asked = [line for event in record.told("migration", task=scenario.scan) for line in event.fields.get("lines", ())]
    arrived = next(record.told("task_arrived", agent=new, task=scenario.scan), None)
    summary: dict[str, Any] = {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "circle": {**named(centre), "radius_m": scenario.radius_m},
        "homes": {robot: named(home) for robot, home in homes.items()},
        "holders": [asdict(holder) for holder in held],
        "gap_s": gap_s(record.paths, scenario.scan, old, new) if new else None,
        "overlap_s": overlap_s(record.paths, scenario.robots, scenario.scan, held),
        "bids": [{"agent": line["peer"], "cost": line["cost"]} for line in asked if line.get("cost") is not None],
        "refusals": [
            {"agent": line["peer"], "reason": line.get("reason", "")} for line in asked if line["answer"] == "refused"
        ],
        "state_moved": dict(arrived.fields.get("state", {})) if arrived is not None else None,
        "radius_error_m": {agent: asdict(error) if error else None for agent, error in errors.items()},
        "home_error_m": _home_error(record, old, homes),
        "revolutions": revolutions(record),
        "saving_power_s": first_time(record, "saving_power"),
        "parked_s": first_time(record, "parked"),
        **mishaps(record, scenario),
    }
    reasons = common_reasons(summary, run)
    reasons += _reasons_to_fail(summary, scenario, limits, old, new)
    return finish(summary, reasons)


def common_reasons(summary: Mapping[str, Any], run: Run) -> list[str]:
    """Return the reasons that fail a mission of any kind: it broke off, or there were collisions."""
    reasons = [f"the mission broke off: {run.ended_because}"] if run.ended_because else []
    if summary["collisions"]:
        reasons.append(f"there were {summary['collisions']} collisions: {', '.join(summary['collided'])}")
    if summary["out_of_bounds"]:
        reasons.append(f"{summary['out_of_bounds']} robots left the arena")
    return reasons


def _reasons_to_fail(summary: Mapping[str, Any], scenario: Scenario, limits: Limits, old: str, new: str) -> list[str]:
    reasons = []
    scan = scenario.scan
    if not summary["holders"]:
        reasons.append(f"no agent ever ran {scan}")
    elif not new:
        reasons.append(f"{scan} never moved: {old} held it to the end")
    elif len(summary["holders"]) > 2:
        reasons.append(f"{scan} had {len(summary['holders'])} holders, not two")
    reasons += _radius_reasons(summary, limits)
    gap = summary["gap_s"]
    if new and gap is None:
        reasons.append(f"the wheels of {old} and {new} did not both follow {scan}")
    elif gap is not None and gap > limits.gap_s:
        reasons.append(f"no robot drove for {gap:.2f} s at the hand-over, more than {limits.gap_s:g} s")
    if summary["overlap_s"] > 0.0:
        reasons.append(f"two agents ran {scan} at once, for {summary['overlap_s']:.2f} s")
    home_error = summary["home_error_m"]
    if home_error is None:
        reasons.append(f"nothing is known of where {old} was")
    elif home_error > limits.home_error_m:
        reasons.append(f"{old} ended {home_error:.2f} m from its home, more than {limits.home_error_m:g} m")
    if not any(refusal["agent"] == scenario.sensor and refusal["reason"] for refusal in summary["refusals"]):
        reasons.append(f"{scenario.sensor} did not refuse {scan} with a reason")
    return reasons + _state_reasons(summary, scenario, limits, old, new)


def _radius_reasons(summary: Mapping[str, Any], limits: Limits) -> list[str]:
    reasons = []
    for agent, error in summary["radius_error_m"].items():
        if error is None:
            reasons.append(f"{agent} did not settle on the circle")
        elif error["mean"] > limits.radius_error_m:
            reasons.append(
                f"{agent} was {error['mean']:.3f} m off the circle on average, more than {limits.radius_error_m:g} m"
            )
    return reasons


def _state_reasons(summary: Mapping[str, Any], scenario: Scenario, limits: Limits, old: str, new: str) -> list[str]:
    if not new:
        return []
    state, circle = summary["state_moved"], summary["circle"]
    if state is None:
        return [f"{new} did not say what it began with"]
    reasons = []
    centre = state.get("centre_m")
    if centre is None:
        reasons.append(f"{new} began without the centre that {old} had learnt")
    elif circle["x_m"] is None or math.dist(centre, (circle["x_m"], circle["y_m"])) > limits.centre_error_m:
        reasons.append(f"{new} began with a centre that is not where {scenario.sensor} stands")
    counted = summary["revolutions"].get(old, 0)
    if math.floor(state.get("revolutions", 0.0)) < counted:
        reasons.append(f"{new} began with {state.get('revolutions', 0.0):.1f} revolutions, {old} had counted {counted}")
    return reasons


def finish(summary: dict[str, Any], reasons: list[str]) -> dict[str, Any]:
    """Return the summary with its verdict first, and with rounded numbers."""
    return {"verdict": "FAIL" if reasons else "PASS", "reasons": reasons, **_rounded(summary)}


def place(record: Record, name: str) -> tuple[float, float] | None:
    """Return where a body was at first; None if that is not known."""
    path = record.paths.get(name)
    return (path[0].x_m, path[0].y_m) if path else None


def mishaps(record: Record, scenario: Scenario) -> dict[str, Any]:
    """Return `collisions` and `out_of_bounds` (how many), and which bodies `collided`."""
    collided = [" with ".join(event.fields.get("names", ("?",))) for event in record.told("collision")]
    outside = [
        robot
        for robot in scenario.robots
        if any(
            abs(row.x_m) > scenario.half_width_m or abs(row.y_m) > scenario.half_height_m
            for row in record.paths.get(robot, ())
        )
    ]
    return {"collisions": len(collided), "collided": collided, "out_of_bounds": len(outside)}


def revolutions(record: Record) -> dict[str, int]:
    """Return the last count of revolutions that each agent reported."""
    return {event.agent: int(event.fields["count"]) for event in record.told("revolution")}


def first_time(record: Record, kind: str) -> float | None:
    """Return when an event of this kind was first reported; None: never."""
    return next((event.t_s for event in record.told(kind)), None)


def _while_held(record: Record, holder: Holder) -> list[Row]:
    return [row for row in record.paths.get(holder.agent, ()) if holder.start_s <= row.t_s <= holder.end_s]


def _home_error(record: Record, agent: str, homes: Mapping[str, tuple[float, float]]) -> float | None:
    path = record.paths.get(agent)
    return math.dist((path[-1].x_m, path[-1].y_m), homes[agent]) if path else None


def named(position: tuple[float, float] | None) -> dict[str, float | None]:
    """Return a place in the form of a summary."""
    return {"x_m": position[0] if position else None, "y_m": position[1] if position else None}


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 6)
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return value
