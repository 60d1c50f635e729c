"""Charge a robot: the task `energy.charge`. It asks for a dock, drives there, and leaves once it is charged."""

from __future__ import annotations

import math
from typing import Final

from pancakes.control import Reply, Stop
from pancakes.devices import Battery, Dock, DockBid, DockState, Pose, Reserve, Twist
from pancakes.energy.docking import ChargeSettings, Docking, drive_to
from pancakes.packet import CTRL, NEIGHBOURS, SYSCTRL, SYSTEM, Packet, agent_of
from pancakes.task import Task, Tick, every, on

UNKNOWN_S: Final = 0.0
"""A robot that has no reserve bids this: it may be in need."""
PATIENCE_S: Final = 5.0
"""How long it waits for the first reading of its reserve."""
POSE_OLD_S: Final = 2.0
"""With an older pose the robot stands: it would drive on without knowing where it is."""
END_AGAIN_S: Final = 10.0
"""If it runs that long after it has asked for its end, it asks again: it was being migrated, for example."""
LATER: Final = ("pending", "busy")
"""Codes of refusals that say nothing of the task that should follow: this one ends later."""


class Charge(Task):
    """Have the robot charged, then stop, and start another task in its place if the settings name one.

    Start it by a rule: `then = "Charge"`, `otherwise = "Charge"`. The lowest reserve gets a dock first, ties by name.
    Events: `dock_chosen` with all bids, `docked`, `charged`, `left_dock`, and `dock_lost` with the reason.
    """

    requires = ("battery", "pose", "motors", "dock")

    Settings = ChargeSettings
    settings: ChargeSettings

    def on_start(self) -> None:
        self._docking = Docking(self.agent, self.settings)
        self._pose: Pose | None = None
        self._placed_s = 0.0
        self._level: float | None = None
        self._reserve: Reserve | None = None
        self._tried: int | None = None  # how many followers could not start, once it ends
        self._patient_until_s = self.now() + PATIENCE_S
        self._end_again_s = 0.0

    def on_settings(self) -> None:
        """Ask again under the new settings; the dock that it holds is its own at once."""
        self._docking = Docking(self.agent, self.settings)

    @on(SYSTEM, Pose, queue="latest")
    def moved(self, packet: Packet) -> None:
        """Take the robot's pose."""
        if agent_of(packet.source) == self.agent:
            self._pose, self._placed_s = packet.body, self.now()

    @on(SYSTEM, Battery, queue="latest")
    def measured(self, packet: Packet) -> None:
        """Take a reading of the battery."""
        if agent_of(packet.source) == self.agent:
            self._level = packet.body.level

    @on(SYSTEM, Reserve, queue="latest")
    def reserve_told(self, packet: Packet) -> None:
        """Take the robot's reserve."""
        if agent_of(packet.source) == self.agent:
            self._reserve = packet.body

    @on(SYSTEM, DockState)
    def dock_told(self, packet: Packet) -> None:
        """Take what a dock does."""
        self._docking.dock_told(packet.source, packet.body, self.now())

    @on(SYSTEM, DockBid)
    def bid_told(self, packet: Packet) -> None:
        """Take the bid of another robot."""
        robot = agent_of(packet.source)
        if robot != self.agent:
            self._docking.bid_told(robot, packet.body, self.now())

    @every(hz=2)
    def bid(self, tick: Tick) -> None:
        """Tell the others that this robot wants a dock."""
        if self._docking.phase == "asks" and self._pose is not None and self._is_ready():
            self.publish(SYSTEM, self._bid(self._pose), to=NEIGHBOURS)

    @every(hz=5)
    def act(self, tick: Tick) -> None:
        """Decide, and command dock and wheels."""
        pose, level = self._pose, self._level
        if self._tried is not None:
            if self.now() >= self._end_again_s:
                self._end(self._tried)
            return
        if pose is None or level is None or not self._is_ready():
            return
        step = self._docking.decide(self.now(), pose, level, self._bid(pose))
        if step.news:
            bids = {"bids": dict(step.bids)} if step.bids else {}
            self.event(step.news, dock=agent_of(step.dock), level=level, reason=step.why, **bids)
        if step.phase == "done":
            self._end(0)  # its actuators are held as it lets them go
            return
        if step.dock:
            self.publish(CTRL, Dock(step.dock))
        it, goal = self.settings, step.goal
        knows = self.now() - self._placed_s <= POSE_OLD_S
        stand = Twist(0.0, 0.0)
        self.publish(CTRL, drive_to(pose, goal, it.speed_mps, it.turn_radps) if goal is not None and knows else stand)

    def _is_ready(self) -> bool:
        """Return whether it knows its reserve, or need not wait for it any longer."""
        return self._reserve is not None or self.now() >= self._patient_until_s

    def _bid(self, pose: Pose) -> DockBid:
        reserve = self._reserve
        if reserve is None:
            return self._docking.bid(self.now(), pose, UNKNOWN_S, ())
        # A task of a user's own may tell NaN.
        seconds = reserve.seconds if math.isfinite(reserve.seconds) else UNKNOWN_S
        return self._docking.bid(self.now(), pose, seconds, reserve.bad_docks)

    def _end(self, tried: int) -> None:
        """End, and have the first task follow that can start here, after `tried` that could not."""
        self._tried, self._end_again_s = tried, self.now() + END_AGAIN_S
        followers = self.settings.then[tried:]
        self.publish(SYSCTRL, Stop(self.name, then=followers[0] if followers else ""))

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, reply: Reply) -> None:
        """The task that should follow cannot start here: it is on another robot, for example."""
        refusal = reply.refusal
        if self._tried is None or refusal is None or refusal.code in LATER:
            return
        if self._tried < len(self.settings.then):
            self._end(self._tried + 1)
