"""A filter that keeps a robot clear of other robots, walls and no-go areas (`barrier`).

A point a little ahead of the axle can move in every direction at once, so it obeys a velocity (Yun and Yamamoto 1992).
For each thing that is near, a control barrier function allows the velocities that close at most a share of the gap each
second (Ames et al. 2019; Wang, Ames and Egerstedt 2017). `Barrier` takes the allowed velocity that is nearest to the
commanded one. Two robots with a barrier do half of it each. For a robot without one, or one that is silent, this robot
does all of it.

`Surroundings` keeps what is known of the robot's own pose and of others; the functions below it are pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from pancakes.devices import Pose, RobotPose, Twist
from pancakes.devices.driver import Pace
from pancakes.filters.filter import Changed, Filter, Held
from pancakes.filters.half_planes import HalfPlane, least_bad
from pancakes.filters.limit import within
from pancakes.packet import NEIGHBOURS, SYSTEM, Packet, agent_of
from pancakes.settings import NotNegative, Positive

MOST_ROBOTS: Final = 64
"""The poses of at most this many other robots are kept. What one agent says pushes out only what it has said itself,
or, if it is about itself, what others say of further robots: so no agent makes this robot forget another one."""
FORGET_S: Final = 60.0
"""If there are more robots, one that was silent for this time, in mission time, is forgotten for another."""
CROWDED_S: Final = 2.0
"""How long, in mission time, this robot holds if there is no room to remember another one."""
SAME_PLACE: Final = 0.5
"""Two robots whose centres are closer than this share of the sum of their radii cannot both be where they say."""
SLOW: Final = 0.05
"""A robot that is moved slower than this share of its speed does not get on."""
WANTS: Final = 0.2
"""A robot that is commanded faster than this share of its speed wants to get on."""
OPEN_PER_S: Final = 4.0
"""A gap that is too small grows by this share of what it lacks each second."""
YIELDER_GIVES, STRANGER_GIVES, WALL_GIVES = 1.0, 0.3, 0.3
"""If no velocity suits all, robots that move out of the way themselves give way first ..."""
LEAST_GIVES: Final = 0.1
"""... but the nearer a thing is, the less it gives way, down to this share where the two would touch."""
STUCK_S: Final = 1.0
"""A robot that has not got on for this time, in mission time, gives way to the right ..."""
ASIDE_S: Final = 2.0
"""... for this time."""
ASIDE_RAD: Final = math.radians(-60.0)


class Area(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle in the frame of the world.

    Attributes:
        x_min_m: its left side.
        x_max_m: its right side.
        y_min_m: its lower side.
        y_max_m: its upper side.
    """

    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float

    def __post_init__(self) -> None:
        for low, high in (("x_min_m", "x_max_m"), ("y_min_m", "y_max_m")):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} = {getattr(self, low):g} is above {high} = {getattr(self, high):g}")


class Seen(msgspec.Struct, frozen=True):
    """A pose of a robot, and when it was there.

    Attributes:
        body: the pose, and what the robot is like.
        at_s: when it was there, in this agent's mission time.
        speaker: the agent that said it.
    """

    body: RobotPose
    at_s: float
    speaker: str

    @property
    def own_word(self) -> bool:
        """Whether the robot's own agent said it."""
        return self.speaker == self.body.robot


class OwnPose(msgspec.Struct, frozen=True):
    """This robot's own pose, and when it was there, in mission time."""

    pose: Pose
    at_s: float


class Surroundings:
    """What is known of this robot's own pose, and of the other robots.

    Args:
        agent: the name of this robot's agent.
    """

    def __init__(self, agent: str) -> None:
        self._agent = agent
        self.own: OwnPose | None = None
        self.unsettled_until_s = -math.inf
        self.crowded_until_s = -math.inf
        self.robots: dict[str, Seen] = {}
        self.ghosts: dict[str, tuple[Seen, float]] = {}  # where one was that has jumped, and until when that counts

    def moved(self, pose: Pose, at_s: float, max_mps: float, jump_m: float, settle_s: float) -> None:
        """Take note of this robot's own pose.

        Args:
            pose: the pose; one with a number that is not finite is not used.
            at_s: when it was measured, in mission time.
            max_mps: how fast the robot may move.
            jump_m: a pose that is further off by this much than it can have driven is a jump.
            settle_s: for how long poses have to agree after a jump.
        """
        if not all(map(math.isfinite, (pose.x_m, pose.y_m, pose.theta_rad))):
            return
        own = self.own
        if own is not None:
            reach_m = max_mps * max(0.0, at_s - own.at_s) + jump_m
            if math.hypot(pose.x_m - own.pose.x_m, pose.y_m - own.pose.y_m) > reach_m:
                self.unsettled_until_s = at_s + settle_s
        self.own = OwnPose(pose, at_s)

    def heard(self, body: RobotPose, speaker: str, at_s: float, now_s: float, jump_m: float, settle_s: float) -> None:
        """Take note of another robot's pose.

        What a robot's own agent says counts before what others say of it, while it is no older than `settle_s`.

        Args:
            body: the pose; one with a number that is not finite is not used.
            speaker: the agent that says it.
            at_s: when the robot was there.
            now_s: mission time.
            jump_m: as for `moved`.
            settle_s: for how long it may be at either place after a jump.
        """
        numbers = (body.x_m, body.y_m, body.theta_rad, body.radius_m, body.max_mps, body.ahead_m, at_s)
        if body.robot == self._agent or not all(map(math.isfinite, numbers)):
            return
        seen = Seen(body, at_s, speaker)
        former = self.robots.get(body.robot)
        if former is not None:
            own_first = seen.own_word and not former.own_word and now_s - at_s <= settle_s
            others_last = former.own_word and not seen.own_word and now_s - former.at_s <= settle_s
            if others_last or (at_s < former.at_s and not own_first):
                return
            way_m = math.hypot(body.x_m - former.body.x_m, body.y_m - former.body.y_m)
            if way_m > body.max_mps * abs(at_s - former.at_s) + jump_m:
                self._haunt(body.robot, former, now_s, now_s + settle_s)
            del self.robots[body.robot]
        elif len(self.robots) >= MOST_ROBOTS and not self._make_room(seen, now_s):
            self.crowded_until_s = now_s + CROWDED_S
            return
        self.robots[body.robot] = seen

    def _haunt(self, robot: str, former: Seen, now_s: float, until_s: float) -> None:
        self.ghosts = {name: it for name, it in self.ghosts.items() if now_s < it[1] and name != robot}
        if len(self.ghosts) >= MOST_ROBOTS:
            del self.ghosts[next(iter(self.ghosts))]
        self.ghosts[robot] = (former, until_s)

    def _make_room(self, seen: Seen, now_s: float) -> bool:
        """Forget a robot for one that was not heard of before; return whether there is room."""
        silent = min(self.robots, key=lambda name: self.robots[name].at_s)
        if now_s - self.robots[silent].at_s > FORGET_S:
            del self.robots[silent]
            return True
        mine = [name for name, it in self.robots.items() if it.speaker == seen.speaker]
        others = [name for name, it in self.robots.items() if not it.own_word] if seen.own_word else []
        if oldest := [*mine, *others][:1]:
            del self.robots[oldest[0]]
        return bool(oldest)

    def all(self, now_s: float) -> Iterator[Seen]:
        """Yield where robots are or may be."""
        yield from self.robots.values()
        for name, (seen, until_s) in list(self.ghosts.items()):
            if now_s < until_s:
                # It stands there: what moves is at the new place.
                yield msgspec.structs.replace(
                    seen, body=msgspec.structs.replace(seen.body, max_mps=0.0, yields=False), at_s=now_s
                )
            else:
                del self.ghosts[name]


def driven(pose: Pose, twist: Twist, time_s: float) -> Pose:
    """Return where a robot is after driving for a time, from a pose."""
    turn_rad = twist.omega_radps * time_s
    half_rad = 0.5 * turn_rad
    way_m = twist.v_mps * time_s * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    heading_rad = pose.theta_rad + half_rad
    return Pose(
        pose.x_m + way_m * math.cos(heading_rad), pose.y_m + way_m * math.sin(heading_rad), pose.theta_rad + turn_rad
    )


class Limits(msgspec.Struct, frozen=True):
    """What this robot is like, and how close it may come.

    Attributes:
        radius_m: its radius.
        ahead_m: how far ahead of its centre the point lies that is kept clear.
        gap_m: the least gap.
        stranger_gap_m: the least gap to a robot that does not move out of the way.
        close_per_s: at most this share of a gap is closed each second.
        max_mps: its speed.
        max_radps: its turning rate.
    """

    radius_m: float
    ahead_m: float
    gap_m: float
    stranger_gap_m: float
    close_per_s: float
    max_mps: float
    max_radps: float


class Constraint(msgspec.Struct, frozen=True):
    """The velocities that one thing near the robot allows.

    Attributes:
        plane: the velocities.
        name: the thing, for people.
        gives: if no velocity suits all, how much this one gives way, compared with the others.
    """

    plane: HalfPlane
    name: str
    gives: float


def rate(gap_m: float, limits: Limits) -> float:
    """Return how fast a gap may close, in m/s; below 0: it has to grow, as it is smaller than it should be."""
    return gap_m * limits.close_per_s if gap_m > 0.0 else max(gap_m * OPEN_PER_S, -2.0 * limits.max_mps)


def gives_at(gives: float, gap_m: float, room_m: float) -> float:
    """Return how much a thing gives way that is nearer than it should be.

    Args:
        gives: how much it gives way at its full distance.
        gap_m: how much nearer it is than it should be, below 0; above 0 it is not.
        room_m: how much nearer it may be before the two touch.
    """
    return gives * min(1.0, max(LEAST_GIVES, 1.0 + gap_m / room_m if room_m > 0.0 else LEAST_GIVES))


def around_robot(x_m: float, y_m: float, limits: Limits, seen: Seen, age_s: float, slack_m: float) -> Constraint | None:
    """Return what another robot allows; None: it may be here, and no velocity is known to be safe.

    Args:
        x_m: the point that is kept clear.
        y_m: the point that is kept clear.
        limits: what this robot is like.
        seen: the other robot.
        age_s: how old its pose is.
        slack_m: how far this robot may be from where it is taken to be.
    """
    body = seen.body
    yields = body.yields and seen.own_word
    point_m = body.ahead_m if yields else 0.0
    from_x_m = x_m - body.x_m - point_m * math.cos(body.theta_rad)
    from_y_m = y_m - body.y_m - point_m * math.sin(body.theta_rad)
    apart_m = math.hypot(from_x_m, from_y_m)
    least_m = limits.gap_m if yields else limits.stranger_gap_m
    clear_m = limits.radius_m + limits.ahead_m + body.radius_m + point_m + least_m
    gap_m = apart_m - clear_m - slack_m - body.max_mps * age_s
    if apart_m < 1e-9:
        return None
    nx, ny = from_x_m / apart_m, from_y_m / apart_m
    c = -0.5 * rate(gap_m, limits) if yields else body.max_mps - rate(gap_m, limits)
    gives = gives_at(YIELDER_GIVES if yields else STRANGER_GIVES, gap_m, limits.ahead_m + point_m + least_m)
    return Constraint(HalfPlane(nx, ny, min(c, limits.max_mps)), body.robot, gives)


def inside(x_m: float, y_m: float, limits: Limits, area: Area, slack_m: float) -> Iterator[Constraint]:
    """Yield what the sides of an area allow to a robot that must stay in it; arguments as for `around_robot`."""
    clear_m = limits.radius_m + limits.ahead_m + limits.gap_m + slack_m
    for nx, ny, gap_m in (
        (1.0, 0.0, x_m - area.x_min_m),
        (-1.0, 0.0, area.x_max_m - x_m),
        (0.0, 1.0, y_m - area.y_min_m),
        (0.0, -1.0, area.y_max_m - y_m),
    ):
        yield _wall(nx, ny, gap_m - clear_m, limits, "the edge of its area")


def outside(x_m: float, y_m: float, limits: Limits, area: Area, slack_m: float) -> Constraint:
    """Return what an area allows to a robot that must stay out of it; arguments as for `around_robot`."""
    near_x_m = min(max(x_m, area.x_min_m), area.x_max_m)
    near_y_m = min(max(y_m, area.y_min_m), area.y_max_m)
    apart_m = math.hypot(x_m - near_x_m, y_m - near_y_m)
    clear_m = limits.radius_m + limits.ahead_m + limits.gap_m + slack_m
    if apart_m > 1e-9:
        nx, ny = (x_m - near_x_m) / apart_m, (y_m - near_y_m) / apart_m
    else:  # it is inside: out by the nearest side
        apart_m, nx, ny = max(
            (area.x_min_m - x_m, -1.0, 0.0),
            (x_m - area.x_max_m, 1.0, 0.0),
            (area.y_min_m - y_m, 0.0, -1.0),
            (y_m - area.y_max_m, 0.0, 1.0),
        )
    return _wall(nx, ny, apart_m - clear_m, limits, "a no-go area")


def _wall(nx: float, ny: float, gap_m: float, limits: Limits, name: str) -> Constraint:
    gives = gives_at(WALL_GIVES, gap_m, limits.ahead_m + limits.gap_m)
    return Constraint(HalfPlane(nx, ny, min(-rate(gap_m, limits), limits.max_mps)), name, gives)


def reachable(theta_rad: float, limits: Limits) -> list[HalfPlane]:
    """Return the velocities of the point ahead that the wheels can make: at full speed there is none left to turn."""
    cos, sin = math.cos(theta_rad), math.sin(theta_rad)
    planes = []
    for forward in (1.0, -1.0):
        for left in (1.0, -1.0):
            along, across = -forward / limits.max_mps, -left / (limits.max_radps * limits.ahead_m)
            nx, ny = along * cos - across * sin, along * sin + across * cos
            length = math.hypot(nx, ny)
            planes.append(HalfPlane(nx / length, ny / length, -1.0 / length))
    return planes


def nearest_safe(
    pose: Pose, wanted: Twist, limits: Limits, around: Sequence[Constraint], turn_rad: float = 0.0
) -> tuple[Twist, str]:
    """Return the safe command that is nearest to a wanted one, and the name of what changes it most; empty: nothing.

    If no command is safe, it is the one that is the least unsafe.

    Args:
        pose: where the robot is.
        wanted: the command, within the robot's limits.
        limits: what the robot is like.
        around: what the things around it allow.
        turn_rad: by how much the wanted velocity is turned, counter-clockwise, if something has to change.
    """
    cos, sin = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    across_mps = limits.ahead_m * wanted.omega_radps
    x_mps, y_mps = wanted.v_mps * cos - across_mps * sin, wanted.v_mps * sin + across_mps * cos
    worst, name = 1e-9, ""
    most_mps = max(limits.max_mps, limits.max_radps * limits.ahead_m)
    around = [it for it in around if it.plane.c > -most_mps]  # all that the wheels can do is in the others
    for it in around:
        short = it.plane.c - it.plane.nx * x_mps - it.plane.ny * y_mps
        if short > worst:
            worst, name = short, it.name
    if not name:
        return wanted, ""
    if turn_rad:
        turn_cos, turn_sin = math.cos(turn_rad), math.sin(turn_rad)
        x_mps, y_mps = x_mps * turn_cos - y_mps * turn_sin, x_mps * turn_sin + y_mps * turn_cos
    planes, gives = [it.plane for it in around], [it.gives for it in around]
    x_mps, y_mps = least_bad(x_mps, y_mps, reachable(pose.theta_rad, limits), planes, gives)
    return Twist(x_mps * cos + y_mps * sin, (y_mps * cos - x_mps * sin) / limits.ahead_m), name


class Barrier(Filter):
    """Keep a robot clear of other robots, of walls and of no-go areas, whatever its task commands (`barrier`).

    It needs a `pose` device on the same agent, and a drive that turns on the spot. See docs/filters.md for what it does
    if a pose is missing, old or wrong.
    """

    type = "motors"

    @dataclass
    class Settings:
        """What the robot is like, and how close it may come to other things.

        Attributes:
            radius_m: the radius of a circle around the robot's centre that holds all of it.
            max_mps: the robot's speed. Faster commands are slowed down.
            max_radps: the robot's turning rate, on the spot. Faster commands are slowed down.
            gap_m: the least gap to everything but strangers.
            stranger_gap_m: the least gap to a robot that does not move out of the way: it has no barrier, or is silent.
            ahead_m: how far ahead of the axle the point lies that the filter moves. A larger one makes wider, smoother
                turns, and keeps the robot that much further from things.
            close_per_s: at most this share of a gap is closed each second. A larger one lets the robot drive faster
                near things, and needs fresher poses.
            area: the area that the robot stays in; None: it has no edge.
            keep_out: areas that the robot stays out of.
            pose: the device that has the robot's pose; empty: any `pose` device of its agent.
            slow_after_mission_s: a pose older than this makes the robot slow down.
            hold_after_mission_s: its own pose older than this stops the robot.
            lost_after_mission_s: a robot that nothing was heard of for this long is taken to stand where it was heard
                last; None: it may be ever further from there.
            jump_m: a pose that is this much further off than the robot can have driven is a jump.
            tell_hz: how often the robot tells its neighbours its pose.
            check_hz: how often the newest command is checked against what has moved since.
            keep_right: whether robots that block each other give way to the right.
        """

        radius_m: Positive
        max_mps: Positive
        max_radps: Positive
        gap_m: NotNegative = 0.02
        stranger_gap_m: NotNegative = 0.2
        ahead_m: Positive = 0.05
        close_per_s: Positive = 1.0
        area: Area | None = None
        keep_out: tuple[Area, ...] = ()
        pose: str = ""
        slow_after_mission_s: Positive = 0.3
        hold_after_mission_s: Positive = 1.0
        lost_after_mission_s: Positive | None = None
        jump_m: Positive = 0.1
        tell_hz: Positive = 10.0
        check_hz: Positive = 20.0
        keep_right: bool = True

        def __post_init__(self) -> None:
            if self.slow_after_mission_s >= self.hold_after_mission_s:
                raise ValueError(
                    f"slow_after_mission_s = {self.slow_after_mission_s:g} must be below"
                    f" hold_after_mission_s = {self.hold_after_mission_s:g}"
                )
            need_m = 2.0 * (self.radius_m + self.ahead_m + self.gap_m)
            area = self.area
            if area is not None and min(area.x_max_m - area.x_min_m, area.y_max_m - area.y_min_m) <= need_m:
                raise ValueError(f"area is too small: the robot needs more than {need_m:g} m in it each way")

    settings: Settings

    @property
    def check_hz(self) -> float:
        """How often the newest command passes again."""
        return self.settings.check_hz

    def open(self) -> None:
        """Begin to hear poses."""
        # Other robots are where they were, also if the motors have failed and are restarted.
        self.surroundings = self.context.kept.setdefault("surroundings", Surroundings(self.context.agent))
        self._last = Twist(0.0, 0.0)
        self._stuck_since_s = math.inf
        self._aside_until_s = -math.inf
        self.on_settings()
        self.context.subscribe(SYSTEM, Pose, self._own_pose)
        self.context.subscribe(SYSTEM, RobotPose, self._other_pose)

    def on_settings(self) -> None:
        """Use the new settings."""
        it = self.settings
        self._pace = Pace(it.tell_hz)
        self._limits = Limits(
            *(it.radius_m, it.ahead_m, it.gap_m, it.stranger_gap_m, it.close_per_s, it.max_mps, it.max_radps)
        )

    def on_hold(self) -> None:
        """The robot stands."""
        self._last = Twist(0.0, 0.0)
        self._stuck_since_s = math.inf

    def _own_pose(self, packet: Packet) -> None:
        agent, _, device = packet.source.rpartition("/")
        if agent_of(agent) != self.context.agent or self.settings.pose not in ("", device):
            return
        it, pose = self.settings, packet.body
        self.surroundings.moved(pose, packet.stamp_s, it.max_mps, it.jump_m, it.slow_after_mission_s)
        now_s, own = self.context.now(), self.surroundings.own
        if own is not None and own.pose is pose and self._pace.due(now_s):
            body = RobotPose(
                *(self.context.agent, pose.x_m, pose.y_m, pose.theta_rad, it.radius_m, it.max_mps),
                *(max(0.0, now_s - own.at_s), it.ahead_m, True),
            )
            self.context.publish(SYSTEM, body, NEIGHBOURS)

    def _other_pose(self, packet: Packet) -> None:
        body, it = packet.body, self.settings
        if isinstance(body, RobotPose):
            at_s = self.context.published_s(packet) - body.age_s
            self.surroundings.heard(
                body, agent_of(packet.source), at_s, self.context.now(), it.jump_m, it.slow_after_mission_s
            )

    def apply(self, command: Twist, ttl_s: float, source: str) -> Any:
        """Return the safe command that is nearest to `command`."""
        now_s, it = self.context.now(), self.settings
        found = self._safe(command, now_s)
        if isinstance(found, Held):
            self._last = Twist(0.0, 0.0)
            return found
        safe, why = found
        self._last = safe
        wants = abs(command.v_mps) > WANTS * it.max_mps
        if not (wants and why and abs(safe.v_mps) < SLOW * it.max_mps):
            self._stuck_since_s = math.inf
        elif self._stuck_since_s == math.inf:
            self._stuck_since_s = now_s
        elif it.keep_right and now_s - self._stuck_since_s >= STUCK_S:
            self._stuck_since_s, self._aside_until_s = math.inf, now_s + ASIDE_S
        return command if safe == command else Changed(safe, why or "too fast")

    def _safe(self, command: Twist, now_s: float) -> tuple[Twist, str] | Held:
        """Return the safe command that is nearest to one, and why it is another one; or why there is none."""
        it, limits, own = self.settings, self._limits, self.surroundings.own
        if own is None:
            return Held("it does not know its own pose yet")
        age_s = max(0.0, now_s - own.at_s)
        if age_s >= it.hold_after_mission_s:
            return Held("its own pose is too old")
        if now_s < self.surroundings.unsettled_until_s:
            return Held("its own pose has jumped")
        if now_s < self.surroundings.crowded_until_s:
            return Held(f"there are more than {MOST_ROBOTS} other robots, and it cannot keep clear of all")
        wanted, why = _within(command, limits), ""
        if age_s > it.slow_after_mission_s:
            share = (it.hold_after_mission_s - age_s) / (it.hold_after_mission_s - it.slow_after_mission_s)
            wanted, why = Twist(wanted.v_mps * share, wanted.omega_radps * share), "its own pose is old"
        pose = driven(own.pose, self._last, age_s)
        slack_m = 0.5 * it.max_mps * age_s  # its last command may have come at any moment since
        x_m = pose.x_m + limits.ahead_m * math.cos(pose.theta_rad)
        y_m = pose.y_m + limits.ahead_m * math.sin(pose.theta_rad)
        around: list[Constraint] = []
        for seen in self.surroundings.all(now_s):
            constraint = self._robot(pose, x_m, y_m, seen, now_s, slack_m)
            if isinstance(constraint, Held):
                return constraint
            around.append(constraint)
        if it.area is not None:
            around.extend(inside(x_m, y_m, limits, it.area, slack_m))
        around.extend(outside(x_m, y_m, limits, area, slack_m) for area in it.keep_out)
        turn_rad = ASIDE_RAD if now_s < self._aside_until_s else 0.0
        safe, name = nearest_safe(pose, wanted, limits, around, turn_rad)
        return safe, f"keeps clear of {name}" if name else why

    def _robot(self, pose: Pose, x_m: float, y_m: float, seen: Seen, now_s: float, slack_m: float) -> Constraint | Held:
        it, limits, body = self.settings, self._limits, seen.body
        name, age_s = body.robot, max(0.0, now_s - seen.at_s)
        if math.hypot(pose.x_m - body.x_m, pose.y_m - body.y_m) < SAME_PLACE * (limits.radius_m + body.radius_m):
            return Held(f"its own pose and that of {name} are in one place")
        if age_s <= it.slow_after_mission_s:
            constraint = around_robot(x_m, y_m, limits, seen, age_s, slack_m)
        else:
            lost = it.lost_after_mission_s is not None and age_s >= it.lost_after_mission_s
            # A lost one stands where it was heard last; a silent one may have gone anywhere since.
            stranger = msgspec.structs.replace(body, yields=False, max_mps=0.0 if lost else body.max_mps)
            constraint = around_robot(x_m, y_m, limits, Seen(stranger, seen.at_s, ""), age_s, slack_m)
            if age_s >= it.hold_after_mission_s and not lost and constraint is not None and constraint.plane.c > 0.0:
                return Held(f"{name} is silent, and may be near")
        return constraint if constraint is not None else Held(f"its own pose and that of {name} are in one place")


def _within(command: Twist, limits: Limits) -> Twist:
    """Return a command that the wheels can carry out, on the same path."""
    slower = within(command, limits.max_mps, limits.max_radps)
    share = abs(slower.v_mps) / limits.max_mps + abs(slower.omega_radps) / limits.max_radps
    return slower if share <= 1.0 else Twist(slower.v_mps / share, slower.omega_radps / share)
