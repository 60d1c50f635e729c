"""The scenario of a mission: the part of its configurations that a verdict and a figure need."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from pancakes import PancakesError
from pancakes.settings import make_settings
from pancakes.sim.bodies import RobotSettings, WorldSettings
from pancakes.sim.robot_models import robot_model
from pancakes.util.plugins import installed

Table = Mapping[str, Any]

SCAN = "encirclement.ScanTarget"
HOME = "encirclement.GoHome"
WATCHDOG = "encirclement.BatteryWatchdog"


@dataclass(frozen=True, slots=True)
class Scenario:
    """A mission's cast and stage.

    Attributes:
        first: the agent that holds `ScanTarget` at first.
        robots: all robots, by the world's order.
        sensor: the sensor node.
        movers: the persons that walk through the arena.
        scan: the name of the circling task.
        home: the name of the task that goes home; empty if there is none.
        radius_m: the radius of the circle.
        half_width_m: the arena reaches from minus this to this along x.
        half_height_m: the same along y.
        battery_v: each robot's voltage when its battery is full, and when it is empty.
        watched_levels: levels of the battery at which something happens, from the highest.
    """

    first: str
    robots: tuple[str, ...]
    sensor: str
    movers: tuple[str, ...]
    scan: str
    home: str
    radius_m: float
    half_width_m: float
    half_height_m: float
    battery_v: Mapping[str, tuple[float, float]]
    watched_levels: tuple[float, ...] = ()

    @property
    def second(self) -> str:
        """The robot in reserve; empty if there is none."""
        return next((robot for robot in self.robots if robot != self.first), "")


def read_scenario(configs: Mapping[str, Table]) -> Scenario:
    """Read the scenario from the configurations of all agents.

    Args:
        configs: the agents' configurations, including overrides, by the agent's name; see
            `pancakes.tools.demo.Run.configs`.

    Raises:
        PancakesError: no agent simulates a world, or none has a `ScanTarget`.
    """
    world = find_world(configs)
    first, scan, task = _find_scan(configs)
    return Scenario(
        first=first,
        robots=tuple(world.robots),
        sensor=next(iter(world.sensors), ""),
        movers=tuple(world.movers),
        scan=scan,
        home=next((name for name, other in _tasks(configs[first]) if other.get("type") == HOME), ""),
        radius_m=float(task.get("settings", {}).get("radius_m", 0.55)),
        half_width_m=0.5 * world.arena.width_m,
        half_height_m=0.5 * world.arena.height_m,
        battery_v={name: _voltages(robot) for name, robot in world.robots.items()},
        watched_levels=_levels(configs[first], task),
    )


def find_world(configs: Mapping[str, Table]) -> WorldSettings:
    """Return the contents of the world: the settings of the task whose settings are such contents.

    Any world will do, of whatever distribution.
    """
    plugins = installed()
    for config in configs.values():
        for _, task in _tasks(config):
            try:
                settings: type = plugins.get("pancakes.tasks", str(task.get("type"))).Settings
            except PancakesError:
                continue  # it is not installed here, so it is no world that could be read
            if issubclass(settings, WorldSettings):
                known = {field.name for field in fields(settings)}  # a record may be of another version
                given = {key: value for key, value in task.get("settings", {}).items() if key in known}
                return make_settings(settings, given)
    raise PancakesError(f"none of the agents {', '.join(configs)} simulates a world that is installed here")


def _find_scan(configs: Mapping[str, Table]) -> tuple[str, str, Table]:
    for agent, config in configs.items():
        for name, task in _tasks(config):
            if task.get("type") == SCAN:
                return agent, name, task
    raise PancakesError(
        f"none of the agents {', '.join(configs)} has a task that goes round: no task is of the type {SCAN!r}"
    )


def _tasks(config: Table) -> Iterator[tuple[str, Table]]:
    yield from config.get("tasks", {}).items()


def _voltages(robot: RobotSettings) -> tuple[float, float]:
    model = robot_model(robot.model)
    return model.full_v, model.empty_v


def _levels(config: Table, scan: Table) -> tuple[float, ...]:
    levels = [(scan.get("migrate") or {}).get("below")]
    for _, task in _tasks(config):
        if task.get("type") == WATCHDOG:
            levels.append(task.get("settings", {}).get("below", 0.90))
    return tuple(sorted((float(level) for level in levels if level is not None), reverse=True))
