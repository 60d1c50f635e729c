"""Missions whose tasks try to make robots collide, with and without a barrier below them.

Ten robots of the Robotarium get commands that aim at each other, at the walls, at a stranger, or are no numbers. A
stranger is a robot without a barrier, as fast as the others, which drives from point to point and gives way to nobody.
A tracker tells where it is. Each robot hears its own pose late, and those of the others at 10 Hz, late, with a fifth of
them lost. The Robotarium's simulator `rps` counts who has collided, if it is installed; else a floor of the same size
does, with the same rules.

The filter is the one that an agent runs (`pancakes.filters.barrier`); what stands in here is the agent around it.
"""

from __future__ import annotations

import math
import random
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any, Final, Protocol

from pancakes.devices import Pose, RobotPose, Twist
from pancakes.filters.barrier import Barrier, driven
from pancakes.filters.filter import Changed, Held
from pancakes.packet import Packet
from pancakes.settings import make_settings
from pancakes.worlds import DriveKinematics

ROBOTS: Final = 10
STEP_S: Final = 0.033
HALF_WIDTH_M, HALF_HEIGHT_M = 1.6, 1.0
DIAMETER_M: Final = 0.11
DRIVE: Final = DriveKinematics(
    wheel_base_m=0.105,
    max_wheel_mps=0.2 * (1 - 1e-9),
    max_v_mps=0.2 * (1 - 1e-9),
    max_omega_radps=3.6363,
    units_per_mps=1e9,
)
KINDS: Final = ("each other", "walls", "a stranger", "no numbers")
COMMAND_STEPS, CHECK_STEPS, TELL_STEPS = 3, 2, 3
OWN_LATE_STEPS: Final = 1
LATE_STEPS: Final = (1, 3)
LOST: Final = 0.2
STRANGER_MPS: Final = 0.2
SETTINGS: Final[dict[str, Any]] = {
    "radius_m": DIAMETER_M / 2,
    "max_mps": 0.2,
    "max_radps": 3.6,
    "area": {"x_min_m": -HALF_WIDTH_M, "x_max_m": HALF_WIDTH_M, "y_min_m": -HALF_HEIGHT_M, "y_max_m": HALF_HEIGHT_M},
}


@dataclass(frozen=True)
class Mission:
    """One mission.

    Attributes:
        seed: draws all that is drawn.
        filtered: whether the robots have a barrier.
        length_s: how long it lasts.
        by_rps: whether `rps` moves and judges the robots.
    """

    seed: int
    filtered: bool
    length_s: float
    by_rps: bool

    @property
    def kind(self) -> str:
        """What the commands aim at."""
        return KINDS[self.seed % len(KINDS)]


@dataclass(frozen=True)
class Outcome:
    """What came of a mission.

    Attributes:
        mission: the mission.
        collisions: in how many steps two robots were too near to each other, for each pair.
        outside: in how many steps a robot's centre was outside, for each robot.
        closest_m: the least distance of two robots' centres.
        driven_m: how far a robot has driven, in the mean.
        filter_s: the processor time that one pass of the filter took, in the mean.
        longest_s: the longest one.
        held: the share of passes after which the robot stood.
    """

    mission: Mission
    collisions: int
    outside: int
    closest_m: float
    driven_m: float
    filter_s: float
    longest_s: float
    held: float


class Place(Protocol):
    """Where a robot is."""

    @property
    def x_m(self) -> float: ...

    @property
    def y_m(self) -> float: ...

    @property
    def theta_rad(self) -> float: ...


class Floor(Protocol):
    """What moves robots, and judges."""

    @property
    def places(self) -> Sequence[Place]: ...

    def step(self, twists: Sequence[Twist]) -> None: ...

    def judged(self) -> tuple[int, int]: ...


class OwnFloor:
    """A floor as large as the Robotarium's, with its rules: nothing is solid, and the judge counts each step.

    Attributes:
        places: where the robots are.
    """

    def __init__(self, places: Sequence[Pose]) -> None:
        self.places: list[Pose] = list(places)
        self._collisions = self._outside = 0

    def step(self, twists: Sequence[Twist]) -> None:
        """Advance by one step."""
        moved = []
        for place, twist in zip(self.places, twists, strict=True):
            moved.append(driven(place, DRIVE.twist(DRIVE.wheels(twist)), STEP_S))
        self.places = moved
        self._outside += sum(abs(it.x_m) > HALF_WIDTH_M or abs(it.y_m) > HALF_HEIGHT_M for it in moved)
        self._collisions += sum(gap_m <= DIAMETER_M for gap_m in distances(moved))

    def judged(self) -> tuple[int, int]:
        """Return how many collisions there were, and in how many steps a robot was outside."""
        return self._collisions, self._outside


class RpsFloor:
    """The Robotarium's simulator, and its judge."""

    def __init__(self, places: Sequence[Pose], source: random.Random) -> None:
        from pancakes_robotarium.laboratory import Laboratory
        from pancakes_robotarium.laboratory import Place as AtFirst

        self._laboratory = Laboratory([AtFirst(it.x_m, it.y_m, it.theta_rad) for it in places], source)

    @property
    def places(self) -> Sequence[Place]:
        """Where the robots are."""
        return self._laboratory.places

    def step(self, twists: Sequence[Twist]) -> None:
        """Advance by one step."""
        self._laboratory.step(twists)

    def judged(self) -> tuple[int, int]:
        """Return how many collisions there were, and in how many steps a robot was outside."""
        counts = self._laboratory.counts()
        assert counts is not None, "this rps tells no counts"
        return counts.collision, counts.boundary


def has_rps() -> bool:
    """Return whether the Robotarium's simulator, and the plug-in for it, are installed."""
    try:
        from pancakes_robotarium.laboratory import simulator

        simulator()
    except Exception:
        return False
    return True


def distances(places: Sequence[Place]) -> Iterator[float]:
    """Yield the distance of each pair."""
    for index, one in enumerate(places):
        for other in places[:index]:
            yield math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)


class _Context:
    """What a barrier sees of its agent."""

    device, name = "motors", "apart"

    def __init__(self, agent: str, now: Callable[[], float]) -> None:
        self.agent = agent
        self.now = now
        self.told: list[RobotPose] = []
        self.handlers: dict[type, Callable[[Packet], None]] = {}
        self.kept: dict[str, Any] = {}

    def subscribe(self, channel: str, body: type, handler: Callable[[Packet], None]) -> None:
        self.handlers[body] = handler

    def publish(self, channel: str, body: Any, to: str = "") -> None:
        self.told.append(body)

    def published_s(self, packet: Packet) -> float:
        return packet.stamp_s


class Robot:
    """One robot: its barrier, if it has one, and the newest command of its task."""

    def __init__(self, name: str, barrier: bool, now: Callable[[], float]) -> None:
        self.name = name
        self.command = Twist(0.0, 0.0)
        self.twist = Twist(0.0, 0.0)
        self.context = _Context(name, now)
        self.barrier: Barrier | None = None
        if barrier:
            self.barrier = Barrier(self.context, make_settings(Barrier.Settings, SETTINGS))  # type: ignore[arg-type]
            self.barrier.open()

    def hear(self, stamp_s: float, source: str, body: Pose | RobotPose) -> None:
        """Take a packet."""
        if self.barrier is not None:
            kind = "pose" if isinstance(body, Pose) else "robot_pose"
            self.context.handlers[type(body)](Packet("system", kind, source, "", stamp_s, 1, body))

    def act(self) -> bool:
        """Carry out the newest command, as its device would; return whether the robot stands instead."""
        if not (math.isfinite(self.command.v_mps) and math.isfinite(self.command.omega_radps)):
            self.twist = Twist(0.0, 0.0)  # a device refuses it, and holds
            if self.barrier is not None:
                self.barrier.on_hold()
            return True
        found: Any = self.command
        if self.barrier is not None:
            found = self.barrier.apply(self.command, 0.5, f"{self.name}/client/Task")
        if isinstance(found, Held):
            self.twist = Twist(0.0, 0.0)
            return True
        self.twist = found.command if isinstance(found, Changed) else found
        return False


def aimed(place: Place, x_m: float, y_m: float, speed_mps: float = 0.2) -> Twist:
    """Return a command that drives at a point at full speed."""
    bearing_rad = math.remainder(math.atan2(y_m - place.y_m, x_m - place.x_m) - place.theta_rad, math.tau)
    return Twist(speed_mps * max(0.0, math.cos(bearing_rad)), max(-3.6, min(3.6, 3.0 * bearing_rad)))


def command_for(kind: str, index: int, places: Sequence[Place], draw: random.Random) -> Twist:
    """Return the next command of a robot's task."""
    place = places[index]
    if kind == "no numbers" and draw.random() < 0.2:
        return Twist(draw.choice((math.nan, math.inf, -math.inf, 0.2)), draw.choice((math.nan, 1.0)))
    if kind == "walls" and index % 2:
        if HALF_WIDTH_M - abs(place.x_m) < HALF_HEIGHT_M - abs(place.y_m):
            return aimed(place, math.copysign(2 * HALF_WIDTH_M, place.x_m), place.y_m)
        return aimed(place, place.x_m, math.copysign(2 * HALF_HEIGHT_M, place.y_m))
    if kind == "a stranger":
        return aimed(place, places[0].x_m, places[0].y_m)
    others = [it for number, it in enumerate(places) if number != index]
    nearest = min(others, key=lambda it: math.hypot(it.x_m - place.x_m, it.y_m - place.y_m))
    return aimed(place, nearest.x_m, nearest.y_m)


class Stranger:
    """Where a robot that is not ours drives to: from point to point."""

    def __init__(self, draw: random.Random) -> None:
        self._draw = draw
        self._goal = (0.0, 0.0)

    def command(self, place: Place) -> Twist:
        """Return its next command."""
        if math.hypot(self._goal[0] - place.x_m, self._goal[1] - place.y_m) < 0.1:
            self._goal = (
                self._draw.uniform(-HALF_WIDTH_M + 0.3, HALF_WIDTH_M - 0.3),
                self._draw.uniform(-HALF_HEIGHT_M + 0.3, HALF_HEIGHT_M - 0.3),
            )
        return aimed(place, *self._goal, STRANGER_MPS)


def fly(mission: Mission) -> Outcome:
    """Run a mission."""
    draw = random.Random(f"collisions/{mission.seed}")
    spots = [(-1.25 + 0.5 * column, -0.7 + 0.7 * row) for column in range(6) for row in range(3)]
    begins = [Pose(x_m, y_m, draw.uniform(-math.pi, math.pi)) for x_m, y_m in draw.sample(spots, ROBOTS)]
    floor: Floor = RpsFloor(begins, draw) if mission.by_rps else OwnFloor(begins)
    clock = [0.0]
    strange = mission.kind == "a stranger"
    robots = [
        Robot(f"r{index}", mission.filtered and not (strange and index == 0), lambda: clock[0])
        for index in range(ROBOTS)
    ]
    stranger = Stranger(draw)
    past: deque[Sequence[Place]] = deque([floor.places], maxlen=max(LATE_STEPS) + OWN_LATE_STEPS + 1)
    travelling: list[tuple[int, Robot, float, str, RobotPose]] = []
    closest_m, driven_m, spent_s, longest_s, passes, held = math.inf, 0.0, 0.0, 0.0, 0, 0
    for step in range(round(mission.length_s / STEP_S)):
        clock[0] = step * STEP_S
        late = past[max(0, len(past) - 1 - OWN_LATE_STEPS)]
        stamp_s = max(0, step - OWN_LATE_STEPS) * STEP_S
        for index, robot in enumerate(robots):
            if step % 2 == 0:  # a pose device at 15 Hz
                it = late[index]
                robot.hear(stamp_s, f"{robot.name}/device/pose", Pose(it.x_m, it.y_m, it.theta_rad))
            if strange and index == 0 and step % TELL_STEPS == 0:  # a tracker sees what has no agent of ours
                it = late[0]
                seen = (it.x_m, it.y_m, it.theta_rad, DIAMETER_M / 2, STRANGER_MPS, OWN_LATE_STEPS * STEP_S)
                robot.context.told = [RobotPose(robot.name, *seen)]
            for body in robot.context.told:
                source = "tracker/client/Tracker" if strange and index == 0 else f"{robot.name}/device/motors"
                travelling.extend(
                    (step + draw.randint(*LATE_STEPS), other, clock[0], source, body)
                    for other in robots
                    if other is not robot and draw.random() >= LOST
                )
            robot.context.told = []
        arrived = [it for it in travelling if it[0] <= step]
        travelling = [it for it in travelling if it[0] > step]
        for _, other, sent_s, source, body in arrived:
            other.hear(sent_s, source, body)
        for index, robot in enumerate(robots):
            commanded = (step + index) % COMMAND_STEPS == 0
            if commanded:
                if strange and index == 0:
                    robot.command = stranger.command(floor.places[0])
                else:
                    robot.command = command_for(mission.kind, index, floor.places, draw)
            if commanded or (step + index) % CHECK_STEPS == 0:
                began_s = time.thread_time()
                held += robot.act()
                if robot.barrier is not None:
                    took_s = time.thread_time() - began_s
                    spent_s, longest_s, passes = spent_s + took_s, max(longest_s, took_s), passes + 1
        before = floor.places
        floor.step([robot.twist for robot in robots])
        past.append(floor.places)
        closest_m = min(closest_m, *distances(floor.places))
        driven_m += sum(
            math.hypot(it.x_m - was.x_m, it.y_m - was.y_m) for it, was in zip(floor.places, before, strict=True)
        )
    collisions, outside = floor.judged()
    mean_s = spent_s / passes if passes else 0.0
    return Outcome(
        mission, collisions, outside, closest_m, driven_m / ROBOTS, mean_s, longest_s, held / passes if passes else 0.0
    )


def fly_all(missions: Sequence[Mission], jobs: int) -> Iterator[Outcome]:
    """Run missions, several at once; yield what came of them, in their order."""
    if jobs == 1:
        yield from map(fly, missions)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(fly, missions, chunksize=4)
