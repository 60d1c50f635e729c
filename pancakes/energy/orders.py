"""Knobs that can be turned down, and the book of the orders that turn them. Pure.

*Effort* says how much a robot may do: 1 is everything that it is configured for, 0 the least that its mission allows. A
knob is the rate or a setting of a task; its range gives its value at an effort.

The book keeps two promises. A value that is already in force is not ordered again; if it is in doubt because a task has
restarted, the task is first asked for it. A refusal is reported once, and the order is repeated only for a new reason:
another value, or a task that has restarted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeAlias

from msgspec import Meta

from pancakes.control import Configure, Describe, Reschedule
from pancakes.settings import PositiveShare

Rate: TypeAlias = Annotated[float, Meta(ge=0, le=1000)]
"""Ticks for each second of mission time; 0 rests."""
Duration: TypeAlias = Annotated[float, Meta(gt=0, le=1e9)]
"""Seconds of mission time."""

LEAST_SLEEP_S: Final = 1.0
"""Below this the links cost more to close and open than the sleep saves."""


@dataclass(frozen=True, slots=True)
class Knob:
    """One thing that can be turned: the rate of a task, or one of its settings.

    Attributes:
        target: the task, as `task` or `service/task`.
        key: the name of the setting; empty: the knob is the task's rate.
        timer: for a rate, which time-driven method; empty: the first.
    """

    target: str
    key: str = ""
    timer: str = ""

    def __str__(self) -> str:
        return f"{self.key} of {self.target}" if self.key else f"the rate of {self.target}"


@dataclass
class Range:
    """The range of a knob.

    Attributes:
        full: where it stands at effort 1, and again when the battery has recovered.
        least: where it stands at effort 0. For what costs less when it is larger, such as a period, it is the larger
            value.
        from_effort: it begins to move when the effort falls below this; above, it stands at `full`.
    """

    full: float
    least: float
    from_effort: PositiveShare = 1.0

    def at(self, effort: float) -> float:
        """Return where the knob stands at an effort."""
        share = _share(effort, self.from_effort)
        return self.full if share == 1.0 else round(self.least + share * (self.full - self.least), 6)


@dataclass
class RateRange(Range):
    """The range of a task's rate.

    Attributes:
        full: its rate at effort 1, in Hz, and again when the battery has recovered.
        least: its rate at effort 0, in Hz; 0 lets it rest.
        from_effort: it begins to fall when the effort falls below this.
        timer: which time-driven method, if the task has several; empty: the first.
    """

    full: Rate
    least: Rate
    timer: str = ""

    def __post_init__(self) -> None:
        if self.least > self.full:
            raise ValueError(f"least = {self.least:g} Hz lies above full = {self.full:g} Hz")


@dataclass
class Sleep:
    """How the Network Service sleeps and wakes in turn.

    Attributes:
        every_s: from the beginning of one sleep to that of the next.
        for_s: how long it sleeps each time at effort 0; less at a higher effort, and below 1 s not at all.
        from_effort: it begins to sleep when the effort falls below this.
    """

    every_s: Duration
    for_s: Duration
    from_effort: PositiveShare = 1.0

    def __post_init__(self) -> None:
        if self.for_s >= self.every_s:
            raise ValueError(f"for_s = {self.for_s:g} leaves no time awake in every_s = {self.every_s:g}")

    def at(self, effort: float) -> float:
        """Return how long it sleeps each time at an effort, in seconds; 0: not at all."""
        for_s = self.for_s * (1.0 - _share(effort, self.from_effort))
        return round(for_s, 3) if for_s >= LEAST_SLEEP_S else 0.0


def _share(effort: float, from_effort: float) -> float:
    return min(effort / from_effort, 1.0)


ANSWER_S: Final = 10.0
"""An order without a reply after this time is given again: the task that it is for has failed."""


@dataclass(frozen=True, slots=True)
class Order:
    """A control packet, and the knobs that it turns.

    Attributes:
        body: the packet's body.
        values: the value of each knob; of a `Describe`, all knobs that it asks about.
    """

    body: Any
    values: Mapping[Knob, float]


class OrderBook:
    """Keep what is wanted of the knobs, and what is in force.

    Args:
        normal: where each knob stands before any order.
    """

    def __init__(self, normal: Mapping[Knob, float]) -> None:
        self._wanted = dict(normal)
        self._held: dict[Knob, float | None] = dict(normal)
        self._turned: dict[Knob, None] = {}
        self._refused: dict[Knob, float] = {}
        self._said: dict[Knob, str] = {}
        self._doubted: dict[Knob, None] = {}
        self._asked: dict[int, tuple[Order, float]] = {}
        self._stopped: dict[str, None] = {}

    @property
    def turned(self) -> bool:
        """Whether any knob was ever turned."""
        return bool(self._turned)

    def turned_in(self, service: str) -> bool:
        """Return whether any knob of a task that is named as one of this service was ever turned."""
        return any(knob.target.rpartition("/")[0] == service for knob in self._turned)

    def doubt(self) -> None:
        """Doubt every knob: an earlier book may have turned it."""
        for knob in self._wanted:
            self._turned[knob] = None
            self._doubted[knob] = None

    def want(self, values: Mapping[Knob, float]) -> None:
        """Set the wanted values of knobs; `due` then returns what must be ordered."""
        self._wanted.update(values)

    def due(self, now_s: float) -> list[Order]:
        """Return the orders that are due; the caller passes each that it publishes to `asked`.

        Several settings of one task become one order. Knobs in doubt are asked about first.
        """
        for seq in [seq for seq, (_, asked_s) in self._asked.items() if now_s - asked_s > ANSWER_S]:
            del self._asked[seq]
        waiting = {knob: None for order, _ in self._asked.values() for knob in order.values}
        doubts: dict[str, dict[Knob, float]] = {}
        settings: dict[str, dict[Knob, float]] = {}
        orders = []
        for knob, value in self._wanted.items():
            if knob in waiting or knob.target.rpartition("/")[0] in self._stopped:
                continue
            if knob in self._doubted:
                doubts.setdefault(knob.target, {})[knob] = value
            elif _same(self._held[knob], value) or self._refused.get(knob) == value:
                continue
            elif knob.key:
                settings.setdefault(knob.target, {})[knob] = value
            else:
                orders.append(Order(Reschedule(knob.target, value, knob.timer), {knob: value}))
        for target, values in settings.items():
            orders.append(Order(Configure(target, {knob.key: value for knob, value in values.items()}), values))
        return [*orders, *(Order(Describe(target), knobs) for target, knobs in doubts.items())]

    def restore(self, values: Mapping[Knob, float], now_s: float) -> list[Order]:
        """Return all orders that restore knobs, for a task that ends before the replies arrive.

        Whatever is in doubt, or not answered yet, is ordered at once.

        Args:
            values: the values to restore.
            now_s: the mission time.
        """
        for knob in [*self._doubted, *(knob for order, _ in self._asked.values() for knob in order.values)]:
            self._held[knob] = None
        self._doubted.clear()
        self._asked.clear()
        self.want(values)
        return self.due(now_s)

    def asked(self, seq: int, order: Order, now_s: float) -> None:
        """Note that an order was given.

        Args:
            seq: the number of its packet, which the reply names.
            order: the order.
            now_s: the mission time.
        """
        self._asked[seq] = (order, now_s)
        for knob in order.values:
            self._turned[knob] = None
            self._doubted.pop(knob, None)

    def answered(self, seq: int, ok: bool, reason: str, result: Any = None) -> list[str]:
        """Take the reply to an order; replies to anything else are ignored.

        Returns:
            Sentences for people: what was refused, and why, unless that was reported before.
        """
        order, _ = self._asked.pop(seq, (None, 0.0))
        if order is None:
            return []
        if isinstance(order.body, Describe):
            for knob in order.values:
                self._held[knob] = _found(knob, result) if ok else None
            return []
        news = []
        for knob, value in order.values.items():
            if ok:
                self._held[knob] = value
                self._refused.pop(knob, None)
                self._said.pop(knob, None)
                continue
            self._refused[knob] = value
            if self._said.get(knob) != reason:
                self._said[knob] = reason
                news.append(f"{knob} was not set to {value:g}: {reason}")
        return news

    def task_started(self, service: str, task: str) -> None:
        """Note that a task has started: what it refused may work now, and what was in force may be forgotten."""
        for knob in self._wanted:
            if knob.target in (task, f"{service}/{task}"):
                self._refused.pop(knob, None)
                if knob in self._turned:
                    self._doubted[knob] = None

    def service_stopped(self, service: str) -> None:
        """Note that a service has stopped: its tasks, named as `service/task`, get no orders until it runs again."""
        self._stopped[service] = None

    def service_started(self, service: str) -> None:
        """Note that a service runs again."""
        self._stopped.pop(service, None)


class Decider:
    """Decide for a task that adjusts others, and keep the book of its orders.

    Args:
        normal: the value of each knob before any order.
        doubt: whether another decider ran before this one, so that the values of the knobs are not known.

    Attributes:
        book: what was asked of which task.
    """

    def __init__(self, normal: Mapping[Knob, float], doubt: bool) -> None:
        self._normal = dict(normal)
        self.book = OrderBook(normal)
        if doubt:
            self.book.doubt()

    def restore(self, now_s: float) -> list[Order]:
        """Return the orders that restore everything, for a task that is about to stop and gets no more replies."""
        return self.book.restore(self._normal, now_s) if self.book.turned else []

    def asked(self, seq: int, order: Order, now_s: float) -> None:
        """Note that an order was given; see `OrderBook.asked`."""
        self.book.asked(seq, order, now_s)

    def answered(self, seq: int, ok: bool, reason: str, result: Any = None) -> list[str]:
        """Take the reply to an order. Returns sentences for people; see `OrderBook.answered`."""
        return self.book.answered(seq, ok, reason, result)

    def on_event(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Take an event of this agent: tasks and services that start and stop."""
        service = str(fields.get("service", ""))
        if kind == "task_started":
            self.book.task_started(service, str(fields.get("task", "")))
        elif kind == "service_stopped":
            self.book.service_stopped(service)
        elif kind == "service_started":
            self.book.service_started(service)


def _found(knob: Knob, description: Any) -> float | None:
    """Return where a knob stands, by its task's description; None if that does not say."""
    if not isinstance(description, Mapping):
        return None
    if knob.key:
        return _number(description.get("settings", {}).get(knob.key))
    if not knob.timer:
        return _number(description.get("rate_hz"))
    rates = [timer["rate_hz"] for timer in description.get("timers", ()) if timer["timer"] == knob.timer]
    return _number(rates[0]) if rates else None


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None


def _same(held: float | None, wanted: float) -> bool:
    # A rate is kept as a period, and its value returns with a rounding error.
    return held is not None and math.isclose(held, wanted, rel_tol=1e-6)
