"""A simulated field: its fires and walking persons, at each moment of a script. Pure."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field

from pancakes import NotNegative, Positive
from pancakes.sim.battery import BatterySettings


@dataclass
class NodeSettings:
    """The place of a node.

    Attributes:
        x_m, y_m: its place.
        sees_m: how far its motion sensor sees.
        battery: its battery; None: it is not simulated.
    """

    x_m: float
    y_m: float
    sees_m: Positive = 3.0
    battery: BatterySettings | None = None


@dataclass
class WalkerSettings:
    """A person that walks through the field, and is absent before and after.

    Attributes:
        way: moments and places, as (seconds, x, y); in between they walk straight; if two places are equal, they stand
            still.
    """

    way: list[tuple[float, float, float]]

    def __post_init__(self) -> None:
        times = [time_s for time_s, _, _ in self.way]
        if len(times) < 2 or any(later <= earlier for earlier, later in zip(times, times[1:], strict=False)):
            raise ValueError("a way has two or more moments, each later than the one before")


@dataclass
class FireSettings:
    """A fire.

    Attributes:
        x_m, y_m: its place.
        starts_s: when it begins.
        ends_s: when it is out.
        peak_c: how much it warms a node in its centre, in degrees.
        radius_m: how far away it is felt.
        growth_s: how long it takes to grow, and to cool down.
    """

    x_m: float
    y_m: float
    starts_s: NotNegative
    ends_s: Positive
    peak_c: Positive = 60.0
    radius_m: Positive = 4.0
    growth_s: Positive = 5.0

    def __post_init__(self) -> None:
        if self.ends_s <= self.starts_s:
            raise ValueError("a fire ends after its start")


@dataclass
class SceneSettings:
    """A field and what happens in it.

    Attributes:
        nodes: the nodes, including tiny ones.
        walkers: the persons.
        fires: the fires.
        ambient_c: the temperature of the air at first.
        drift_c_per_hour: how much it changes in an hour.
        noise_c: standard deviation of a thermometer.
    """

    nodes: dict[str, NodeSettings] = field(default_factory=dict)
    walkers: dict[str, WalkerSettings] = field(default_factory=dict)
    fires: dict[str, FireSettings] = field(default_factory=dict)
    ambient_c: float = 18.0
    drift_c_per_hour: float = -3.0
    noise_c: NotNegative = 0.1


@dataclass(frozen=True, slots=True)
class Walker:
    """The place and speed of a walker."""

    name: str
    x_m: float
    y_m: float
    theta_rad: float
    speed_mps: float


class Scene:
    """The state of a field at any moment, from its settings; it has no memory.

    Args:
        settings: the field.
    """

    def __init__(self, settings: SceneSettings) -> None:
        self._settings = settings

    def celsius(self, node: str, time_s: float) -> float:
        """Return the true temperature at a node."""
        settings = self._settings
        place = settings.nodes[node]
        celsius = settings.ambient_c + settings.drift_c_per_hour * time_s / 3600
        for fire in settings.fires.values():
            off_m = math.hypot(place.x_m - fire.x_m, place.y_m - fire.y_m)
            celsius += fire.peak_c * math.exp(-0.5 * (off_m / fire.radius_m) ** 2) * _heat(fire, time_s)
        return celsius

    def moving(self, node: str, time_s: float) -> bool:
        """Return whether a person moves in front of a node."""
        place = self._settings.nodes[node]
        return any(
            walker.speed_mps > 0 and math.hypot(walker.x_m - place.x_m, walker.y_m - place.y_m) <= place.sees_m
            for walker in self.walkers(time_s)
        )

    def walkers(self, time_s: float) -> list[Walker]:
        """Return the persons that are in the field."""
        there = (_walker(name, settings, time_s) for name, settings in self._settings.walkers.items())
        return [walker for walker in there if walker is not None]


def _heat(fire: FireSettings, time_s: float) -> float:
    """Return how far a fire has grown, or not yet cooled down, from 0 to 1."""
    if time_s <= fire.starts_s:
        return 0.0
    grown = 1.0 - math.exp(-(min(time_s, fire.ends_s) - fire.starts_s) / fire.growth_s)
    return grown * math.exp(-max(time_s - fire.ends_s, 0.0) / fire.growth_s)


def _walker(name: str, settings: WalkerSettings, time_s: float) -> Walker | None:
    way = settings.way
    if not way[0][0] <= time_s <= way[-1][0]:
        return None
    leg = min(bisect_right(way, time_s, key=lambda moment: moment[0]), len(way) - 1)
    (from_s, from_x, from_y), (to_s, to_x, to_y) = way[leg - 1], way[leg]
    share = (time_s - from_s) / (to_s - from_s)
    speed_mps = math.hypot(to_x - from_x, to_y - from_y) / (to_s - from_s)
    heading = math.atan2(to_y - from_y, to_x - from_x)
    return Walker(name, from_x + share * (to_x - from_x), from_y + share * (to_y - from_y), heading, speed_mps)
