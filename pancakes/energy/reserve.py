"""Measure what a robot has beyond the way to a dock: the task `energy.reserve`, and the arithmetic that it uses.

`Consumption` measures what the robot takes, by time and by distance. `ChargeWatch` finds docks that say they charge,
while the battery does not rise. Both are without input or output. `ReserveMeter` feeds them, and publishes a `Reserve`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from pancakes.control import Reply, Start
from pancakes.devices import Battery, DockState, Pose, Reserve
from pancakes.energy.policies import slope
from pancakes.packet import SYSCTRL, SYSTEM, Packet, agent_of
from pancakes.settings import Positive, Share
from pancakes.task import Task, on

DAY_S: Final = 86_400.0
"""The longest reserve that is told, either way."""
LEAST_SPEED_MPS: Final = 0.01
"""A robot that moves more slowly stands: that is noise of its pose."""
JUMP_MPS: Final = 5.0
"""A pose that moves faster has jumped: that is no way that was driven."""
TRUSTED_M: Final = 2.0
"""After this many metres, the consumption by distance is the measured one."""
POSE_OLD_S: Final = 10.0
"""A pose that is older says nothing of the way to a dock."""
SILENT_S: Final = 60.0
"""After this silence a dock counts only if no other dock was heard."""
MOST_DOCKS: Final = 64
"""Of more docks, those that are silent are forgotten, and the newest do not count."""
ASKED_S: Final = 10.0
"""The least time between two starts of the task that charges an idle robot ..."""
REFUSED_S: Final = 30.0
"""... and after a start that was refused, as it is on a robot that works."""
NEEDS_LEVEL: Final = 0.8
"""A robot with more is not charged for being idle, however short its reserve is."""
URGENT: Final = 0.25
"""Below this share of `idle_below_s` an idle robot also waits for a dock."""
AWAY_M: Final = 0.3
"""The distance from its home at which an idle robot is in the way."""
FULL: Final = 0.98
"""A battery above this level need not rise at a dock."""


class Consumption:
    """What a robot takes from its battery, by time and by distance.

    Args:
        window_s: consumption by time is that of the last `window_s`.
        guess_per_m: what a metre takes, as a share of the battery, until that is measured.
        lost: what the battery has lost while the robot drove, before it was restarted.
        driven_m: how far it drove then.

    Attributes:
        lost: the same, up to now.
        driven_m: the same, up to now.
    """

    def __init__(self, window_s: float, guess_per_m: float, lost: float = 0.0, driven_m: float = 0.0) -> None:
        self._window_s = window_s
        self._guess_per_m = guess_per_m
        self.lost = lost
        self.driven_m = driven_m
        self._readings: list[tuple[float, float]] = []
        self._place: tuple[float, float] | None = None
        self._per_s: float | None = None

    def take(self, now_s: float, battery: Battery, place: tuple[float, float]) -> None:
        """Take a reading of the battery, and the robot's place at that time. If time goes back, begin again."""
        before_s, before = self._readings[-1] if self._readings else (now_s, battery.level)
        if battery.charging or now_s < before_s:
            self._readings, self._place = [], place
            return
        elapsed_s = now_s - before_s
        if self._place is not None and elapsed_s > 0.0:
            moved_m = math.dist(self._place, place)
            if LEAST_SPEED_MPS * elapsed_s <= moved_m <= JUMP_MPS * elapsed_s:
                self.lost += before - battery.level
                self.driven_m += moved_m
        self._place = place
        self._readings = [it for it in self._readings if it[0] >= now_s - self._window_s]
        self._readings.append((now_s, battery.level))
        if now_s - self._readings[0][0] >= 0.5 * self._window_s:
            self._per_s = max(-slope(self._readings), 0.0)

    @property
    def per_s(self) -> float | None:
        """What it takes each second, as a share of the battery; None: that is not known yet."""
        return self._per_s

    @property
    def per_m(self) -> float:
        """What it takes for each metre that it drives, with all else that it takes meanwhile."""
        if self.driven_m < TRUSTED_M or self.lost <= 0.0:
            return self._guess_per_m
        return self.lost / self.driven_m


class ChargeWatch:
    """Finds docks that say they charge the robot, while its battery does not rise.

    Args:
        rise_s: the battery must rise by `least_rise` in this time at a dock.
        least_rise: a share of the battery.
        again_s: a dock that failed is good again after this time.
    """

    def __init__(self, rise_s: float, least_rise: float, again_s: float) -> None:
        self._rise_s = rise_s
        self._least_rise = least_rise
        self._again_s = again_s
        self._failed: dict[str, float] = {}
        self._dock = ""
        self._since_s = 0.0
        self._level = 0.0

    def take(self, now_s: float, level: float, dock: str) -> None:
        """Take the battery's level, and the dock that says it charges the robot now; empty: none does."""
        self._failed = {it: at_s for it, at_s in self._failed.items() if now_s < at_s + self._again_s}
        if dock != self._dock or level >= self._level + self._least_rise:
            if dock and dock == self._dock and dock in self._failed:
                self._failed.clear()  # it was the battery, or something that is over
            self._dock, self._since_s, self._level = dock, now_s, level
        elif dock and level < FULL and now_s >= self._since_s + self._rise_s:
            self._failed[dock] = now_s

    @property
    def failed(self) -> tuple[str, ...]:
        """The docks that failed, by name."""
        return tuple(sorted(self._failed))

    @property
    def trouble(self) -> str:
        """What is wrong, as a sentence; empty: nothing."""
        failed = [agent_of(it) for it in self.failed]
        if len(failed) > 1:
            return f"the battery did not rise at {' and '.join(failed)}, which said that they charge: check the battery"
        return f"{failed[0]} says that it charges, and the battery does not rise: check the dock" if failed else ""


def nearest(place: tuple[float, float], docks: Mapping[str, tuple[float, float]]) -> tuple[str, float]:
    """Return the address of the nearest dock, ties by address, and how far it is in m; empty and 0: there is none."""
    found = min(((math.dist(place, at), address) for address, at in docks.items()), default=(0.0, ""))
    return found[1], found[0]


class ReserveMeter(Task):
    """Measure the robot's reserve, and publish it as a `reserve` on `system`, once for each reading of the battery.

    The first comes after half of `window_s`. It hears of docks by their `dock_state`. What is wrong with docks or
    battery is in the reading, and on `log`.
    """

    requires = ("battery", "pose")

    @dataclass
    class Settings:
        """How the robot consumes, and how careful it is.

        Attributes:
            level_per_m: what driving a metre takes, as a share of the battery, until the robot has driven 2 m.
            margin: the level of the battery that must be left at the dock.
            detour: how much longer the way to a dock is than a straight line.
            window_s: the consumption by time is that of the last `window_s`. In it the battery must lose more than its
                readings are off by.
            rise_s: a battery that rises by less than `least_rise` in this time at a dock is not charged.
            least_rise: see `rise_s`; a share of the battery.
            again_s: a dock that did not charge is used again after this time.
            idle: a task that has the robot charged, started if no task of this robot holds the wheels and the reserve
                is below `idle_below_s` and a dock is free, or below a quarter of that; empty: none.
            idle_below_s: see `idle`.
            idle_home_m: where an idle robot stands, (x, y); it also starts `idle` if it is further than 0.3 m from
                there, such as after a restart. None: wherever it is.
        """

        level_per_m: Positive = field(kw_only=True)
        margin: Share = 0.05
        detour: Positive = 1.5
        window_s: Positive = 60.0
        rise_s: Positive = 120.0
        least_rise: Share = 0.005
        again_s: Positive = 600.0
        idle: str = ""
        idle_below_s: Positive = 120.0
        idle_home_m: tuple[float, float] | None = None

        def __post_init__(self) -> None:
            if self.detour < 1.0:
                raise ValueError(f"detour = {self.detour:g}: no way is shorter than a straight line, so at least 1")
            if self.idle_home_m is not None and not self.idle:
                raise ValueError("idle_home_m has no effect without idle, the task that drives the robot there")

    @dataclass
    class State:
        """What it has measured, and knows of docks.

        Attributes:
            lost: what the battery has lost while the robot drove.
            driven_m: how far it drove then.
            docks: where each dock is, by its address.
        """

        lost: float = 0.0
        driven_m: float = 0.0
        docks: dict[str, tuple[float, float]] = field(default_factory=dict)

    settings: Settings
    state: State

    def on_start(self) -> None:
        it = self.settings
        self._consumption = Consumption(it.window_s, it.level_per_m, self.state.lost, self.state.driven_m)
        self._watch = ChargeWatch(it.rise_s, it.least_rise, it.again_s)
        self._heard: dict[str, tuple[float, DockState]] = {}
        self._place: tuple[float, float] | None = None
        self._placed_s = 0.0
        self._trouble = ""
        self._asks_from_s = 0.0
        self._missing_told = False

    def on_settings(self) -> None:
        self.on_start()

    @on(SYSTEM, Pose, queue="latest")
    def moved(self, packet: Packet) -> None:
        """Take the robot's pose."""
        if agent_of(packet.source) == self.agent:
            self._place, self._placed_s = (packet.body.x_m, packet.body.y_m), self.now()

    @on(SYSTEM, DockState)
    def dock_told(self, packet: Packet) -> None:
        """Take what a dock does."""
        state: DockState = packet.body
        place = (state.x_m, state.y_m)
        if not all(map(math.isfinite, place)):
            return
        if packet.source not in self.state.docks and len(self.state.docks) >= MOST_DOCKS and not self._forget():
            return
        self._heard[packet.source] = (self.now(), state)
        if self.state.docks.get(packet.source) != place:
            self.state.docks[packet.source] = place

    def _forget(self) -> bool:
        """Forget a dock that has not been heard for a while; return whether there is one."""
        silent = [it for it in self.state.docks if it not in self._fresh(self.now())]
        for address in silent[:1]:
            del self.state.docks[address]
            self._heard.pop(address, None)
        return bool(silent)

    def _fresh(self, now_s: float) -> set[str]:
        """Return the docks that have been heard lately."""
        return {it for it, (heard_s, _) in self._heard.items() if now_s < heard_s + SILENT_S}

    @on(SYSTEM, Battery, queue="latest")
    def measured(self, packet: Packet) -> None:
        """Take a reading of the battery, and publish the reserve."""
        if agent_of(packet.source) != self.agent or self._place is None:
            return
        now_s, battery = self.now(), packet.body
        self._consumption.take(now_s, battery, self._place)
        self.state.lost, self.state.driven_m = self._consumption.lost, self._consumption.driven_m
        self._watch.take(now_s, battery.level, self._charged_by(now_s))
        seconds = math.inf
        if self._consumption.per_s is not None:
            seconds = self._publish(now_s, battery, self._consumption.per_s, self._place)
        it, home = self.settings, self.settings.idle_home_m
        below_s = it.idle_below_s if self._finds_free_dock(now_s) else URGENT * it.idle_below_s
        needs = seconds < below_s and battery.level < NEEDS_LEVEL
        away = home is not None and math.dist(self._place, home) > AWAY_M
        if it.idle and (needs or away) and now_s >= self._asks_from_s:
            # Refused while another task holds the wheels: that one has a rule of its own.
            self._asks_from_s = now_s + ASKED_S
            self.publish(SYSCTRL, Start(it.idle))

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, reply: Reply) -> None:
        """The task that charges an idle robot may not exist, or another task may hold the wheels."""
        if reply.refusal is not None:
            self._asks_from_s = self.now() + REFUSED_S
        if reply.refusal is not None and reply.refusal.code == "not_found" and not self._missing_told:
            self._missing_told = True
            self.log.warning(f"an idle robot is not charged: {reply.reason}. Correct `idle`")

    def _finds_free_dock(self, now_s: float) -> bool:
        """Return whether a dock is free now. A robot that waits for one holds its wheels, and so takes no task."""
        return any(it.state == "free" and now_s < heard_s + SILENT_S for heard_s, it in self._heard.values())

    def _charged_by(self, now_s: float) -> str:
        """Return the dock that says it charges this robot now."""
        for address, (heard_s, state) in sorted(self._heard.items()):
            if state.state == "charging" and state.robot == self.agent and now_s < heard_s + SILENT_S:
                return address
        return ""

    def _publish(self, now_s: float, battery: Battery, per_s: float, place: tuple[float, float]) -> float:
        """Publish the reserve; return its seconds."""
        failed = self._watch.failed
        known = {it: at for it, at in self.state.docks.items() if it not in failed} or self.state.docks
        fresh = self._fresh(now_s)
        heard = {it: at for it, at in known.items() if it in fresh}
        dock, straight_m = nearest(place, heard or known)
        way_m, per_m = self.settings.detour * straight_m, self._consumption.per_m
        trouble = self._watch.trouble
        # What cannot get to a dock must not take a task either.
        if not dock:
            trouble, left, seconds = "knows no dock: none has been heard of", 0.0, 0.0
        elif abs(now_s - self._placed_s) > POSE_OLD_S:  # a clock that was set back
            trouble, left, seconds = "its pose is too old to know the way to a dock", 0.0, 0.0
        else:
            left = battery.level - self.settings.margin - way_m * per_m
            seconds = left / per_s if per_s > 0.0 else math.copysign(DAY_S, left)
            seconds = min(max(seconds, -DAY_S), DAY_S)
        if trouble != self._trouble:
            self._trouble = trouble
            self.log("warning" if trouble else "info", trouble or "docks and battery are in order again")
        charging = battery.charging
        self.publish(SYSTEM, Reserve(seconds, left, dock, way_m, per_s, per_m, charging, failed, trouble))
        return seconds
