"""What is in the Robotarium: the settings of its world. Pure: nothing here imports the simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import combinations
from typing import Annotated, Final

from msgspec import Meta

from pancakes import FilePath, NotNegative
from pancakes.worlds import ArenaSettings, DockSettings, RobotSettings, WorldSettings, check_docks, robot_model
from pancakes_robotarium.gternal import DIAMETER_M, MAX_MPS

WIDTH_M: Final = 3.2
HEIGHT_M: Final = 2.0
"""The floor of the Robotarium."""
MOST_ROBOTS: Final = 50


@dataclass
class RobotariumRobot(RobotSettings):
    """A robot of the Robotarium that an agent drives.

    Attributes:
        x_m: where it starts.
        y_m: where it starts.
        theta_rad: how it looks at the start.
        model: what kind of robot it is, not larger than a GTernal. It is never faster than the laboratory allows.
        spread_m: the seed moves its start by at most this along each axis.
        spread_rad: the seed turns it at the start by at most this, either way.
        battery: its battery, which the simulator itself does not have.
    """

    model: str = "gternal"

    def __post_init__(self) -> None:
        _check_size(self.model)


@dataclass
class Guest:
    """A robot of the Robotarium that belongs to no agent: the world drives it from place to place.

    It gives way to nobody, as the robot of somebody else would not.

    Attributes:
        x_m: where it starts.
        y_m: where it starts.
        theta_rad: how it looks at the start.
        model: what kind of robot it is, not larger than a GTernal.
        speed_mps: how fast it drives.
        spread_m: the seed moves its start by at most this along each axis.
        waypoints: the places it drives to, in turn, over and over; without any it stands.
    """

    x_m: float
    y_m: float
    theta_rad: float = 0.0
    model: str = "gternal"
    speed_mps: Annotated[float, Meta(ge=0, le=MAX_MPS)] = 0.1
    spread_m: NotNegative = 0.02
    waypoints: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        _check_size(self.model)


def _check_size(model: str) -> None:
    if robot_model(model).diameter_m > DIAMETER_M:
        raise ValueError(f"a {model} is larger than the robots of the Robotarium, which are {DIAMETER_M} m wide")


@dataclass
class RobotariumSettings(WorldSettings):
    """The contents of the laboratory. They are read once, when the task starts.

    Attributes:
        arena: the part of the floor that robots may use; all of it by default.
        robots: the robots that agents drive.
        sensors: sensor nodes, which the simulator does not know.
        movers: the robots that belong to no agent.
        docks: docks, which the simulator does not know; they charge the robots' batteries.
        bus: address at which simulated devices reach it.
        state_steps: it publishes its state once in this many steps of 33 ms.
        range_noise: standard deviation of what a range sensor measures, as a share of it.
        path: the file with the verdict of its simulator, which is written at the end.
    """

    arena: ArenaSettings = field(default_factory=lambda: ArenaSettings(WIDTH_M, HEIGHT_M))
    robots: dict[str, RobotariumRobot] = field(default_factory=dict)  # type: ignore[assignment]
    movers: dict[str, Guest] = field(default_factory=dict)  # type: ignore[assignment]
    docks: dict[str, DockSettings] = field(default_factory=dict)
    bus: str = "tcp://127.0.0.1:7499"
    state_steps: Annotated[int, Meta(ge=1)] = 2
    range_noise: NotNegative = 0.03
    path: FilePath = "robotarium.json"

    def __post_init__(self) -> None:
        if self.arena.width_m > WIDTH_M or self.arena.height_m > HEIGHT_M:
            raise ValueError(f"the floor of the Robotarium is {WIDTH_M} x {HEIGHT_M} m: arena may not be larger")
        super().__post_init__()
        bodies = (*self.robots, *self.sensors, *self.movers)
        check_docks(self.docks, bodies, 0.5 * self.arena.width_m, 0.5 * self.arena.height_m)
        count = len(self.robots) + len(self.movers)
        if not 1 <= count <= MOST_ROBOTS:
            raise ValueError(f"the Robotarium has 1 to {MOST_ROBOTS} robots, and here are {count}")
        wheeled: dict[str, RobotariumRobot | Guest] = {**self.robots, **self.movers}
        starts = {name: (one.x_m, one.y_m, one.spread_m) for name, one in wheeled.items()}
        for name, (x_m, y_m, spread_m) in starts.items():
            if abs(x_m) + spread_m > self.arena.width_m / 2 or abs(y_m) + spread_m > self.arena.height_m / 2:
                raise ValueError(f"{name} may start outside the arena: it stands at ({x_m}, {y_m}) ± {spread_m} m")
        for (one, at), (other, there) in combinations(starts.items(), 2):
            apart_m = math.dist(at[:2], there[:2]) - math.sqrt(2.0) * (at[2] + there[2])
            if apart_m <= DIAMETER_M:
                near = f"{max(apart_m, 0.0):.2f} m apart, and each is {DIAMETER_M} m wide"
                raise ValueError(f"{one} and {other} may start {near}")
        for name, guest in self.movers.items():
            for x_m, y_m in guest.waypoints:
                if not (abs(x_m) <= self.arena.width_m / 2 and abs(y_m) <= self.arena.height_m / 2):
                    raise ValueError(f"{name} cannot drive to ({x_m}, {y_m}) m, outside the arena")
