"""Forecast what a change would do to a fleet, from measured figures. Pure: figures in, expectations out.

The model:

- A task's load is the processor time of its turns. A part of the agent's other work (timer, network), in proportion to
  its turns, may belong to the task, too: at least none of it, at most all of it, and half is expected.
- A rate changes the ticks of only one timer. Each tick takes the mean time of the measured ticks.
- On another computer, a task takes longer or shorter by the same factor as a fixed piece of Python.
- Python computes on one processor at a time. If the tasks of an agent need more than one processor, the excess share of
  ticks is missed. Below that, a tick is missed if it waits longer than its period for the turns of other tasks. Waiting
  times are those of a queue with one server, random arrivals and random service (M/M/1), with the measured turns.
- A battery drains at the measured rate, or in proportion to its agent's load: the truth lies between.

The bounds include twice the standard error of the mean tick, the share of timers and network, and 5 % for another
computer, because only one piece of Python measures its speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec

from pancakes.errors import PancakesError

OTHER_HOST_SHARE: Final = 0.05
"""The error of a task's load on another computer that the yardstick does not show, as a share of the load."""
FULL_SHARE: Final = 0.95
"""The busy share above which a computer may not give an agent more processor time."""
ROUNDING: Final = 1e-9
"""Smaller differences of loads count as none."""
FEWEST_TICKS: Final = 5
"""The fewest ticks from which the time of a tick is known."""


class UnknownForecastError(PancakesError):
    """The measurement does not allow a forecast of this change; the message says what to do."""


class MeasuredTimer(msgspec.Struct, frozen=True):
    """The figures of a time-driven method; all figures are described in `pancakes.control.Measure`."""

    timer: str
    rate_hz: float
    ticks: int
    missed: int
    tick_s: float
    tick_s2: float


class MeasuredTask(msgspec.Struct, frozen=True):
    """The figures of a task."""

    service: str
    task: str
    type: str
    state: str
    task_id: str
    turns: int
    turn_s: float
    timers: tuple[MeasuredTimer, ...]


class MeasuredHost(msgspec.Struct, frozen=True):
    """The figures of a computer."""

    id: str
    processors: int
    busy_share: float
    yardstick_s: float


class MeasuredBattery(msgspec.Struct, frozen=True):
    """The level of a battery before and after the measurement, 0 to 1; None without a battery."""

    before: float | None = None
    after: float | None = None


class MeasuredAgent(msgspec.Struct, frozen=True):
    """The figures of an agent."""

    agent: str
    speed: float
    span_s: float
    processor_s: float
    turns: int
    turn_s: float
    host: MeasuredHost
    tasks: tuple[MeasuredTask, ...]
    battery: MeasuredBattery = MeasuredBattery()

    @property
    def load(self) -> float:
        """The agent's load in processors: 1 is one processor that is always busy."""
        return self.processor_s / self.span_s

    @property
    def besides_s(self) -> float:
        """The processor time outside of turns (timer, network, kernel), per turn."""
        return max(0.0, self.processor_s - self.turn_s) / self.turns if self.turns else 0.0

    def task(self, name: str, service: str = "") -> MeasuredTask:
        """Return one of its tasks.

        Raises:
            UnknownForecastError: the agent has no task of this name, or several.
        """
        found = [it for it in self.tasks if it.task == name and service in ("", it.service)]
        if len(found) == 1:
            return found[0]
        if found:
            services = " and in ".join(it.service for it in found)
            raise UnknownForecastError(f"{self.agent} has {name!r} in {services}: name the service too")
        raise UnknownForecastError(
            f"{self.agent} has no task {name!r}, only {', '.join(it.task for it in self.tasks) or 'none'}"
        )


@dataclass(frozen=True, slots=True)
class Expected:
    """An expected figure, and its bounds."""

    value: float
    low: float
    high: float

    def __add__(self, other: Expected) -> Expected:
        return Expected(self.value + other.value, self.low + other.low, self.high + other.high)

    def times(self, factor: float) -> Expected:
        """Return the figure times a factor; a negative factor exchanges the bounds."""
        low, high = sorted((self.low * factor, self.high * factor))
        return Expected(self.value * factor, low, high)

    def within(self, least: float, most: float) -> Expected:
        """Return the figure and its bounds, clipped to `least` and `most`."""
        return Expected(*(min(max(it, least), most) for it in (self.value, self.low, self.high)))

    @property
    def sure_share(self) -> float:
        """The largest error as a share of the value; infinity if the value is 0 and a bound is not."""
        off = max(self.high - self.value, self.value - self.low)
        return off / abs(self.value) if self.value else (math.inf if off else 0.0)


@dataclass(frozen=True, slots=True)
class AgentForecast:
    """The effect of a change on one agent. Loads of agents are in processors, those of hosts are shares of all.

    Attributes:
        agent: the agent.
        load: its present load.
        load_after: its load after the change.
        host_load: the present load of its computer.
        host_load_after: the load of its computer after the change.
        missed_hz: the ticks that it misses per second of host time now.
        missed_hz_after: the ticks that it would miss after the change.
        battery_s: seconds of host time until its battery is empty, if all continues as measured; None: unknown.
        battery_after_s: the same after the change.
    """

    agent: str
    load: float
    load_after: Expected
    host_load: float
    host_load_after: Expected
    missed_hz: float
    missed_hz_after: Expected
    battery_s: float | None
    battery_after_s: Expected | None


@dataclass(frozen=True, slots=True)
class Forecast:
    """The effect of a change.

    Attributes:
        agents: the effect on each agent concerned.
        known_from: the figures that the forecast is based on, as sentences.
        notes: unknowns and peculiarities, as sentences.
    """

    agents: tuple[AgentForecast, ...]
    known_from: tuple[str, ...]
    notes: tuple[str, ...]

    def of(self, agent: str) -> AgentForecast:
        """Return the effect on an agent."""
        return next(it for it in self.agents if it.agent == agent)


@dataclass(frozen=True, slots=True)
class _Ticks:
    """The ticks of a timer: the wanted rate per second of host time, and the processor time of each tick."""

    hz: float
    each_s: float


@dataclass
class _Change:
    """The differences of an agent after a change."""

    load: Expected = field(default_factory=lambda: Expected(0.0, 0.0, 0.0))
    host_load: Expected = field(default_factory=lambda: Expected(0.0, 0.0, 0.0))
    """In processors, like the agent's load; a migration within the same computer does not change it."""
    ticks: dict[tuple[str, str], _Ticks] = field(default_factory=dict)
    """The ticks that change, by task and timer."""
    gone: bool = False


def forecast_move(fleet: Sequence[MeasuredAgent], source: str, task: str, to: str, service: str = "") -> Forecast:
    """Return the effect of a task's migration.

    Raises:
        UnknownForecastError: the agent or the task does not exist, or the task does not run or is there already.
    """
    moved = _of(fleet, source).task(task, service)
    if source == to:
        raise UnknownForecastError(f"{source}/{task} is on {to} already")
    changes: dict[str, _Change] = {}
    notes: list[str] = []
    _move(changes, _of(fleet, source), moved, _of(fleet, to), notes)
    return _forecast(fleet, changes, notes)


def forecast_rate(
    fleet: Sequence[MeasuredAgent], agent: str, task: str, rate_hz: float, timer: str = "", service: str = ""
) -> Forecast:
    """Return the effect of another rate of a task's timer; without a name, of its first timer.

    Args:
        rate_hz: ticks per second of mission time.

    Raises:
        UnknownForecastError: the agent, the task or the timer does not exist, or there were too few ticks to measure
            them.
    """
    figures = _of(fleet, agent)
    changed = figures.task(task, service)
    if not (math.isfinite(rate_hz) and rate_hz >= 0.0):
        raise UnknownForecastError(f"{rate_hz} is not a rate: give a number of ticks per second, 0 or more")
    timers = [it for it in changed.timers if timer in ("", it.timer)]
    if not timers:
        names = ", ".join(it.timer for it in changed.timers)
        raise UnknownForecastError(
            f"{agent}/{task} has no timer {timer!r}, only {names}" if names else f"{agent}/{task} has no timer"
        )
    found = timers[0]
    if found.ticks < FEWEST_TICKS:
        raise UnknownForecastError(
            f"{agent}/{task} ticked {found.ticks} times in {figures.span_s:.1f} s, which is too few for a forecast:"
            " measure longer (--for 30s)"
        )
    each_s = found.tick_s / found.ticks
    wanted_hz = rate_hz * figures.speed
    more_hz = wanted_hz - found.ticks / figures.span_s
    off_s = _standard_errors(found) / found.ticks
    load = _uncertain(each_s, off_s, figures.besides_s).times(more_hz)
    change = _Change(load, load, {(f"{changed.service}/{changed.task}", found.timer): _Ticks(wanted_hz, each_s)})
    notes = []
    if each_s * wanted_hz > 1.0:
        notes.append(
            f"a tick of {agent}/{task} takes {each_s * 1e3:.3g} ms of processor time: at most {1.0 / each_s:.3g} fit"
            " into a second"
        )
    return _forecast(fleet, {agent: change}, notes)


def forecast_without(fleet: Sequence[MeasuredAgent], agent: str, places: Mapping[str, str]) -> Forecast:
    """Return the effect of an agent's departure after the migration of its tasks.

    Args:
        fleet: the measured figures.
        agent: the agent that leaves.
        places: the destination of each task, by `service/task`. Tasks without one end with the agent.

    Raises:
        UnknownForecastError: the agent does not exist.
    """
    figures = _of(fleet, agent)
    changes: dict[str, _Change] = {}
    notes: list[str] = []
    ending = []
    for task in figures.tasks:
        to = places.get(f"{task.service}/{task.task}")
        if to is not None:
            _move(changes, figures, task, _of(fleet, to), notes)
        elif task.state == "running" and task.service not in ("device", "network", "log"):
            ending.append(task.task)
    if ending:
        notes.append(f"{', '.join(ending)} would end with {agent}: no other agent takes them")
    # The load of tasks that migrate to another agent of the same computer stays on this computer.
    kept = Expected(0.0, 0.0, 0.0)
    for other, change in changes.items():
        if other != agent and _of(fleet, other).host.id == figures.host.id:
            kept += change.load
    whole = Expected(*3 * (-figures.load,))
    changes[agent] = _Change(whole, whole + kept, {}, True)
    return _forecast(fleet, changes, notes)


def _move(
    changes: dict[str, _Change],
    source: MeasuredAgent,
    moved: MeasuredTask,
    target: MeasuredAgent,
    notes: list[str],
) -> None:
    """Add the migration of a task to the changes."""
    if moved.state != "running":
        raise UnknownForecastError(
            f"{source.agent}/{moved.task} is {moved.state}: only a running task has a load to forecast"
        )
    off_s = sum(_standard_errors(timer) for timer in moved.timers)
    besides_s = source.besides_s * moved.turns
    load = _uncertain(moved.turn_s, off_s, besides_s).times(1.0 / source.span_s)
    load_there = load
    if target.host.id != source.host.id:
        ratio = target.host.yardstick_s / source.host.yardstick_s
        scaled = load.times(ratio)
        error = OTHER_HOST_SHARE * scaled.value
        load_there = Expected(scaled.value, max(0.0, scaled.low - error), scaled.high + error)
        notes.append(
            f"{target.agent} is on another computer, on which a piece of Python takes {ratio:.2f} times as long as on"
            f" the computer of {source.agent}"
        )
    leaving = changes.setdefault(source.agent, _Change())
    arriving = changes.setdefault(target.agent, _Change())
    leaving.load += load.times(-1.0)
    arriving.load += load_there
    if target.host.id != source.host.id:
        leaving.host_load += load.times(-1.0)
        arriving.host_load += load_there
    for timer in moved.timers:
        key = (f"{moved.service}/{moved.task}", timer.timer)
        ticks = _ticks(timer, source.speed)
        leaving.ticks[key] = _Ticks(0.0, ticks.each_s)
        arriving.ticks[key] = ticks
    if not moved.turns:
        notes.append(f"{source.agent}/{moved.task} had no turn in {source.span_s:.1f} s, so its load is unknown")


def _forecast(fleet: Sequence[MeasuredAgent], changes: Mapping[str, _Change], notes: list[str]) -> Forecast:
    hosts: dict[str, Expected] = {}
    for figures in fleet:
        change = changes.get(figures.agent, _Change())
        hosts.setdefault(figures.host.id, Expected(0.0, 0.0, 0.0))
        hosts[figures.host.id] += change.host_load.times(1.0 / figures.host.processors)
    concerned = [it for it in fleet if it.agent in changes]
    agents = tuple(_agent(it, changes[it.agent], hosts[it.host.id], notes) for it in concerned)
    spans = sorted({round(it.span_s, 1) for it in fleet if it.agent in changes})
    known_from = (
        f"processor time of each turn, measured for {' and '.join(f'{span:g} s' for span in spans)} on"
        f" {', '.join(it.agent for it in fleet if it.agent in changes)}",
        *(
            f"battery of {it.agent}: {it.battery.before:.4g} of it left, {it.span_s:.1f} s later {it.battery.after:.4g}"
            for it in concerned
            if it.agent in changes and it.battery.before is not None and it.battery.after is not None
        ),
    )
    return Forecast(agents, known_from, tuple(notes))


def _agent(figures: MeasuredAgent, change: _Change, host_change: Expected, notes: list[str]) -> AgentForecast:
    # If an agent already uses more than one processor, its tasks compute outside of Python.
    most = max(1.0, figures.load)
    wanted = change.load + Expected(*3 * (figures.load,))
    if wanted.value > most and not change.gone:
        notes.append(
            f"the tasks of {figures.agent} would need {wanted.value:.2f} processors, but Python computes on only one"
        )
    host_load = figures.host.busy_share
    host_after = host_change + Expected(*3 * (host_load,))
    if host_after.value > FULL_SHARE and host_change.value > 0.0 and change.load.value > 0.0:
        notes.append(f"the computer of {figures.agent} would be full: {figures.agent} may get too little of it")
        wanted = Expected(wanted.value, min(wanted.low, figures.load), wanted.high)
    missed_hz = sum(timer.missed for task in figures.tasks for timer in task.timers) / figures.span_s
    left_s, left_after_s = _battery(figures, change)
    return AgentForecast(
        figures.agent,
        figures.load,
        wanted.within(0.0, most),
        host_load,
        host_after.within(0.0, 1.0),
        missed_hz,
        _missed(figures, change, wanted),
        left_s,
        left_after_s,
    )


def _missed(figures: MeasuredAgent, change: _Change, wanted: Expected) -> Expected:
    """Return the ticks that would be missed: the measured ones of timers that stay, plus the change in the model."""
    if change.gone:
        return Expected(0.0, 0.0, 0.0)
    ticks: dict[tuple[str, str], _Ticks] = {}
    staying_hz = 0.0
    for task in figures.tasks:
        for timer in task.timers:
            key = (f"{task.service}/{task.task}", timer.timer)
            ticks[key] = _ticks(timer, figures.speed)
            then = change.ticks.get(key, ticks[key])
            staying_hz += timer.missed / figures.span_s * (then.hz / ticks[key].hz if ticks[key].hz else 0.0)
    turn_s = figures.turn_s / figures.turns if figures.turns else 0.0
    before_hz = _late_hz(ticks.values(), figures.load, turn_s)
    ticks_after = {**ticks, **change.ticks}.values()
    after_hz = [_late_hz(ticks_after, load, turn_s) for load in (wanted.value, wanted.low, wanted.high)]
    return Expected(*(max(0.0, staying_hz + hz - before_hz) for hz in after_hz))


def _ticks(timer: MeasuredTimer, speed: float) -> _Ticks:
    return _Ticks(timer.rate_hz * speed, timer.tick_s / timer.ticks if timer.ticks else 0.0)


def _late_hz(timers: Iterable[_Ticks], load: float, turn_s: float) -> float:
    """Return the ticks per second that would wait longer than their period for the turns of other tasks."""
    missed_hz = 0.0
    for ticks in timers:
        others = load - ticks.hz * ticks.each_s - ROUNDING
        if load >= 1.0:
            missed_hz += ticks.hz * (load - 1.0) / load
        elif ticks.hz > 0.0 and others > 0.0 and turn_s > 0.0:
            missed_hz += ticks.hz * others * math.exp(-(1.0 - others) / (turn_s * ticks.hz))
    return missed_hz


def _battery(figures: MeasuredAgent, change: _Change) -> tuple[float | None, Expected | None]:
    before, after = figures.battery.before, figures.battery.after
    if before is None or after is None or before <= after or change.gone:
        return None, None
    left_s = after * figures.span_s / (before - after)
    load = max(0.0, figures.load + change.load.value)
    in_proportion_s = left_s * figures.load / load if load > 0.0 and figures.load > 0.0 else left_s
    return left_s, Expected(left_s, min(left_s, in_proportion_s), max(left_s, in_proportion_s))


def _of(fleet: Sequence[MeasuredAgent], agent: str) -> MeasuredAgent:
    for figures in fleet:
        if figures.agent == agent:
            return figures
    raise UnknownForecastError(
        f"the agent {agent!r} was not measured, only {', '.join(it.agent for it in fleet) or 'none'}"
    )


def _uncertain(value: float, off: float, besides: float) -> Expected:
    """Return a measured value with its error, and with half of the work that may or may not belong to it."""
    return Expected(value + 0.5 * besides, max(0.0, value - off), value + off + besides)


def _standard_errors(timer: MeasuredTimer) -> float:
    """Return twice the standard error of the sum of a timer's ticks."""
    if timer.ticks < 2:
        return timer.tick_s
    spread = max(0.0, timer.tick_s2 - timer.tick_s * timer.tick_s / timer.ticks) / (timer.ticks - 1)
    return 2.0 * math.sqrt(spread * timer.ticks)
