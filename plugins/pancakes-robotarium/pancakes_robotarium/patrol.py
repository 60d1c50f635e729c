"""`Patrol`: drive from place to place, over and over (`robotarium.Patrol`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from pancakes import CTRL, SYSTEM, Packet, Positive, Task, agent_of, on
from pancakes.devices import Pose, Twist

NEARER_M: Final = 0.05
"""A robot that has come so much nearer to a waypoint gets on."""
LOOK_M: Final = 0.3
"""A robot beside its way heads for the place on it that is so far ahead."""


def aim_m(
    place: tuple[float, float], start: tuple[float, float], goal: tuple[float, float], look_m: float = LOOK_M
) -> tuple[float, float]:
    """Return where a robot should head to drive from one place to another on a straight way, wherever it is now.

    Args:
        place: where it is.
        start: where the way begins.
        goal: where it ends.
        look_m: how far ahead on the way it aims.
    """
    length_m = math.dist(start, goal)
    if length_m <= 0.0:
        return goal
    along_x, along_y = (goal[0] - start[0]) / length_m, (goal[1] - start[1]) / length_m
    done_m = (place[0] - start[0]) * along_x + (place[1] - start[1]) * along_y
    aim = min(max(done_m, 0.0) + look_m, length_m)
    return start[0] + aim * along_x, start[1] + aim * along_y


class Patrol(Task):
    """Drive from waypoint to waypoint, in turn, over and over; a robot that takes it up first gets on the way.

    It has no eye for obstacles: a barrier is below it (docs/filters.md). A waypoint that it comes no nearer to is left
    out this time. Events: `waypoint` for each that is reached, `waypoint_skipped`, and `round_done` after the last one.
    """

    requires = ("pose", "motors")
    offers = ("next",)

    @dataclass
    class Settings:
        """Where it drives, and how.

        Attributes:
            waypoints_m: the places, (x, y) in the frame of the world.
            speed_mps: how fast it drives.
            turn_per_s: how fast it turns, for each radian that it still has to turn.
            near_m: a robot that is so near to a waypoint has reached it.
            patience_s: if it comes no nearer to a waypoint for so long, it goes to the next one.
        """

        waypoints_m: list[tuple[float, float]] = field(kw_only=True)
        speed_mps: Positive = 0.1
        turn_per_s: Positive = 2.0
        near_m: Positive = 0.05
        patience_s: Positive = 30.0

        def __post_init__(self) -> None:
            if len(set(self.waypoints_m)) < 2:
                raise ValueError("a patrol needs two waypoints or more, in different places")

    @dataclass
    class State:
        """The state that migrates with the task.

        Attributes:
            next: the number of the waypoint that it drives to, from 0.
            rounds: how often it has been at all of them, or has left them out.
        """

        next: int = 0
        rounds: int = 0

    settings: Settings
    state: State

    def on_start(self) -> None:
        self.on_settings()

    def on_settings(self) -> None:
        """Drive on to the waypoint of the same number, if there is one."""
        self.state.next %= len(self.settings.waypoints_m)
        self._set_out()

    def _set_out(self) -> None:
        self._nearest_m, self._nearer_s = math.inf, self.now()

    @on(SYSTEM, Pose, queue="latest")
    def steer(self, packet: Packet) -> None:
        """Drive on from the robot's present pose."""
        if agent_of(packet.source) != self.agent:
            return
        pose, it = packet.body, self.settings
        goal = it.waypoints_m[self.state.next]
        left_m = math.dist((pose.x_m, pose.y_m), goal)
        if left_m < self._nearest_m - NEARER_M:
            self._nearest_m, self._nearer_s = left_m, self.now()
        if left_m <= it.near_m or self.now() > self._nearer_s + it.patience_s:
            self._next("waypoint" if left_m <= it.near_m else "waypoint_skipped")
            goal = it.waypoints_m[self.state.next]
        aim = aim_m((pose.x_m, pose.y_m), it.waypoints_m[self.state.next - 1], goal)
        turn_rad = math.remainder(math.atan2(aim[1] - pose.y_m, aim[0] - pose.x_m) - pose.theta_rad, math.tau)
        self.publish(CTRL, Twist(it.speed_mps * max(0.0, math.cos(turn_rad)), it.turn_per_s * turn_rad))

    def _next(self, kind: str) -> None:
        self.event(kind, number=self.state.next)
        self.state.next = (self.state.next + 1) % len(self.settings.waypoints_m)
        self._set_out()
        if self.state.next == 0:
            self.state.rounds += 1
            self.event("round_done", count=self.state.rounds)
