"""What a change would do to a fleet, worked out from what was measured of it. Pure: figures in, expectations out.

How it is known:

- A task's load is the processor time of its turns. With it goes its part of what the agent does besides turns (timer,
  network), by the number of its turns: none of it at the least, all of it at the most, and half as the expectation.
- A rate changes the ticks of one timer alone, each of which takes what the measured ones took on the average.
- Another computer takes longer or shorter, as a fixed piece of Python does there.
- Python computes on one processor at a time. An agent whose tasks want more misses ticks: of each processor that is
  wanted, all beyond one. Below that a tick that has to wait longer than its period for the turns of others is missed;
  waits are those of a queue with one server, random arrivals and random service (M/M/1), with the measured turns.
- A battery is drained as it was, or in proportion to its agent's load: the truth lies between.

How sure it is: twice the standard error of the mean tick, the part of the timers and the network, and 5 % for another
computer, which is measured by one piece of Python alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec

from pancakes.errors import PancakesError

OTHER_HOST_SHARE: Final = 0.05
"""So far a task's load on another computer may be off, as a share of it, for all that the yardstick says."""
FULL_SHARE: Final = 0.95
"""A computer that is busier than this gives an agent no more, where other programs want it too."""
ROUNDING: Final = 1e-9
"""A difference of loads that is smaller is none."""
FEWEST_TICKS: Final = 5
"""With fewer ticks it is not known what one takes."""


class NotKnown(PancakesError):
    """What was measured does not say what a change would do; the message says what to do about that."""


class MeasuredTimer(msgspec.Struct, frozen=True):
    """What was measured of a time-driven method; see `pancakes.control.Measure`, as for all figures."""

    timer: str
    rate_hz: float
    ticks: int
    missed: int
    tick_s: float
    tick_s2: float


class MeasuredTask(msgspec.Struct, frozen=True):
    """What was measured of a task."""

    service: str
    task: str
    type: str
    state: str
    task_id: str
    turns: int
    turn_s: float
    timers: tuple[MeasuredTimer, ...]


class MeasuredHost(msgspec.Struct, frozen=True):
    """What was measured of a computer."""

    id: str
    processors: int
    busy_share: float
    yardstick_s: float


class MeasuredBattery(msgspec.Struct, frozen=True):
    """What was left of a battery before and after the measurement, 0 to 1; None: there is none."""

    before: float | None = None
    after: float | None = None


class MeasuredAgent(msgspec.Struct, frozen=True):
    """What was measured of an agent."""

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
        """Processors that it takes: 1 is one that is busy all the time."""
        return self.processor_s / self.span_s

    @property
    def besides_s(self) -> float:
        """Processor time beside turns, for each turn: timer, network, kernel."""
        return max(0.0, self.processor_s - self.turn_s) / self.turns if self.turns else 0.0

    def task(self, name: str, service: str = "") -> MeasuredTask:
        """Return one of its tasks.

        Raises:
            NotKnown: it has none of this name, or several.
        """
        found = [it for it in self.tasks if it.task == name and service in ("", it.service)]
        if len(found) == 1:
            return found[0]
        if found:
            raise NotKnown(f"{self.agent} has {name!r} in {' and in '.join(it.service for it in found)}: say which")
        raise NotKnown(f"{self.agent} has no task {name!r}, only {', '.join(it.task for it in self.tasks) or 'none'}")


@dataclass(frozen=True, slots=True)
class Expected:
    """A figure that is expected, and the bounds between which it should lie."""

    value: float
    low: float
    high: float

    def __add__(self, other: Expected) -> Expected:
        return Expected(self.value + other.value, self.low + other.low, self.high + other.high)

    def times(self, factor: float) -> Expected:
        """Return a multiple of it; a negative one exchanges the bounds."""
        low, high = sorted((self.low * factor, self.high * factor))
        return Expected(self.value * factor, low, high)

    def within(self, least: float, most: float) -> Expected:
        """Return it with no part below `least` or above `most`."""
        return Expected(*(min(max(it, least), most) for it in (self.value, self.low, self.high)))

    @property
    def sure_share(self) -> float:
        """How far it may be off, as a share of it; infinity for 0 that may be something."""
        off = max(self.high - self.value, self.value - self.low)
        return off / abs(self.value) if self.value else (math.inf if off else 0.0)


@dataclass(frozen=True, slots=True)
class AgentForecast:
    """What a change would do to one agent. Loads of agents are in processors, those of hosts shares of all.

    Attributes:
        agent: the agent.
        load: now.
        load_after: after the change.
        host_load: of its computer, now.
        host_load_after: after the change.
        missed_hz: ticks that it misses for each second of host time, now.
        missed_hz_after: after the change.
        battery_s: seconds of host time until its battery is empty, if all goes on as measured; None: not known.
        battery_after_s: after the change.
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
    """What a change would do.

    Attributes:
        agents: each agent that it concerns.
        known_from: what that is known from, as sentences.
        notes: what it does not know or what stands out, as sentences.
    """

    agents: tuple[AgentForecast, ...]
    known_from: tuple[str, ...]
    notes: tuple[str, ...]

    def of(self, agent: str) -> AgentForecast:
        """Return what it would do to an agent."""
        return next(it for it in self.agents if it.agent == agent)


@dataclass(frozen=True, slots=True)
class _Ticks:
    """The ticks of a timer: how many are wanted for each second of host time, and what each takes."""

    hz: float
    each_s: float


@dataclass
class _Change:
    """What is different about an agent after a change."""

    load: Expected = field(default_factory=lambda: Expected(0.0, 0.0, 0.0))
    host_load: Expected = field(default_factory=lambda: Expected(0.0, 0.0, 0.0))
    """In processors, as that of the agent; what goes on on the same computer makes no difference to it."""
    ticks: dict[tuple[str, str], _Ticks] = field(default_factory=dict)
    """By task and timer: its ticks, where they change."""
    gone: bool = False


def forecast_move(fleet: Sequence[MeasuredAgent], source: str, task: str, to: str, service: str = "") -> Forecast:
    """Return what the move of a task would do.

    Raises:
        NotKnown: there is no such agent or task, it does not run, or it is there already.
    """
    moved = _of(fleet, source).task(task, service)
    if source == to:
        raise NotKnown(f"{source}/{task} is on {to} already")
    changes: dict[str, _Change] = {}
    notes: list[str] = []
    _move(changes, _of(fleet, source), moved, _of(fleet, to), notes)
    return _forecast(fleet, changes, notes)


def forecast_rate(
    fleet: Sequence[MeasuredAgent], agent: str, task: str, rate_hz: float, timer: str = "", service: str = ""
) -> Forecast:
    """Return what another rate of a task's timer would do; without a name its first.

    Args:
        rate_hz: ticks for each second of mission time.

    Raises:
        NotKnown: there is no such agent, task or timer, or too few ticks to know what one takes.
    """
    figures = _of(fleet, agent)
    changed = figures.task(task, service)
    if not (math.isfinite(rate_hz) and rate_hz >= 0.0):
        raise NotKnown(f"{rate_hz} is no rate: it is a number of ticks a second, 0 or more")
    timers = [it for it in changed.timers if timer in ("", it.timer)]
    if not timers:
        have = ", ".join(it.timer for it in changed.timers)
        raise NotKnown(
            f"{agent}/{task} has no timer {timer!r}, only {have}" if have else f"{agent}/{task} has no timer"
        )
    found = timers[0]
    if found.ticks < FEWEST_TICKS:
        raise NotKnown(
            f"{agent}/{task} ticked {found.ticks} times in {figures.span_s:.1f} s, which does not say what a tick"
            " takes: measure longer (--for 30s)"
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
            f"a tick of {agent}/{task} takes {each_s * 1e3:.3g} ms of processor time: more than {1.0 / each_s:.3g} do"
            " not fit into a second"
        )
    return _forecast(fleet, {agent: change}, notes)


def forecast_without(fleet: Sequence[MeasuredAgent], agent: str, places: Mapping[str, str]) -> Forecast:
    """Return what it would do if an agent went, and its tasks that can move went to others before.

    Args:
        fleet: what was measured.
        agent: the agent that goes.
        places: by task, as `service/task`: the agent that it goes to. Others end with the agent.

    Raises:
        NotKnown: there is no such agent.
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
        notes.append(f"with {agent} end {', '.join(ending)}: no other agent takes them")
    # What its tasks take stays on this computer where they go to an agent on it.
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
    """Add the move of a task to what changes."""
    if moved.state != "running":
        raise NotKnown(f"{source.agent}/{moved.task} is {moved.state}: a task that does not run takes nothing along")
    off_s = sum(_standard_errors(timer) for timer in moved.timers)
    besides_s = source.besides_s * moved.turns
    load = _uncertain(moved.turn_s, off_s, besides_s).times(1.0 / source.span_s)
    there = load
    if target.host.id != source.host.id:
        ratio = target.host.yardstick_s / source.host.yardstick_s
        wide = load.times(ratio)
        off = OTHER_HOST_SHARE * wide.value
        there = Expected(wide.value, max(0.0, wide.low - off), wide.high + off)
        notes.append(
            f"{target.agent} is on another computer, on which a piece of Python takes {ratio:.2f} times as long as on"
            f" {source.agent}'s"
        )
    leaving = changes.setdefault(source.agent, _Change())
    arriving = changes.setdefault(target.agent, _Change())
    leaving.load += load.times(-1.0)
    arriving.load += there
    if target.host.id != source.host.id:
        leaving.host_load += load.times(-1.0)
        arriving.host_load += there
    for timer in moved.timers:
        key = (f"{moved.service}/{moved.task}", timer.timer)
        ticks = _ticks(timer, source.speed)
        leaving.ticks[key] = _Ticks(0.0, ticks.each_s)
        arriving.ticks[key] = ticks
    if not moved.turns:
        notes.append(f"{source.agent}/{moved.task} had no turn in {source.span_s:.1f} s: what it takes is not known")


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
    # An agent that takes more than one processor already has tasks that compute outside of Python.
    most = max(1.0, figures.load)
    wanted = change.load + Expected(*3 * (figures.load,))
    if wanted.value > most and not change.gone:
        notes.append(
            f"the tasks of {figures.agent} would want {wanted.value:.2f} processors, and Python computes on one"
        )
    host_load = figures.host.busy_share
    host_after = host_change + Expected(*3 * (host_load,))
    if host_after.value > FULL_SHARE and host_change.value > 0.0 and change.load.value > 0.0:
        notes.append(f"the computer of {figures.agent} would be full: {figures.agent} may not get what it wants")
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
    """Return the ticks that would be missed: those of the timers that stay, and by how much the model changes."""
    if change.gone:
        return Expected(0.0, 0.0, 0.0)
    ticks: dict[tuple[str, str], _Ticks] = {}
    stay_hz = 0.0
    for task in figures.tasks:
        for timer in task.timers:
            key = (f"{task.service}/{task.task}", timer.timer)
            ticks[key] = _ticks(timer, figures.speed)
            then = change.ticks.get(key, ticks[key])
            stay_hz += timer.missed / figures.span_s * (then.hz / ticks[key].hz if ticks[key].hz else 0.0)
    turn_s = figures.turn_s / figures.turns if figures.turns else 0.0
    before_hz = _late_hz(ticks.values(), figures.load, turn_s)
    all_then = {**ticks, **change.ticks}.values()
    after_hz = [_late_hz(all_then, load, turn_s) for load in (wanted.value, wanted.low, wanted.high)]
    return Expected(*(max(0.0, stay_hz + hz - before_hz) for hz in after_hz))


def _ticks(timer: MeasuredTimer, speed: float) -> _Ticks:
    return _Ticks(timer.rate_hz * speed, timer.tick_s / timer.ticks if timer.ticks else 0.0)


def _late_hz(timers: Iterable[_Ticks], load: float, turn_s: float) -> float:
    """Return the ticks a second that would wait longer than their period for the turns of others."""
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
    raise NotKnown(f"the agent {agent!r} was not measured, only {', '.join(it.agent for it in fleet) or 'none'}")


def _uncertain(value: float, off: float, besides: float) -> Expected:
    """Return what is measured and may be off, with half of what may go with it or not."""
    return Expected(value + 0.5 * besides, max(0.0, value - off), value + off + besides)


def _standard_errors(timer: MeasuredTimer) -> float:
    """Return twice the standard error of the sum of a timer's ticks."""
    if timer.ticks < 2:
        return timer.tick_s
    spread = max(0.0, timer.tick_s2 - timer.tick_s * timer.tick_s / timer.ticks) / (timer.ticks - 1)
    return 2.0 * math.sqrt(spread * timer.ticks)
