"""`ScanTarget`: go round the place where motion was last sensed (paper §4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pancakes import CTRL, SYSTEM, Packet, Positive, agent_of, on
from pancakes.devices import Pose, Twist
from pancakes_encirclement.circle import Point, curvature, gap_behind, spaced_speed
from pancakes_encirclement.driving import DrivingTask
from pancakes_encirclement.laps import Laps, on_circle
from pancakes_encirclement.packets import MotionDetected, NeighbourPose

NEW_CENTRE_M = 0.10
"""A report makes a new centre only if it is farther than this from the present one."""
FRESH_S = 3.0
"""A neighbour's pose older than this says nothing about where it is now."""


class ScanTarget(DrivingTask):
    """Drive on a circle, clockwise, around the place of the last report of motion.

    It does not move until the first report. It shares the circle evenly with neighbours that are on it too and send
    their poses. Events: `new_centre`, `on_circle` (once on each host), `revolution`.
    """

    offers = ("centre_m",)

    @dataclass
    class Settings(DrivingTask.Settings):
        """The circle, and how to drive on it.

        Attributes:
            radius_m: radius of the circle.
            speed_mps: speed on it.
            alpha_per_m: how strongly the robot is drawn to it.
            centre_m: the first centre, before any report; none: it waits for one.
        """

        radius_m: Positive = 0.55
        speed_mps: Positive = 0.1
        alpha_per_m: Positive = 4.0
        centre_m: tuple[float, float] | None = None

    @dataclass
    class State:
        """The state that migrates with the task.

        Attributes:
            centre_m: the place it goes round.
            revolutions: how often it went round, summed over all hosts.
        """

        centre_m: tuple[float, float] | None = None
        revolutions: float = 0.0

    settings: Settings
    state: State

    def on_start(self) -> None:
        super().on_start()
        if self.state.centre_m is None:
            self.state.centre_m = self.settings.centre_m
        self._laps = Laps(self.state.revolutions)
        self._arrived = False
        self._neighbours: dict[str, tuple[float, Point]] = {}

    @on(SYSTEM, MotionDetected)
    def target_seen(self, packet: Packet) -> None:
        """Take the place of a report as the new centre, if it is a new place."""
        place = (packet.body.x_m, packet.body.y_m)
        if self.state.centre_m is not None and math.dist(place, self.state.centre_m) <= NEW_CENTRE_M:
            return
        self.state.centre_m = place
        self._laps.recentred()
        self.event("new_centre", x_m=place[0], y_m=place[1], told_by=agent_of(packet.source))

    @on(SYSTEM, NeighbourPose)
    def neighbour_seen(self, packet: Packet) -> None:
        """Remember where a neighbour is."""
        self._neighbours[agent_of(packet.source)] = (self.now(), (packet.body.x_m, packet.body.y_m))

    @on(SYSTEM, Pose, queue="latest")
    def steer(self, packet: Packet) -> None:
        """Drive on from the robot's present pose."""
        if not self.is_own(packet):
            return
        pose: Pose = packet.body
        self.steering.moved(pose)
        centre = self.state.centre_m
        if centre is None:
            return
        position = (pose.x_m, pose.y_m)
        there = on_circle(position, centre, self.settings.radius_m)
        if there and not self._arrived:
            self._arrived = True
            self.event("on_circle", radius_m=math.dist(position, centre))
        if self._arrived:
            self._count(position, centre)
        settings = self.settings
        kappa = curvature(position, pose.theta_rad, centre, settings.radius_m, settings.alpha_per_m)
        speed = self._speed(position, centre) if there else settings.speed_mps
        self.publish(CTRL, self.steering.follow(Twist(speed, speed * kappa), self.now()))

    def _count(self, position: Point, centre: Point) -> None:
        whole = self._laps.passed(position, centre)
        self.state.revolutions = self._laps.revolutions
        if whole:
            self.event("revolution", count=math.floor(self.state.revolutions))

    def _speed(self, position: Point, centre: Point) -> float:
        """Return the speed that keeps the robots on the circle apart.

        Never backwards: the curvature law leads to the circle forwards, and away from it backwards.
        """
        radius = self.settings.radius_m
        oldest_s = self.now() - FRESH_S
        others = [
            place
            for seen_s, place in self._neighbours.values()
            if seen_s >= oldest_s and on_circle(place, centre, radius)
        ]
        gap = gap_behind(position, centre, others)
        return max(0.0, spaced_speed(gap, len(others) + 1, radius, self.settings.speed_mps))
