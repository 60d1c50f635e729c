"""The laboratory: all that is known of `rps`, the Robotarium's simulator, and what is done against its faults.

It is written for `rps` 0.0.0, which is on the package index, and asks the object what it can do, so that version 2.1
works too. What callers need not know:

- `get_poses()` must be called exactly once before each `step()`: `step` does both.
- It moves the very arrays that it was given and gave out: copies go in and out.
- It ignores `ids`, and without all columns robots get others' velocities: all robots are commanded at each step.
- It limits speed and turning rate one by one, so that wheels may be too fast, which it counts but carries out: the
  wheels are limited before (`drive`).
- NaN passes, and makes the pose NaN, with the verdict "No errors": only finite numbers pass.
- All objects of a process share the counts of its judge, by a mutable default argument: each has its own here.
- It draws from numpy's global generator: all poses are given, and the draws of its sensors have a state of their own.
- It checks types with `assert`, which refuses numpy's integers and is gone under `-O`: they are checked here.
- It prints its verdict: the counts are read, and the words are returned.
- Its import takes 0.4 s, for pyplot: it is imported with the first laboratory.

The object belongs to one thread.
"""

from __future__ import annotations

import inspect
import math
import random
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy

from pancakes import PancakesError
from pancakes.devices import Twist
from pancakes.worlds import DriveKinematics
from pancakes_robotarium.gternal import ROUNDING
from pancakes_robotarium.settings import MOST_ROBOTS

DISTRIBUTION: Final = "robotarium-python-simulator"
_COUNTS: Final = {
    "collision": "collision",
    "robots_too_close": "collision",
    "boundary": "boundary",
    "robots_outside_boundaries": "boundary",
    "actuator": "actuator",
    "exceeded_actuator_limits": "actuator",
}
"""What the versions call what they count, and what it is called here."""
_AT_THE_END: Final = ("call_at_scripts_end", "debug")
"""What the versions call the method that ends an experiment and prints the verdict."""


class Place(msgspec.Struct, frozen=True, gc=False):
    """Where a robot is: x and y in m, heading in (-pi, pi]."""

    x_m: float
    y_m: float
    theta_rad: float


class Counts(msgspec.Struct, frozen=True, gc=False):
    """What the judge of `rps` has counted so far, in its steps.

    Attributes:
        steps: how many steps it made.
        collision: in how many two robots were too near to each other, for each pair.
        boundary: in how many a robot was outside, for each robot.
        actuator: in how many wheels were commanded to run faster than they can.
        other: how often it counted anything else, as a later version may.
    """

    steps: int
    collision: int
    boundary: int
    actuator: int
    other: int = 0

    @property
    def clean(self) -> bool:
        """Whether it has nothing to complain about."""
        return not (self.collision or self.boundary or self.actuator or self.other)


def simulator() -> type:
    """Return the class `Robotarium` of the `rps` that is installed: the simulator, or the laboratory in its place.

    Raises:
        PancakesError: it is not installed, or cannot be imported.
    """
    try:
        from rps.robotarium import Robotarium
    except ImportError as error:
        missing = error.name or ""
        if missing.partition(".")[0] == "rps":
            raise PancakesError(f"the Robotarium's simulator is not installed: pip install {DISTRIBUTION}") from None
        raise PancakesError(f"the Robotarium's simulator cannot be imported: {error}") from None
    found: type = Robotarium
    return found


def simulator_version() -> str:
    """Return the version of the `rps` that is used; `unknown` if it is of no installed distribution, as in a clone."""
    import rps

    try:
        found = distribution(DISTRIBUTION)
    except PackageNotFoundError:
        return "unknown"
    used = Path(rps.__file__ or "").resolve()
    return found.version if Path(str(found.locate_file("rps/__init__.py"))).resolve() == used else "unknown"


class Laboratory:
    """The robots of one experiment. See the module for what it keeps from its caller.

    Args:
        places: where the robots are at first, at most 50.
        random: draws the seed of what the simulator draws for itself.
        robotarium: the class of the object; None: that of the installed `rps`.

    Attributes:
        step_s: the length of a step, in seconds.
        half_width_m: the floor reaches from minus this to this along x.
        half_height_m: the same along y.
        diameter_m: the diameter of a robot.
        drive: its wheels, with limits under which the judge counts nothing.
        places: where the robots are; of one that is not seen, where it was seen last.
        unseen: the numbers of the robots whose pose is no number now, as of one that the cameras have lost.
        twists: what they do since the last step.

    Raises:
        PancakesError: `rps` is not installed, there are too many robots, or a place is no place on the floor.
    """

    def __init__(
        self, places: Sequence[Place], random: random.Random, robotarium: Callable[..., Any] | None = None
    ) -> None:
        if not 1 <= len(places) <= MOST_ROBOTS:
            raise PancakesError(f"the Robotarium has 1 to {MOST_ROBOTS} robots, not {len(places)}")
        start = numpy.array([[it.x_m for it in places], [it.y_m for it in places], [it.theta_rad for it in places]])
        if not numpy.all(numpy.isfinite(start)):
            raise PancakesError("a robot of the Robotarium has no place at first: x, y and heading must be numbers")
        self._draws = numpy.random.RandomState(random.getrandbits(32)).get_state()
        with self._own_draws():
            self._robots = _make(_with_own_counts(robotarium or simulator()), start)
        self._ids = list(range(len(places)))
        self._measures = hasattr(self._robots, "get_distances")
        self._ended = False
        self._steps = 0
        self.step_s = float(_fact(self._robots, "time_step"))
        self.half_width_m, self.half_height_m = _floor(self._robots)
        self.diameter_m = float(_fact(self._robots, "robot_diameter"))
        wheel_m, top_mps = float(_fact(self._robots, "wheel_radius")), float(_fact(self._robots, "max_linear_velocity"))
        within = 1.0 - ROUNDING
        self.drive = DriveKinematics(
            wheel_base_m=float(_fact(self._robots, "base_length")),
            max_wheel_mps=wheel_m * float(_fact(self._robots, "max_wheel_velocity")) * within,
            max_v_mps=top_mps * within,
            max_omega_radps=float(_fact(self._robots, "max_angular_velocity")) * within,
            units_per_mps=1e9,
        )
        self.twists = [Twist(0.0, 0.0)] * len(places)
        self._asked: list[Twist] = []
        self._velocities = numpy.zeros((2, len(places)))
        self.places = list(places)
        self.unseen: frozenset[int] = frozenset()
        self._look()

    def step(self, twists: Sequence[Twist]) -> None:
        """Advance by one step of `step_s`.

        Args:
            twists: what each robot is to do, in their order. What its wheels cannot do is slowed down on the same
                path; what is no number is no motion.

        Raises:
            PancakesError: there is not one command for each robot.
        """
        if len(twists) != len(self._ids):
            raise PancakesError(f"{len(self._ids)} robots got {len(twists)} commands: each needs one at each step")
        if list(twists) != self._asked:  # at most steps all go on as before
            self._asked = list(twists)
            self.twists = [self.drive.twist(self.drive.wheels(twist)) for twist in twists]
            self._velocities = numpy.array([[it.v_mps for it in self.twists], [it.omega_radps for it in self.twists]])
        self._robots.set_velocities(numpy.array(self._ids), self._velocities.copy())
        with self._own_draws() if self._measures else nullcontext():  # without sensors nothing is drawn
            self._robots.step()
        self._steps += 1
        self._look()

    def _look(self) -> None:
        # Once for each step, which the object insists on.
        poses = numpy.array(self._robots.get_poses(), dtype=float)
        seen = numpy.all(numpy.isfinite(poses), axis=0)
        self.unseen = frozenset() if seen.all() else frozenset(numpy.flatnonzero(~seen).tolist())
        found = [Place(*place) for place in zip(*poses.tolist(), strict=True)]
        self.places = [self.places[it] if it in self.unseen else place for it, place in enumerate(found)]

    def ranges(self) -> list[list[float]] | None:
        """Return what the range sensors of each robot measure, in m; NaN: nothing. None: this `rps` has none."""
        if not self._measures:
            return None
        found: list[list[float]] = numpy.array(self._robots.get_distances(), dtype=float).T.tolist()
        return found

    def counts(self) -> Counts | None:
        """Return what its judge has counted; None: this `rps` does not tell, as the real laboratory may not."""
        errors = getattr(self._robots, "_errors", None)
        if not isinstance(errors, Mapping):
            return None
        counted = dict.fromkeys((*_COUNTS.values(), "other"), 0)
        for name, number in errors.items():
            if isinstance(number, int):  # beside them are words, for its verdict
                counted[_COUNTS.get(name, "other")] += number
        return Counts(self._steps, **counted)

    def end(self) -> list[str]:
        """End the experiment, as each script of the Robotarium must; return what its judge says, in lines.

        The second time nothing is said.
        """
        if self._ended:
            return []
        self._ended = True
        end = next((it for name in _AT_THE_END if (it := getattr(self._robots, name, None)) is not None), None)
        said: list[str] = []
        if end is not None:
            with _heard(end, said):
                end()
        return [line.strip() for text in said for line in text.splitlines() if line.strip()]

    @contextmanager
    def _own_draws(self) -> Iterator[None]:
        """Draw from a state of one's own meanwhile, where `rps` draws from numpy's global generator."""
        others = numpy.random.get_state()
        numpy.random.set_state(self._draws)
        try:
            yield
        finally:
            self._draws = numpy.random.get_state()
            numpy.random.set_state(others)


def _with_own_counts(robotarium: Any) -> Any:
    """Return a class of which each object has counts of its own; something that is no such class as it is."""
    if not (isinstance(robotarium, type) and hasattr(robotarium, "_validate")):
        return robotarium

    class OwnCounts(robotarium):
        def _validate(self, errors: Any = None) -> Any:
            return super()._validate(self._errors)

    return OwnCounts


def _make(robotarium: Callable[..., Any], start: Any) -> Any:
    options: dict[str, Any] = {
        "number_of_robots": int(start.shape[1]),
        "show_figure": False,
        "sim_in_real_time": False,
        "initial_conditions": start,
    }
    known = inspect.signature(robotarium).parameters.values()
    if any(it.kind is inspect.Parameter.VAR_KEYWORD for it in known):
        # Version 2 drives the robots to their places first, for a time that nobody knows; its range sensors are off.
        options |= {"skip_initialization": True, "use_distance_sensors": True}
    return robotarium(**options)


def _fact(robots: Any, name: str) -> Any:
    """Return a figure of the object, which version 2 calls by the same name in capitals."""
    for spelt in (name, name.upper()):
        if hasattr(robots, spelt):
            return getattr(robots, spelt)
    raise PancakesError(f"this version of the Robotarium's simulator ({simulator_version()}) does not tell its {name}")


def _floor(robots: Any) -> tuple[float, float]:
    """Return half the width and half the height of the floor, round the origin."""
    if hasattr(robots, "BOUNDARIES"):
        left_m, right_m, bottom_m, top_m = (float(it) for it in robots.BOUNDARIES)
    else:
        left_m, bottom_m, width_m, height_m = (float(it) for it in _fact(robots, "boundaries"))
        right_m, top_m = left_m + width_m, bottom_m + height_m
    if not (math.isclose(left_m, -right_m) and math.isclose(bottom_m, -top_m)):
        raise PancakesError(
            f"the floor of the Robotarium, x {left_m} to {right_m}, y {bottom_m} to {top_m} m, is moved"
        )
    return right_m, top_m


@contextmanager
def _heard(method: Any, said: list[str]) -> Iterator[None]:
    """Take what the module of a method prints meanwhile; what other threads print stays where it belongs."""
    module = sys.modules[getattr(method, "__func__", method).__module__]
    module.print = lambda *words, **_: said.append(" ".join(map(str, words)))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        del module.print
