"""The verdict on the mission without an end: are its tasks served, and is all well with its robots.

What counts is the truth of the world: where robots were, whose commands their wheels followed, what was in their
batteries. A task is **served** at a moment if one robot's wheels follow it, the robot is where the task is to be done,
and it does not stand there. A robot that only turns about there gets nowhere, so the rounds count as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

from pancakes import PancakesError
from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import Holder, holders
from pancakes.worlds import robot_model
from pancakes_encirclement.record import Record, Row, read_record
from pancakes_encirclement.scenario import find_world
from pancakes_encirclement.verdict import finish
from pancakes_robotarium.verdict import VERDICT, read_verdict

CIRCLE: Final = "robotarium.Circle"
PATROL: Final = "robotarium.Patrol"
REACH_M: Final = 0.25
"""A robot so far from its circle or its route is still at its work: it gives way, or goes round one that has died."""
STILL_M: Final = 0.1
STILL_S: Final = 10.0
"""A robot that has not left a circle of `STILL_M` for so long stands, and serves nothing."""
START_S: Final = 30.0
"""Service counts from here: at first all robots stand at home."""
CLOCKS_AGREE_S: Final = 0.05
"""Two agents that ran a task at once for less may only have told so: their clocks are not the same."""
RECORD_S: Final = 10.0
"""A record must not be silent for so long: a mission that nobody saw is no good one."""
WAYPOINT_M: Final = 0.25
"""A robot so near to a waypoint has been there: it may have left it out for one that stands dead on it."""
GAPS_TOLD: Final = 5
"""So many times without service are named for each task, the longest first."""


@dataclass(frozen=True, slots=True)
class EndlessLimits:
    """The limits of a mission.

    Attributes:
        served: the share of the time in which a task must be served, on average over the tasks.
        rounds: of the rounds that its speed makes in the time in which it was served, the share that each task must
            have made. Those who give way to others make fewer.
    """

    served: float = 0.995
    rounds: float = 0.5


@dataclass(frozen=True, slots=True)
class Duty:
    """A task that should be served.

    Attributes:
        name: its name.
        centre_m: the centre of its circle; None: it is a patrol.
        radius_m: the radius of that circle.
        route_m: the waypoints of the patrol.
        speed_mps: how fast it is driven.
    """

    name: str
    centre_m: tuple[float, float] | None = None
    radius_m: float = 0.0
    route_m: Sequence[tuple[float, float]] = ()
    speed_mps: float = 0.1

    @property
    def legs(self) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        """The ways of the patrol from each waypoint to the next."""
        return [*pairwise(self.route_m), (self.route_m[-1], self.route_m[0])]

    @property
    def round_m(self) -> float:
        """How long a round is."""
        if self.centre_m is not None:
            return math.tau * self.radius_m
        return sum(math.dist(*leg) for leg in self.legs)

    def off_m(self, place: tuple[float, float]) -> float:
        """Return how far a place is from the circle or the route."""
        if self.centre_m is not None:
            return abs(math.dist(place, self.centre_m) - self.radius_m)
        return min(_from_leg_m(place, *leg) for leg in self.legs)


def _from_leg_m(place: tuple[float, float], one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return how far a place is from the line between two others."""
    along = (other[0] - one[0], other[1] - one[1])
    length = along[0] ** 2 + along[1] ** 2
    done = ((place[0] - one[0]) * along[0] + (place[1] - one[1]) * along[1]) / length if length else 0.0
    share = min(max(done, 0.0), 1.0)
    return math.dist(place, (one[0] + share * along[0], one[1] + share * along[1]))


@dataclass(slots=True)
class Service:
    """How a task was served.

    Attributes:
        moments: how many moments were recorded.
        driven: in how many of them the wheels of a robot followed the task.
        served: in how many of them it was served.
        doubled: in how many moments, also before service counts, the wheels of two robots followed it.
        gaps: when it was not served, from and until, in mission seconds.
        rounds: how often robots went round its circle clockwise, or its route.
    """

    moments: int = 0
    driven: int = 0
    served: int = 0
    doubled: int = 0
    gaps: list[tuple[float, float]] = field(default_factory=list)
    rounds: float = 0.0

    @property
    def share(self) -> float:
        """The share of the time in which it was served."""
        return self.served / self.moments if self.moments else 0.0


def read_duties(configs: Mapping[str, Mapping[str, Any]]) -> list[Duty]:
    """Return the tasks that are to be served, from the configurations of all agents.

    Raises:
        PancakesError: there is none.
    """
    found = []
    for config in configs.values():
        for name, task in config.get("tasks", {}).items():
            settings = task.get("settings", {})
            speed_mps = settings.get("speed_mps", 0.1)
            if task.get("type") == CIRCLE:
                centre = settings.get("centre_m")
                if centre is None:
                    raise PancakesError(f"{name} has no centre_m: nobody could judge whether its circle is served")
                found.append(Duty(name, (centre[0], centre[1]), settings.get("radius_m", 0.27), (), speed_mps))
            elif task.get("type") == PATROL:
                route_m = [(x_m, y_m) for x_m, y_m in settings["waypoints_m"]]
                found.append(Duty(name, route_m=route_m, speed_mps=speed_mps))
    if not found:
        raise PancakesError(f"none of the agents {', '.join(configs)} has a task of the types {CIRCLE} and {PATROL}")
    return sorted(found, key=lambda duty: duty.name)


def judge_endless(run: Run, limits: EndlessLimits = EndlessLimits()) -> dict[str, Any]:
    """Judge a mission in which tasks are to be served without an end.

    Args:
        run: the mission; it left `trajectory.csv`, `events.jsonl` and `robotarium.json`.
        limits: its limits.

    Returns:
        The contents of `summary.json`.

    Raises:
        PancakesError: the files or the configurations cannot be read.
    """
    record, duties, world = read_record(run.out), read_duties(run.configs), find_world(run.configs)
    models = {name: robot_model(robot.model) for name, robot in world.robots.items()}
    volts = {name: (model.empty_v, model.full_v) for name, model in models.items()}
    theirs, reasons = read_verdict(run.out / VERDICT)
    summary = judge(record, duties, volts, run)
    summary["robotarium"] = theirs
    return finish(summary, [*reasons_to_fail(summary, run, limits), *reasons])


def judge(record: Record, duties: Sequence[Duty], volts: Mapping[str, tuple[float, float]], run: Run) -> dict[str, Any]:
    """Return the figures of a mission.

    Args:
        record: what happened.
        duties: the tasks that are to be served.
        volts: the voltage of each robot's battery when it is empty, and when it is full.
        run: the mission.
    """
    robots = [it for it in volts if it in record.paths]
    services = served(record.paths, robots, duties)
    step_s = _step_s(record.paths)
    held = {duty.name: holders(record, duty.name, run.ended_s) for duty in duties}
    levels = {name: lowest_level(record.paths.get(name, ()), *volts[name]) for name in volts}
    known = [level for level in levels.values() if level is not None]
    collided = [" with ".join(event.fields.get("names", ("?",))) for event in record.told("collision")]
    speeds = {duty.name: duty.speed_mps / duty.round_m for duty in duties}
    hours = max(run.ended_s, 1.0) / 3600.0
    return {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "ended_s": run.ended_s,
        "unrecorded_s": _unrecorded_s([record.paths[robot] for robot in robots], run.ended_s),
        "served": sum(it.share for it in services.values()) / len(services),
        "tasks": {
            name: {
                "served": it.share,
                "driven": it.driven / it.moments if it.moments else 0.0,
                "rounds": it.rounds,
                "due_rounds": it.served * step_s * speeds[name],
                "owners": len(held[name]),
                "longest_gap_s": max((end_s - start_s for start_s, end_s in it.gaps), default=0.0),
            }
            for name, it in services.items()
        },
        "gaps": {name: sorted(it.gaps, key=lambda gap: gap[0] - gap[1])[:GAPS_TOLD] for name, it in services.items()},
        "two_owners_s": {name: two_owners_s(held[name], it.doubled * step_s) for name, it in services.items()},
        "lowest_level": min(known, default=None),
        "lowest_levels": levels,
        "empty": [name for name, level in levels.items() if level is not None and level <= 0.0],
        "unknown": [name for name, level in levels.items() if level is None],
        "moves_per_hour": sum(max(len(it) - 1, 0) for it in held.values()) / hours,
        "charges": sum(1 for _ in record.told("docked")),
        "deaths": [
            {"agent": event.agent, "at_s": event.t_s, "had": _had(held, event.agent, event.t_s)}
            for event in record.told("agent_lost")
        ],
        "missing": _missing(record),
        "collisions": len(collided),
        "collided": collided,
        "out_of_bounds": sum(1 for _ in record.told("out_of_bounds")),
    }


def _missing(record: Record) -> list[str]:
    """Return the agents that were killed, and have not told since that they are ready again."""
    gone: dict[str, bool] = {}
    for event in record.events:
        if event.kind == "agent_lost":
            gone[event.agent] = True
        elif event.kind == "ready":
            gone[event.agent] = False
    return [agent for agent, is_gone in gone.items() if is_gone]


def _step_s(paths: Mapping[str, Sequence[Row]]) -> float:
    """Return the time from one row of a body to its next."""
    path: Sequence[Row] = max(paths.values(), key=len, default=())
    return (path[-1].t_s - path[0].t_s) / (len(path) - 1) if len(path) > 1 else 0.0


def _unrecorded_s(paths: Sequence[Sequence[Row]], end_s: float) -> float:
    """Return the longest time in a mission for which nothing was recorded of some robot."""
    moments = ([0.0, *(row.t_s for row in path), end_s] for path in paths)
    return max((later_s - earlier_s for it in moments for earlier_s, later_s in pairwise(it)), default=end_s)


def _had(held: Mapping[str, Sequence[Holder]], agent: str, at_s: float) -> list[str]:
    """Return the tasks that an agent had right before it was killed."""
    return [
        name
        for name, stays in held.items()
        if any(it.agent == agent and it.start_s <= at_s <= it.end_s + CLOCKS_AGREE_S for it in stays)
    ]


def served(paths: Mapping[str, Sequence[Row]], robots: Sequence[str], duties: Sequence[Duty]) -> dict[str, Service]:
    """Return how each task was served, by what the world recorded."""
    found = {duty.name: Service() for duty in duties}
    since: dict[str, float | None] = dict.fromkeys(found)
    still = {robot: _standing(paths[robot]) for robot in robots}
    rounds = {duty.name: _Rounds(duty) for duty in duties}
    last_s = 0.0
    for row_of in zip(*(paths[robot] for robot in robots), strict=False):
        time_s = last_s = row_of[0].t_s
        stands = {robot: next(still[robot]) for robot in robots}
        for duty in duties:
            service = found[duty.name]
            drives = [(robot, row) for robot, row in zip(robots, row_of, strict=True) if row.driven_by == duty.name]
            service.doubled += len(drives) > 1
            service.rounds = (
                rounds[duty.name].passed(drives[0][0], (drives[0][1].x_m, drives[0][1].y_m))
                if drives
                else service.rounds
            )
            if time_s < START_S:
                continue
            service.moments += 1
            service.driven += bool(drives)
            good = any(not stands[robot] and duty.off_m((row.x_m, row.y_m)) <= REACH_M for robot, row in drives)
            service.served += good
            began_s = since[duty.name]
            if good and began_s is not None:
                service.gaps.append((began_s, time_s))
                since[duty.name] = None
            elif not good and began_s is None:
                since[duty.name] = time_s
    for name, began_s in since.items():
        if began_s is not None:
            found[name].gaps.append((began_s, last_s))
    return found


class _Rounds:
    """Count how often robots go round a circle clockwise, or from waypoint to waypoint of a route.

    Args:
        duty: the task for which they do.
    """

    def __init__(self, duty: Duty) -> None:
        self._duty = duty
        self._rounds = 0.0
        self._robot = ""
        self._bearing_rad = 0.0
        self._been_at: int | None = None

    def passed(self, robot: str, place: tuple[float, float]) -> float:
        """Take where the robot is that drives for the task; return the rounds so far."""
        centre = self._duty.centre_m
        if centre is None:
            near = [number for number, it in enumerate(self._duty.route_m) if math.dist(place, it) <= WAYPOINT_M]
            if near and self._been_at not in near:
                self._rounds += (self._been_at is not None) / len(self._duty.route_m)
                self._been_at = near[0]
            return self._rounds
        bearing_rad = math.atan2(place[1] - centre[1], place[0] - centre[0])
        if robot == self._robot:
            self._rounds -= math.remainder(bearing_rad - self._bearing_rad, math.tau) / math.tau
        self._robot, self._bearing_rad = robot, bearing_rad
        return self._rounds


def _standing(path: Sequence[Row]) -> Iterator[bool]:
    """Yield for each row whether the robot has not left its place for `STILL_S`."""
    anchor = path[0] if path else None
    for row in path:
        assert anchor is not None
        if math.dist((row.x_m, row.y_m), (anchor.x_m, anchor.y_m)) > STILL_M:
            anchor = row
        yield row.t_s - anchor.t_s >= STILL_S


def two_owners_s(held: Sequence[Holder], driven_s: float) -> float:
    """Return for how long two robots had a task at once: by their events or by their wheels, the longer time.

    Args:
        held: who had it by the events.
        driven_s: for how long the wheels of two robots followed it.
    """
    told_s = 0.0
    ordered = sorted(held, key=lambda it: it.start_s)
    for place, earlier in enumerate(ordered):
        for later in ordered[place + 1 :]:
            both_s = min(earlier.end_s, later.end_s) - later.start_s
            if later.agent != earlier.agent and both_s > CLOCKS_AGREE_S:
                told_s += both_s
    return max(told_s, driven_s)


def lowest_level(path: Sequence[Row], empty_v: float, full_v: float) -> float | None:
    """Return the lowest level that a battery had, from 0 to 1; None: nothing is known of it."""
    lowest_v = min((row.battery_v for row in path if row.battery_v is not None), default=None)
    return None if lowest_v is None else (lowest_v - empty_v) / (full_v - empty_v)


def reasons_to_fail(summary: Mapping[str, Any], run: Run, limits: EndlessLimits) -> list[str]:
    """Return why a mission fails, as sentences."""
    reasons = [f"the mission broke off: {run.ended_because}"] if run.ended_because else []
    if summary["unrecorded_s"] > RECORD_S:
        reasons.append(
            f"nothing was recorded of a robot for {summary['unrecorded_s']:.0f} s: nobody can judge that time"
        )
    if summary["empty"]:
        reasons.append(f"the battery of {', '.join(summary['empty'])} was empty")
    if summary["unknown"]:
        reasons.append(f"nothing is known of the battery of {', '.join(summary['unknown'])}")
    if summary["served"] < limits.served:
        shares = ", ".join(f"{name} {it['served']:.2%}" for name, it in summary["tasks"].items())
        reasons.append(
            f"the tasks were served for {summary['served']:.2%} of the time, less than {limits.served:.1%}: {shares}"
        )
    reasons += [
        f"two robots had {name} at once, for {both_s:.2f} s"
        for name, both_s in summary["two_owners_s"].items()
        if both_s
    ]
    reasons += [f"no robot ever had {name}" for name, it in summary["tasks"].items() if not it["owners"]]
    reasons += [
        f"{name} was driven for {it['rounds']:.1f} rounds, and at its speed {it['due_rounds']:.1f} were due"
        for name, it in summary["tasks"].items()
        if it["rounds"] + 1.0 < limits.rounds * it["due_rounds"]
    ]
    if summary["collisions"]:
        reasons.append(f"there were {summary['collisions']} collisions: {', '.join(summary['collided'][:10])}")
    if summary["out_of_bounds"]:
        reasons.append(f"robots left the floor {summary['out_of_bounds']} times")
    if summary["missing"]:
        reasons.append(f"{', '.join(summary['missing'])} died and did not come back")
    return reasons
