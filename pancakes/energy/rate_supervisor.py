"""Lower or raise the rates of tasks by what sensors say: the task `energy.supervisor` (paper Figure 2).

`SupervisorSettings` has the rules that a user writes. `SupervisorDecider` decides, without any input or output:
readings and times in, orders out. `RateSupervisor` is the task that carries the orders out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from pancakes.energy.adjusting_task import AdjustingTask
from pancakes.energy.orders import Decider, Duration, Knob, Order, Rate
from pancakes.errors import PancakesError
from pancakes.kernel.handlers import LATEST
from pancakes.packet import Packet, agent_of, body_class, field_names, known_types
from pancakes.task import Tick, every
from pancakes.util.text import did_you_mean


@dataclass
class RatePair:
    """The two rates of a task.

    Attributes:
        fast: its rate while something happens, in Hz; the rate that it begins with.
        slow: its rate while all is quiet, in Hz; 0 lets it rest.
        timer: which time-driven method, if the task has several; empty: the first.
    """

    fast: Rate
    slow: Rate
    timer: str = ""


@dataclass
class Rule:
    """When something happens, as one field of one kind of packets says it, and what then is fast.

    One of `above`, `below` and `changes_by` says what counts. A field that is true or false counts as 1 or 0, of
    several numbers the least counts, and nothing (None, NaN) says nothing.

    Attributes:
        when: the type of the packets, such as `motion`.
        field: the field of their bodies, such as `detected`.
        above: it happens if the field lies above this.
        below: it happens if the field lies below this.
        changes_by: it happens if the field is this far from what it was when it last happened.
        channel: the channel of the packets: readings on `system`, commands to actuators on `ctrl`.
        include_remote: whether packets of other agents count too.
        quiet_after_s: it is quiet when it has not happened for this long.
        rates: the rates of tasks, by `task` or `service/task`.
    """

    when: str
    field: str
    rates: dict[str, RatePair]
    above: float | None = None
    below: float | None = None
    changes_by: Annotated[float, Meta(gt=0)] | None = None
    channel: str = "system"
    include_remote: bool = False
    quiet_after_s: Duration = 5.0

    def __post_init__(self) -> None:
        if [self.above, self.below, self.changes_by].count(None) != 2:
            raise ValueError("one of above, below and changes_by must say what counts")
        if not self.rates:
            raise ValueError("rates must name a task")


@dataclass
class SupervisorSettings:
    """The rules.

    Attributes:
        rules: rules by a name of your own. If several name the same task, it is fast while any of them
            makes it so.
    """

    rules: dict[str, Rule] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.rules:
            raise ValueError("there is nothing to supervise: write at least one rule")
        paces: dict[tuple[str, str], tuple[float, float]] = {}
        for name, rule in self.rules.items():
            for target, pace in rule.rates.items():
                rates = (pace.fast, pace.slow)
                if paces.setdefault((target, pace.timer), rates) != rates:
                    raise ValueError(f"the rule {name} and one before it disagree on the rates of {target}")


def number_of(value: Any) -> float | None:
    """Return the value of a field as one number; None if it has none.

    Raises:
        ValueError: it is not a number, and not a list of numbers.
    """
    if value is None:
        return None
    if isinstance(value, (bool, int, float)):
        return None if math.isnan(value) else float(value)
    if isinstance(value, (list, tuple)):
        numbers = [number for item in value if (number := number_of(item)) is not None]
        return min(numbers, default=None)
    raise ValueError(f"{value!r} is not a number")


class Activity:
    """Decide whether something happens, by one rule. At first it does: tasks are fast until the rule knows better.

    Args:
        rule: the rule.
        now_s: the mission time.
    """

    def __init__(self, rule: Rule, now_s: float) -> None:
        self._rule = rule
        self._last_s = now_s
        self._value: float | None = None

    def read(self, value: float | None, now_s: float) -> None:
        """Take the value of the field."""
        if value is not None and self._counts(value):
            self._last_s = now_s
            self._value = value

    def _counts(self, value: float) -> bool:
        rule = self._rule
        if rule.above is not None:
            return value > rule.above
        if rule.below is not None:
            return value < rule.below
        return self._value is None or abs(value - self._value) >= (rule.changes_by or 0.0)

    def busy(self, now_s: float) -> bool:
        """Return whether it has happened within `quiet_after_s`."""
        return now_s - self._last_s < self._rule.quiet_after_s


class SupervisorDecider(Decider):
    """Decide for a supervisor: which tasks are fast, and the orders that follow from it.

    Args:
        settings: the rules.
        now_s: the mission time.
        doubt: whether another supervisor ran before this one, so that the rates in force are not known.

    Attributes:
        busy: whether something happens, by the name of the rule.
    """

    def __init__(self, settings: SupervisorSettings, now_s: float, doubt: bool) -> None:
        self._rules = settings.rules
        self._activities = {name: Activity(rule, now_s) for name, rule in settings.rules.items()}
        self._paces = {
            Knob(target, timer=pace.timer): pace
            for rule in settings.rules.values()
            for target, pace in rule.rates.items()
        }
        super().__init__({knob: pace.fast for knob, pace in self._paces.items()}, doubt)
        self.busy = dict.fromkeys(settings.rules, True)

    def read(self, rule: str, body: Any, now_s: float) -> None:
        """Take a packet's body for a rule.

        Raises:
            AttributeError: it has no such field.
            ValueError: the field is no number.
        """
        self._activities[rule].read(number_of(getattr(body, self._rules[rule].field)), now_s)

    def decide(self, now_s: float) -> list[Order]:
        """Return the orders that are due; the caller passes each that it publishes to `asked`."""
        self.busy = {name: activity.busy(now_s) for name, activity in self._activities.items()}
        fast = {
            Knob(target, timer=pace.timer): None
            for name, rule in self._rules.items()
            if self.busy[name]
            for target, pace in rule.rates.items()
        }
        self.book.want({knob: pace.fast if knob in fast else pace.slow for knob, pace in self._paces.items()})
        return self.book.due(now_s)


class RateSupervisor(AdjustingTask):
    """Make tasks fast while something happens, and slow while all is quiet, by rules.

    A task becomes fast with the packet in which something happens, and slow at a tick. When the supervisor is stopped,
    it makes all tasks fast again. Events: `busy` and `quiet`, with the `rule`.
    """

    Settings = SupervisorSettings

    @dataclass
    class State:
        """Keep what outlives a restart.

        Attributes:
            turned: whether any rate was ever changed.
        """

        turned: bool = False

    settings: SupervisorSettings
    state: State
    decider: SupervisorDecider

    def on_start(self) -> None:
        self._read: dict[tuple[str, str], None] = {}
        _check(self.settings)
        self._begin(self.state.turned)

    def on_settings(self) -> None:
        try:
            _check(self.settings)
        except PancakesError:
            self.settings = self._in_force
            raise
        # First restore what the old settings slowed down and the new ones may not name.
        self.restore()
        self._begin(True)

    def _begin(self, doubt: bool) -> None:
        self._in_force = self.settings
        self.decider = SupervisorDecider(self.settings, self.now(), doubt)
        for rule in self.settings.rules.values():
            if (rule.channel, rule.when) not in self._read:
                self._read[rule.channel, rule.when] = None
                self.subscribe(rule.channel, rule.when, self._reader(rule.channel, rule.when), queue=LATEST)

    def _reader(self, channel: str, kind: str) -> Callable[[Packet], None]:
        def read(packet: Packet) -> None:
            own = agent_of(packet.source) == self.agent
            for name, rule in self.settings.rules.items():
                if (rule.channel, rule.when) == (channel, kind) and (own or rule.include_remote):
                    self.decider.read(name, packet.body, self.now())
            self._decide()

        return read

    @every(hz=2)
    def look(self, tick: Tick) -> None:
        """Check whether it has become quiet."""
        self._decide()

    def _decide(self) -> None:
        before = self.decider.busy
        orders = self.decider.decide(self.now())
        for name, busy in self.decider.busy.items():
            if busy != before[name]:
                self.event("busy" if busy else "quiet", rule=name)
        self.publish_orders(orders)


def _check(settings: SupervisorSettings) -> None:
    """Check that the packets of all rules are known, and have their fields."""
    for name, rule in settings.rules.items():
        body = body_class(rule.when)
        if body is None:
            hint = did_you_mean(rule.when, known_types())
            raise PancakesError(f"the rule {name} reads packets of the unknown type {rule.when!r}{hint}")
        known = field_names(body)
        if known and rule.field not in known:
            raise PancakesError(f"the rule {name}: {rule.when} has no field {rule.field!r}, only {', '.join(known)}")
