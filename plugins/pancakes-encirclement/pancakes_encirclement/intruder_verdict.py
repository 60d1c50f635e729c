"""The verdict on the mission of the paper's Figure 1: motion starts a task, and the circle follows the intruder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import holders
from pancakes_encirclement.holding import driven
from pancakes_encirclement.record import Record, read_record
from pancakes_encirclement.scenario import Scenario, read_scenario
from pancakes_encirclement.verdict import SETTLING_S, common_reasons, finish, first_time, mishaps, place, revolutions


@dataclass(frozen=True, slots=True)
class IntruderLimits:
    """The limits of a mission.

    Attributes:
        start_s: time from the first report of motion to the start of the task.
        moves: how often the circle must follow, at least.
        error_m: mean distance from the circle around the intruder's true position.
        centre_m: mean distance of the circle's centre from that position.
        revolutions: how often the robot must go round, at least.
    """

    start_s: float = 1.0
    moves: int = 3
    error_m: float = 0.20
    centre_m: float = 0.20
    revolutions: int = 2


def judge_intruder(run: Run, limits: IntruderLimits = IntruderLimits()) -> dict[str, Any]:
    """Judge the mission in which motion starts `ScanTarget` on an idle robot, and the intruder walks on.

    Args:
        run: the mission; it left `trajectory.csv` and `events.jsonl`.
        limits: its limits.

    Returns:
        The contents of `summary.json`.

    Raises:
        PancakesError: the files or the configurations cannot be read.
    """
    return judge(read_record(run.out), read_scenario(run.configs), run, limits)


def judge(record: Record, scenario: Scenario, run: Run, limits: IntruderLimits) -> dict[str, Any]:
    """Judge the files that were read; see `judge_intruder`."""
    held = holders(record, scenario.scan, run.ended_s)
    detected_s = first_time(record, "motion_detected")
    robot = held[0].agent if held else scenario.first
    driven_rows = driven(record.paths.get(robot, ()), scenario.scan)
    centres = [(event.t_s, _point(event.fields)) for kind in ("alarm", "new_centre") for event in record.told(kind)]
    centres.sort(key=lambda centre: centre[0])
    from_s = held[0].start_s + SETTLING_S if held else math.inf
    sensor = place(record, scenario.sensor)
    summary: dict[str, Any] = {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "circle": {"radius_m": scenario.radius_m},
        "sensor": {"x_m": sensor[0], "y_m": sensor[1]} if sensor else None,
        "holders": [asdict(holder) for holder in held],
        "detected_s": detected_s,
        "start_delay_s": held[0].start_s - detected_s if held and detected_s is not None else None,
        "drove_before_start": any(row.driven_by and row.t_s < held[0].start_s for row in record.paths.get(robot, ()))
        if held
        else bool(driven_rows),
        "centre_moves": sum(1 for _ in record.told("new_centre")),
        **_following(record, scenario, robot, centres, from_s),
        "revolutions": revolutions(record),
        **mishaps(record, scenario),
    }
    return finish(summary, common_reasons(summary, run) + _reasons_to_fail(summary, scenario, limits, robot))


def _following(
    record: Record, scenario: Scenario, robot: str, centres: list[tuple[float, tuple[float, float]]], from_s: float
) -> dict[str, Any]:
    """Compare the robot, and its centre at each moment, with the intruder's true position."""
    walk = {row.t_s: (row.x_m, row.y_m) for mover in scenario.movers[:1] for row in record.paths.get(mover, ())}
    errors, offsets = [], []
    index = 0
    for row in record.paths.get(robot, ()):
        while index + 1 < len(centres) and centres[index + 1][0] <= row.t_s:
            index += 1
        intruder = walk.get(row.t_s)
        if row.t_s < from_s or intruder is None or not centres:
            continue
        errors.append(abs(math.dist((row.x_m, row.y_m), intruder) - scenario.radius_m))
        offsets.append(math.dist(centres[index][1], intruder))
    return {
        "radius_error_m": {"mean": sum(errors) / len(errors), "max": max(errors)} if errors else None,
        "centre_error_m": {"mean": sum(offsets) / len(offsets), "max": max(offsets)} if offsets else None,
    }


def _reasons_to_fail(summary: Mapping[str, Any], scenario: Scenario, limits: IntruderLimits, robot: str) -> list[str]:
    if summary["detected_s"] is None:
        return [f"{scenario.sensor} never sensed any motion"]
    if not summary["holders"]:
        return [f"motion was sensed, but no agent started {scenario.scan}"]
    reasons = []
    if summary["start_delay_s"] < 0.0 or summary["drove_before_start"]:
        reasons.append(f"{robot} drove before any motion was sensed")
    elif summary["start_delay_s"] > limits.start_s:
        reasons.append(
            f"{scenario.scan} started {summary['start_delay_s']:.2f} s after the first report, more than"
            f" {limits.start_s:g} s"
        )
    if summary["centre_moves"] < limits.moves:
        reasons.append(f"the circle moved {summary['centre_moves']} times, fewer than {limits.moves}")
    for key, limit, what in (
        ("radius_error_m", limits.error_m, f"{robot} was {{:.3f}} m off the circle round the intruder on average"),
        ("centre_error_m", limits.centre_m, "the circle's centre was {:.3f} m from the intruder on average"),
    ):
        if summary[key] is None:
            reasons.append(f"{robot} had no time to settle round the intruder")
        elif summary[key]["mean"] > limit:
            reasons.append(f"{what.format(summary[key]['mean'])}, more than {limit:g} m")
    counted = summary["revolutions"].get(robot, 0)
    if counted < limits.revolutions:
        reasons.append(f"{robot} went round {counted} times, fewer than {limits.revolutions}")
    return reasons


def _point(fields: Mapping[str, Any]) -> tuple[float, float]:
    return float(fields["x_m"]), float(fields["y_m"])
