"""The docks of simulated worlds: contacts in the floor that charge the robot which holds the dock and stands there.

A world of another distribution has docks by the same three steps: `docks: dict[str, DockSettings]` in its settings, one
`Docks` in its task, and `Docks.settle` as its time passes. The drivers are `sim.dock` and `network.dock`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, Protocol

from pancakes.devices import DockState
from pancakes.errors import PancakesError
from pancakes.settings import NotNegative, Positive
from pancakes.sim.battery import BatteryModel


@dataclass
class DockSettings:
    """A dock: contacts in the floor, which charge a robot that holds the dock and stands on them. It is not solid.

    Attributes:
        x_m: where it is.
        y_m: where it is.
        reach_m: a robot whose centre is at most this far away is charged.
        power_w: the power that it gives. At 0 it lies: it says that it charges, and gives nothing.
    """

    x_m: float
    y_m: float
    reach_m: Positive = 0.1
    power_w: NotNegative = 20.0


def check_docks(docks: Mapping[str, DockSettings], bodies: Iterable[str], half_x_m: float, half_y_m: float) -> None:
    """Check the docks of a world's settings.

    Args:
        docks: the docks, by name.
        bodies: the names of the other bodies.
        half_x_m: the arena reaches from minus this to this along x.
        half_y_m: the same along y.

    Raises:
        ValueError: a name is that of a body, a dock is not in the arena, or a robot would stand at two docks at once.
    """
    for (one, first), (other, second) in combinations(docks.items(), 2):
        if math.dist((first.x_m, first.y_m), (second.x_m, second.y_m)) < min(first.reach_m, second.reach_m):
            raise ValueError(f"{one} and {other} are at the same place, ({first.x_m}, {first.y_m}) m: move one of them")
    taken = frozenset(bodies)
    for name, dock in docks.items():
        if name in taken:
            raise ValueError(f"there are several bodies of the name {name!r}")
        if not (abs(dock.x_m) <= half_x_m and abs(dock.y_m) <= half_y_m):
            raise ValueError(f"{name} lies outside the arena, at ({dock.x_m}, {dock.y_m}) m")


class Charged(Protocol):
    """A robot, as far as docks care."""

    @property
    def position(self) -> tuple[float, float]:
        """Where it is."""

    @property
    def battery(self) -> BatteryModel | None:
        """Its battery; None: it has none that a dock could charge."""


class ChargingDock:
    """A dock. It charges the robot that holds it, while that stands at it.

    Args:
        settings: where it is, and what it gives.

    Attributes:
        settings: the same.
        robot: the name of the robot that holds it; empty: it is free.
    """

    def __init__(self, settings: DockSettings) -> None:
        self.settings = settings
        self.robot = ""
        self._good_until_s = 0.0
        self._charging = False

    def hold(self, robot: str, until_s: float) -> None:
        """Hold it for a robot until this mission time, or until the next command."""
        self.robot, self._good_until_s = robot, until_s

    def release(self) -> None:
        """Become free."""
        self.robot, self._charging = "", False

    def settle(self, now_s: float, elapsed_s: float, robots: Mapping[str, Charged]) -> None:
        """Charge for the last `elapsed_s`, up to `now_s`; a robot whose right is over is released."""
        if not self.robot:
            return
        if self._good_until_s < now_s - elapsed_s:
            self.release()
        robot = robots.get(self.robot)
        place = (self.settings.x_m, self.settings.y_m)
        self._charging = robot is not None and math.dist(robot.position, place) <= self.settings.reach_m
        if robot is not None and robot.battery is not None and self._charging:
            robot.battery.charged(self.settings.power_w * elapsed_s)
            robot.battery.charging = self.settings.power_w > 0.0

    def state(self) -> DockState:
        """Return what it says of itself."""
        state: Literal["free", "taken", "charging"] = "free"
        if self.robot:
            state = "charging" if self._charging else "taken"
        return DockState(state, self.settings.x_m, self.settings.y_m, self.robot)


class Docks:
    """All docks of a world.

    Args:
        settings: the docks, by name.
        world: what the world is called in sentences: `the simulated world`.
    """

    def __init__(self, settings: Mapping[str, DockSettings], world: str = "the simulated world") -> None:
        self._docks = {name: ChargingDock(it) for name, it in settings.items()}
        self._world = world

    def __contains__(self, name: str) -> bool:
        return name in self._docks

    def check(self, name: str) -> None:
        """Make sure that there is a dock of this name.

        Raises:
            PancakesError: there is none.
        """
        self._dock(name)

    def hold(self, name: str, robot: str, until_s: float) -> None:
        """Hold a dock for a robot until this mission time, or until the next command.

        Raises:
            PancakesError: there is no such dock.
        """
        self._dock(name).hold(robot, until_s)

    def release(self, name: str) -> None:
        """Let a dock become free.

        Raises:
            PancakesError: there is no such dock.
        """
        self._dock(name).release()

    def state(self, name: str) -> DockState:
        """Return what a dock says of itself.

        Raises:
            PancakesError: there is no such dock.
        """
        return self._dock(name).state()

    def settle(self, now_s: float, elapsed_s: float, robots: Mapping[str, Charged]) -> None:
        """Charge the robots that stand at docks which they hold.

        Args:
            now_s: the mission time.
            elapsed_s: the time that has passed since the last call.
            robots: all robots, by name.
        """
        if not self._docks:
            return
        for robot in robots.values():
            if robot.battery is not None:
                robot.battery.charging = False
        for dock in self._docks.values():
            dock.settle(now_s, elapsed_s, robots)

    def _dock(self, name: str) -> ChargingDock:
        found = self._docks.get(name)
        if found is None:
            raise PancakesError(f"{self._world} has no dock {name!r}, only {', '.join(self._docks) or 'none'}")
        return found
