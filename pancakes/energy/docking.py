"""Decide which robot gets which dock, and what a robot does to be charged. Pure: readings and times in, steps out.

There is no leader: each robot that asks hears the bids of the others, and gives the docks out in its head by the same
rule (`allocate`). It commands a dock only if the rule gives it to itself. If two robots heard different bids, both may
command one dock; the dock obeys the first, as any actuator, and the other robot asks again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from pancakes.devices import DockBid, DockState, Pose, Twist
from pancakes.settings import Positive, Share

WINDOW_S: Final = 1.5
"""How long a robot listens to the bids of others before it takes a dock."""
FRESH_S: Final = 3.0
"""A bid, or the state of a dock, that is older does not count."""
CONFIRM_S: Final = 3.0
"""A dock that is commanded must say so in this time."""
STUCK_S: Final = 30.0
"""A robot that comes no nearer to its goal in this time cannot get there."""
CONTACT_S: Final = 10.0
"""How long a robot waits at a dock for the dock to report that it charges."""
NEARER_M: Final = 0.05
MOST_HEARD: Final = 256
"""At most this many docks, and bids of others, count at a time."""
AVOID_S: Final = 60.0
"""How long a dock that refused the robot, or could not be reached, is left out."""

Phase = Literal["asks", "goes", "charges", "leaves", "done"]


def allocate(bids: Mapping[str, DockBid], docks: Mapping[str, DockState]) -> dict[str, str]:
    """Give docks that are free to robots: the lowest reserve first, ties by name; each gets the nearest that is left.

    Args:
        bids: the bid of each robot that asks, by its agent.
        docks: what each dock does, by its address.

    Returns:
        The address of the dock that each robot gets; robots that get none are left out.
    """
    free = {address: dock for address, dock in docks.items() if dock.state == "free"}
    given: dict[str, str] = {}
    for robot, bid in sorted(bids.items(), key=lambda item: (item[1].seconds, item[0])):
        wanted = [it for it in free if it not in bid.avoids]
        if wanted:
            place = (bid.x_m, bid.y_m)
            given[robot] = min(wanted, key=lambda it: (math.dist(place, (free[it].x_m, free[it].y_m)), it))
            del free[given[robot]]
    return given


@dataclass
class ChargeSettings:
    """When a robot is charged, and how it drives.

    Attributes:
        full: it leaves its dock at this level of the battery.
        enough: it leaves at this level already if another robot asks and no dock is free.
        then: tasks to start once the robot is charged: the first of them that is stopped on this agent.
        home_m: where it drives to once it is charged, so that the dock is free, (x, y); None: it stays where it is.
        near_m: the distance at which a robot counts as being at a place. It must be less than the reach of a dock.
        clear_m: the distance at which it lets the dock go.
        speed_mps: how fast it drives.
        turn_radps: how fast it turns.
    """

    full: Share = 0.95
    enough: Share = 0.6
    then: list[str] = field(default_factory=list)
    home_m: tuple[float, float] | None = None
    near_m: Positive = 0.03
    clear_m: Positive = 0.3
    speed_mps: Positive = 0.1
    turn_radps: Positive = 0.5

    def __post_init__(self) -> None:
        if self.enough > self.full:
            raise ValueError(f"enough = {self.enough:g} is more than full = {self.full:g}")


class Step(NamedTuple):
    """What the robot does now.

    Attributes:
        phase: how far it is.
        dock: the address of the dock that it commands; empty: none.
        goal: where it drives to; None: it stands.
        news: what has just happened, as the kind of an event; empty: nothing.
        why: why, for people.
        bids: the reserve that each robot bid for a dock, if one has just been chosen.
    """

    phase: Phase
    dock: str = ""
    goal: tuple[float, float] | None = None
    news: str = ""
    why: str = ""
    bids: Mapping[str, float] = {}


class Docking:
    """What one robot does, from asking for a dock until it is charged and has left.

    Args:
        robot: its agent.
        settings: when it is charged.
    """

    def __init__(self, robot: str, settings: ChargeSettings) -> None:
        self._robot = robot
        self._settings = settings
        self._docks: dict[str, tuple[float, DockState]] = {}
        self._bids: dict[str, tuple[float, DockBid]] = {}
        self._avoided: dict[str, float] = {}
        self._asks_since_s: float | None = None
        self._dock = ""
        self._left = (0.0, 0.0)
        self._contact_s = 0.0
        self._mine_s = 0.0
        self._nearest_m = math.inf
        self._nearer_s = 0.0
        self.phase: Phase = "asks"

    def dock_told(self, address: str, state: DockState, now_s: float) -> None:
        """Take what a dock does."""
        if math.isfinite(state.x_m) and math.isfinite(state.y_m):
            self._docks = {it: told for it, told in self._docks.items() if now_s <= told[0] + FRESH_S}
            if address in self._docks or len(self._docks) < MOST_HEARD:
                self._docks[address] = (now_s, state)

    def bid_told(self, robot: str, bid: DockBid, now_s: float) -> None:
        """Take the bid of another robot."""
        if all(map(math.isfinite, (bid.seconds, bid.x_m, bid.y_m))):
            self._bids = {it: told for it, told in self._bids.items() if now_s <= told[0] + FRESH_S}
            if robot in self._bids or len(self._bids) < MOST_HEARD:
                self._bids[robot] = (now_s, bid)

    def bid(self, now_s: float, pose: Pose, reserve_s: float, bad_docks: tuple[str, ...]) -> DockBid:
        """Return what this robot bids."""
        avoids = {*bad_docks, *(it for it, until_s in self._avoided.items() if now_s < until_s)}
        return DockBid(reserve_s, pose.x_m, pose.y_m, tuple(sorted(avoids)))

    def decide(self, now_s: float, pose: Pose, level: float, bid: DockBid) -> Step:
        """Return what the robot does now.

        Args:
            now_s: the mission time.
            pose: where it is.
            level: the level of its battery.
            bid: what it bids, from `bid`.
        """
        if self.phase == "asks":
            return self._ask(now_s, pose, level, bid)
        if self.phase in ("goes", "charges"):
            return self._go(now_s, pose, level, bid)
        if self.phase == "leaves":
            return self._leave(now_s, pose)
        return Step("done")

    def _fresh_docks(self, now_s: float) -> dict[str, DockState]:
        return {it: state for it, (at_s, state) in self._docks.items() if now_s <= at_s + FRESH_S}

    def _fresh_bids(self, now_s: float) -> dict[str, DockBid]:
        return {it: bid for it, (at_s, bid) in self._bids.items() if now_s <= at_s + FRESH_S}

    def _ask(self, now_s: float, pose: Pose, level: float, bid: DockBid) -> Step:
        if level >= self._settings.full:
            self.phase, self._left = "leaves" if self._settings.home_m is not None else "done", (math.inf, math.inf)
            self._set_out(now_s)
            return Step(self.phase, news="charged", why="the battery is full already")
        if self._asks_since_s is None:
            self._asks_since_s = now_s
        docks = self._fresh_docks(now_s)
        held = sorted(it for it, state in docks.items() if state.robot == self._robot and it not in bid.avoids)
        found, bids = held[0] if held else "", {**self._fresh_bids(now_s), self._robot: bid}
        if not found and now_s >= self._asks_since_s + WINDOW_S:
            found = allocate(bids, docks).get(self._robot, "")
        if not found:
            return Step("asks")
        self.phase, self._dock = "goes", found
        self._mine_s = now_s
        self._set_out(now_s)
        told = {robot: it.seconds for robot, it in sorted(bids.items())}
        return Step("goes", found, news="dock_chosen", bids=told)

    def _set_out(self, now_s: float) -> None:
        self._nearest_m, self._nearer_s = math.inf, now_s

    def _ask_again(self, now_s: float, why: str, avoid: bool) -> Step:
        """Let the dock go, and ask for another; `avoid`: not for this one, for some time."""
        if avoid:
            self._avoided[self._dock] = now_s + AVOID_S
        self.phase, self._dock, self._asks_since_s = "asks", "", now_s
        return Step("asks", news="dock_lost", why=why)

    def _go(self, now_s: float, pose: Pose, level: float, bid: DockBid) -> Step:
        dock = self._fresh_docks(now_s).get(self._dock)
        if dock is None:
            return self._ask_again(now_s, f"{self._dock} is silent", avoid=False)
        if dock.robot not in ("", self._robot):
            return self._ask_again(now_s, f"{self._dock} is taken by {dock.robot}", avoid=False)
        if self._dock in bid.avoids:
            return self._ask_again(now_s, f"{self._dock} does not charge it", avoid=False)
        if dock.robot == self._robot:
            self._mine_s = now_s
        elif now_s > self._mine_s + CONFIRM_S:
            return self._ask_again(now_s, f"{self._dock} does not obey", avoid=True)
        elif self._nearest_m == math.inf:
            return Step("goes", self._dock)  # it sets out once the dock is its own
        place = (dock.x_m, dock.y_m)
        if self._is_full(now_s, level):
            self.phase, self._left = "leaves", place
            self._set_out(now_s)
            return Step("leaves", self._dock, news="charged")
        was = self.phase
        self.phase = "charges" if self._is_at(pose, place, 2.0 if was == "charges" else 1.0) else "goes"
        if self.phase == "charges":
            if was != "charges" or dock.state == "charging":
                self._contact_s = now_s
            elif now_s > self._contact_s + CONTACT_S:
                return self._ask_again(now_s, f"it stands at {self._dock}, which does not charge it", avoid=True)
            self._set_out(now_s)
            self._nearest_m = 0.0
            return Step("charges", self._dock, news="" if was == "charges" else "docked")
        if was == "charges":
            self._set_out(now_s)
        if self._is_stuck(now_s, pose, place):
            return self._ask_again(now_s, f"it comes no nearer to {self._dock}", avoid=True)
        return Step("goes", self._dock, place)

    def _is_full(self, now_s: float, level: float) -> bool:
        if level >= self._settings.full:
            return True
        waits = bool(self._fresh_bids(now_s))
        free = any(state.state == "free" for state in self._fresh_docks(now_s).values())
        return self.phase == "charges" and waits and not free and level >= self._settings.enough

    def _leave(self, now_s: float, pose: Pose) -> Step:
        home = self._settings.home_m
        if home is None or self._is_at(pose, home) or self._is_stuck(now_s, pose, home):
            self.phase = "done"
            return Step("done", news="left_dock")
        at_dock = math.dist((pose.x_m, pose.y_m), self._left) < self._settings.clear_m
        return Step("leaves", self._dock if at_dock else "", home)

    def _is_at(self, pose: Pose, place: tuple[float, float], factor: float = 1.0) -> bool:
        return math.dist((pose.x_m, pose.y_m), place) <= factor * self._settings.near_m

    def _is_stuck(self, now_s: float, pose: Pose, place: tuple[float, float]) -> bool:
        left_m = math.dist((pose.x_m, pose.y_m), place)
        if left_m < self._nearest_m - NEARER_M:
            self._nearest_m, self._nearer_s = left_m, now_s
        return now_s > self._nearer_s + STUCK_S


def drive_to(pose: Pose, goal: tuple[float, float], speed_mps: float, turn_radps: float) -> Twist:
    """Return the command that brings a robot nearer to a place.

    The further it has to turn, the slower it drives. It never only turns for small angles, so that a barrier which
    leads it round another robot is not turned back at once.

    Args:
        pose: where it is.
        goal: where it should go.
        speed_mps: how fast it drives, far from the goal.
        turn_radps: how fast it turns at most.
    """
    dx_m, dy_m = goal[0] - pose.x_m, goal[1] - pose.y_m
    bearing_rad = math.remainder(math.atan2(dy_m, dx_m) - pose.theta_rad, math.tau)
    turn = min(max(2.0 * bearing_rad, -turn_radps), turn_radps)
    ahead = max(math.cos(bearing_rad), 0.0)
    return Twist(min(speed_mps, math.hypot(dx_m, dy_m)) * ahead * ahead, turn)
