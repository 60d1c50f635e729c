"""The verdict on the mission without an end: are its tasks served, and is all well with its robots.

What counts is the truth of the world: where robots were, whose commands their wheels followed, what was in their
batteries. A task is **served** at a moment if one robot's wheels follow it, the robot is where the task is to be done,
and it does not stand there.
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
GAPS_TOLD: Final = 5
"""So many times without service are named for each task, the longest first."""


@dataclass(frozen=True, slots=True)
class EndlessLimits:
    """The limits of a mission.

    Attributes:
        served: the share of the time in which a task must be served, on average over the tasks.
    """

    served: float = 0.995


@dataclass(frozen=True, slots=True)
class Duty:
    """A task that is to be served.

    Attributes:
        name: its name.
        centre_m: the centre of its circle; None: it is a patrol.
        radius_m: the radius of that circle.
        route_m: the waypoints of the patrol.
    """

    name: str
    centre_m: tuple[float, float] | None = None
    radius_m: float = 0.0
    route_m: Sequence[tuple[float, float]] = ()

    def off_m(self, place: tuple[float, float]) -> float:
        """Return how far a place is from the circle or the route."""
        if self.centre_m is not None:
            return abs(math.dist(place, self.centre_m) - self.radius_m)
        legs = [*pairwise(self.route_m), (self.route_m[-1], self.route_m[0])]
        return min(_from_leg_m(place, *leg) for leg in legs)


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
        doubled: in how many of them the wheels of two robots followed it.
        gaps: when it was not served, from and until, in mission seconds.
    """

    moments: int = 0
    driven: int = 0
    served: int = 0
    doubled: int = 0
    gaps: list[tuple[float, float]] = field(default_factory=list)

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
            if task.get("type") == CIRCLE:
                centre = settings.get("centre_m")
                if centre is None:
                    raise PancakesError(f"{name} has no centre_m: nobody could judge whether its circle is served")
                found.append(Duty(name, (centre[0], centre[1]), float(settings.get("radius_m", 0.27))))
            elif task.get("type") == PATROL:
                found.append(Duty(name, route_m=[(x_m, y_m) for x_m, y_m in settings["waypoints_m"]]))
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
    services = served(record.paths, [it for it in volts if it in record.paths], duties)
    held = {duty.name: holders(record, duty.name, run.ended_s) for duty in duties}
    levels = {name: lowest_level(record.paths.get(name, ()), *volts[name]) for name in volts}
    known = [level for level in levels.values() if level is not None]
    collided = [" with ".join(event.fields.get("names", ("?",))) for event in record.told("collision")]
    hours = max(run.ended_s, 1.0) / 3600.0
    return {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "ended_s": run.ended_s,
        "served": sum(it.share for it in services.values()) / len(services),
        "tasks": {
            name: {
                "served": it.share,
                "driven": it.driven / it.moments if it.moments else 0.0,
                "owners": len(held[name]),
                "longest_gap_s": max((end_s - start_s for start_s, end_s in it.gaps), default=0.0),
            }
            for name, it in services.items()
        },
        "gaps": {name: sorted(it.gaps, key=lambda gap: gap[0] - gap[1])[:GAPS_TOLD] for name, it in services.items()},
        "two_owners_s": {name: two_owners_s(held[name], services[name], record.paths) for name in services},
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
        "came_back": sum(1 for _ in record.told("agent_returned")),
        "collisions": len(collided),
        "collided": collided,
        "out_of_bounds": sum(1 for _ in record.told("out_of_bounds")),
    }


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
    last_s = 0.0
    for row_of in zip(*(paths[robot] for robot in robots), strict=False):
        time_s = last_s = row_of[0].t_s
        stands = {robot: next(still[robot]) for robot in robots}
        if time_s < START_S:
            continue
        for duty in duties:
            service = found[duty.name]
            drives = [(robot, row) for robot, row in zip(robots, row_of, strict=True) if row.driven_by == duty.name]
            service.moments += 1
            service.driven += bool(drives)
            service.doubled += len(drives) > 1
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


def _standing(path: Sequence[Row]) -> Iterator[bool]:
    """Yield for each row whether the robot has not left its place for `STILL_S`."""
    anchor = path[0] if path else None
    for row in path:
        assert anchor is not None
        if math.dist((row.x_m, row.y_m), (anchor.x_m, anchor.y_m)) > STILL_M:
            anchor = row
        yield row.t_s - anchor.t_s >= STILL_S


def two_owners_s(held: Sequence[Holder], service: Service, paths: Mapping[str, Sequence[Row]]) -> float:
    """Return for how long two robots had a task at once: by their events or by their wheels, the longer time."""
    told_s = 0.0
    ordered = sorted(held, key=lambda it: it.start_s)
    for place, earlier in enumerate(ordered):
        for later in ordered[place + 1 :]:
            both_s = min(earlier.end_s, later.end_s) - later.start_s
            if later.agent != earlier.agent and both_s > CLOCKS_AGREE_S:
                told_s += both_s
    path: Sequence[Row] = max(paths.values(), key=len, default=())
    step_s = (path[-1].t_s - path[0].t_s) / (len(path) - 1) if len(path) > 1 else 0.0
    return max(told_s, service.doubled * step_s)


def lowest_level(path: Sequence[Row], empty_v: float, full_v: float) -> float | None:
    """Return the lowest level that a battery had, from 0 to 1; None: nothing is known of it."""
    lowest_v = min((row.battery_v for row in path if row.battery_v is not None), default=None)
    return None if lowest_v is None else (lowest_v - empty_v) / (full_v - empty_v)


def reasons_to_fail(summary: Mapping[str, Any], run: Run, limits: EndlessLimits) -> list[str]:
    """Return why a mission fails, as sentences."""
    reasons = [f"the mission broke off: {run.ended_because}"] if run.ended_because else []
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
    if summary["collisions"]:
        reasons.append(f"there were {summary['collisions']} collisions: {', '.join(summary['collided'][:10])}")
    if summary["out_of_bounds"]:
        reasons.append(f"robots left the floor {summary['out_of_bounds']} times")
    if summary["came_back"] < len(summary["deaths"]) and run.ended_s >= run.duration_s:
        reasons.append(f"of {len(summary['deaths'])} robots that died {summary['came_back']} came back")
    return reasons
