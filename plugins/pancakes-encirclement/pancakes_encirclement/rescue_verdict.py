"""The verdict on the mission in which the circling robot is killed: a guarded task outlives its agent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import Holder, holders
from pancakes_encirclement.holding import driven, overlap_s
from pancakes_encirclement.record import Record, Row, read_record
from pancakes_encirclement.scenario import Scenario, read_scenario
from pancakes_encirclement.verdict import common_reasons, finish, first_time, mishaps, named, place, revolutions

SECTORS = 36
"""The circle is divided into this many parts."""


@dataclass(frozen=True, slots=True)
class RescueLimits:
    """The limits of a mission.

    Attributes:
        after_lease_s: time from the loss to the first command of the copy, beyond the lease, in host seconds.
        centre_error_m: distance of the copy's centre from the sensor node.
        late_s: how much older than `checkpoint_s` the copy's checkpoint may be, in host seconds.
        ring_share: a part of the circle is covered if a robot passes it within this share of the radius; it steers
            round the robot that stands there.
        covered: the share of the circle that is covered in the end.
    """

    after_lease_s: float = 1.5
    centre_error_m: float = 0.15
    late_s: float = 0.5
    ring_share: float = 0.5
    covered: float = 1.0


@dataclass(frozen=True, slots=True)
class GuardedScan:
    """How the task that goes round is guarded, in mission seconds.

    Attributes:
        lease_s: how long a lease is.
        checkpoint_s: how often the task is written to disk.
        speed: mission seconds for each host second, in which leases are counted.
    """

    lease_s: float
    checkpoint_s: float
    speed: float


def judge_rescue(run: Run, limits: RescueLimits = RescueLimits()) -> dict[str, Any]:
    """Judge the mission in which the agent with `ScanTarget` is killed and comes back.

    Args:
        run: the mission; it left `trajectory.csv` and `events.jsonl`.
        limits: its limits.

    Returns:
        The contents of `summary.json`.

    Raises:
        PancakesError: the files or the configurations cannot be read.
    """
    scenario = read_scenario(run.configs)
    return judge(read_record(run.out), scenario, read_guard(run.configs, scenario), run, limits)


def read_guard(configs: Mapping[str, Mapping[str, Any]], scenario: Scenario) -> GuardedScan:
    """Read from the configurations how the circling task is guarded."""
    first = configs[scenario.first]
    rule, speed = first["tasks"][scenario.scan]["guard"], float(first.get("clock", {}).get("speed", 1.0))
    return GuardedScan(float(rule["lease_s"]) * speed, float(rule["checkpoint_s"]) * speed, speed)


def judge(record: Record, scenario: Scenario, guard: GuardedScan, run: Run, limits: RescueLimits) -> dict[str, Any]:
    """Judge the files that were read; see `judge_rescue`."""
    scan, old = scenario.scan, scenario.first
    held = holders(record, scan, run.ended_s)
    lost_s, returned_s = first_time(record, "agent_lost"), first_time(record, "agent_returned")
    new = next((holder.agent for holder in held if holder.agent != old), "")
    centre = place(record, scenario.sensor)
    commands = [row.t_s for row in driven(record.paths.get(new, ()), scan)]
    arrived = next(record.told("task_arrived", agent=new, task=scan), None)
    summary: dict[str, Any] = {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "circle": {**named(centre), "radius_m": scenario.radius_m},
        "lease_s": guard.lease_s,
        "lost": old,
        "lost_s": lost_s,
        "rolled_on_s": _rolled_on_s(record, scan, old, lost_s),
        "taken_by": new,
        "without_s": commands[0] - lost_s if commands and lost_s is not None else None,
        "without_most_s": guard.lease_s + limits.after_lease_s * guard.speed,
        "state_taken": dict(arrived.fields.get("state", {})) if arrived is not None else None,
        "returned_s": returned_s,
        "holders": [asdict(holder) for holder in held],
        "overlap_s": overlap_s(record.paths, scenario.robots, scan, held),
        "ran_after_return": _ran_after(held, returned_s),
        "runs_at_the_end": [holder.agent for holder in held if holder.end_s >= run.ended_s],
        "drove_after_return": _drove_after(record, scenario, returned_s),
        "revolutions": revolutions(record),
        "covered": _covered(driven(record.paths.get(new, ()), scan), returned_s, centre, scenario, limits),
        **mishaps(record, scenario),
    }
    reasons = common_reasons(summary, run)
    reasons += _loss_reasons(summary, scenario, run)
    if lost_s is not None:
        reasons += _taking_reasons(summary, scenario)
        reasons += _state_reasons(record, summary, guard, limits)
        reasons += _return_reasons(summary, scenario, limits)
    return finish(summary, reasons)


def _rolled_on_s(record: Record, scan: str, old: str, lost_s: float | None) -> float | None:
    """Return how long the wheels of the lost robot still followed its last command."""
    rows = driven(record.paths.get(old, ()), scan)
    return max(0.0, rows[-1].t_s - lost_s) if rows and lost_s is not None else None


def _ran_after(held: Sequence[Holder], returned_s: float | None) -> list[str]:
    """Return the agents that ran the task at any time after the return of the first one."""
    if returned_s is None:
        return []
    return sorted({holder.agent for holder in held if holder.end_s > returned_s})


def _drove_after(record: Record, scenario: Scenario, returned_s: float | None) -> list[str]:
    """Return the robots whose wheels followed the task after the return of the first agent."""
    if returned_s is None:
        return []
    scan = scenario.scan
    return [
        robot
        for robot in scenario.robots
        if any(row.t_s > returned_s for row in driven(record.paths.get(robot, ()), scan))
    ]


def _covered(
    rows: Sequence[Row],
    returned_s: float | None,
    centre: tuple[float, float] | None,
    scenario: Scenario,
    limits: RescueLimits,
) -> float:
    """Return the share of the circle along which the copy has driven since the first agent is back."""
    if centre is None or returned_s is None:
        return 0.0
    passed = set()
    for row in rows:
        off_m = math.dist((row.x_m, row.y_m), centre) - scenario.radius_m
        if row.t_s >= returned_s and abs(off_m) <= limits.ring_share * scenario.radius_m:
            turn = math.atan2(row.y_m - centre[1], row.x_m - centre[0]) / (2.0 * math.pi)
            passed.add(math.floor(turn % 1.0 * SECTORS) % SECTORS)
    return len(passed) / SECTORS


def _loss_reasons(summary: Mapping[str, Any], scenario: Scenario, run: Run) -> list[str]:
    old, lost_s = scenario.first, summary["lost_s"]
    if lost_s is None:
        return [f"the mission ended after {run.ended_s:.0f} s, before {old} was killed"]
    if not any(it["agent"] == old and it["start_s"] <= lost_s <= it["end_s"] for it in summary["holders"]):
        return [f"{old} did not run {scenario.scan} when it was killed"]
    return []


def _taking_reasons(summary: Mapping[str, Any], scenario: Scenario) -> list[str]:
    scan, old, new = scenario.scan, scenario.first, summary["taken_by"]
    reasons = []
    without_s, most_s = summary["without_s"], summary["without_most_s"]
    if not new:
        reasons.append(f"no agent went on with {scan} after {old} was killed")
    elif without_s is None:
        reasons.append(f"{new} ran {scan}, and its wheels never followed it")
    elif without_s > most_s:
        reasons.append(
            f"the first command of the copy came {without_s:.2f} s after {old} was killed, more than {most_s:g} s"
        )
    if summary["overlap_s"] > 0.0:
        reasons.append(f"two agents acted for {scan} at once, for {summary['overlap_s']:.2f} s")
    if len(summary["holders"]) > 2:
        reasons.append(f"{scan} had {len(summary['holders'])} holders, not two")
    return reasons


def _state_reasons(record: Record, summary: Mapping[str, Any], guard: GuardedScan, limits: RescueLimits) -> list[str]:
    """Check that the copy continued from a checkpoint that was not too old."""
    old, new, state, circle = summary["lost"], summary["taken_by"], summary["state_taken"], summary["circle"]
    if not new:
        return []
    if state is None:
        return [f"{new} did not say what it began with"]
    reasons = []
    centre = state.get("centre_m")
    if centre is None:
        reasons.append(f"{new} began without the centre that {old} had learnt")
    elif circle["x_m"] is None or math.dist(centre, (circle["x_m"], circle["y_m"])) > limits.centre_error_m:
        reasons.append(f"{new} began with a centre that is not where the sensor node stands")
    had = state.get("revolutions", 0.0)
    kept_s = summary["lost_s"] - guard.checkpoint_s - limits.late_s * guard.speed
    told = list(record.told("revolution", agent=old))
    counted = max((int(event.fields["count"]) for event in told if event.t_s <= kept_s), default=0)
    if math.floor(had) < counted:
        reasons.append(f"{new} began with {had:.1f} revolutions, {old} had counted {counted}")
    first = next((int(event.fields["count"]) for event in record.told("revolution", agent=new)), None)
    if first is not None and first != math.floor(had) + 1:
        reasons.append(f"{new} counted revolution {first} after it had begun with {had:.1f}")
    return reasons


def _return_reasons(summary: Mapping[str, Any], scenario: Scenario, limits: RescueLimits) -> list[str]:
    scan, old, new = scenario.scan, scenario.first, summary["taken_by"]
    if summary["returned_s"] is None:
        return [f"the mission ended before {old} came back"]
    reasons = []
    if not summary["ran_after_return"]:
        reasons.append(f"no agent ran {scan} after {old} came back")
    elif summary["ran_after_return"] != [new]:
        reasons.append(f"{' and '.join(summary['ran_after_return'])} ran {scan} after {old} came back")
    elif not summary["runs_at_the_end"]:
        reasons.append(f"{new} did not run {scan} to the end")
    if old in summary["drove_after_return"]:
        reasons.append(f"the wheels of {old} followed {scan} after it came back")
    if summary["covered"] < limits.covered:
        reasons.append(f"only {summary['covered']:.0%} of the circle was covered after {old} came back")
    return reasons
