"""Migration as users see it: when a task migrates, what it costs, how it is guarded, and the account of it. Pure.

`MigrationRule` says when a task migrates by itself, `Cost` what each neighbour asks for it, and `GuardRule` how many
guardians remember its owner. Cost functions are plug-ins (entry point group `pancakes.costs`; paper §3.4). Costs of
different kinds are compared by weights, as in `cost = { tasks = 1.0, battery = 2.0 }`, so each cost function
documents its unit. A `MigrationReport` says who was asked for a migration, what each answered, who won, and why others
did not.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal

import msgspec
from msgspec.structs import force_setattr, replace

from pancakes.errors import ClassError, MigrationError, describe
from pancakes.packet import packet_type
from pancakes.util.class_checks import Made, check_made, check_marks, check_overrides

CostChoice = str | dict[str, float]
"""What a task is to cost: the name of a cost function, or the weight of each of several."""


class HostLoad(msgspec.Struct, frozen=True):
    """What a cost function may know of the agent that is asked. Everything was measured before; nothing waits.

    Attributes:
        active_tasks: how many tasks run here in the Client Service, and how many slots are kept for arrivals.
        battery_level: what is left of its battery, 0 to 1; None if it has none; NaN if it has one that has not
            been read yet.
        agent_share: processor time that the agent's own process takes, in processors (1: one is busy all the time);
            None if it has not been measured yet. In virtual time 0, for nothing of the wall may enter there.
        host_share: processes that run or wait to run on its computer, for each processor; as above.
        lateness_share: how late the ticks of its time-driven tasks come, in periods on the average (a missed tick
            counts as one period); as above.
        rtt_s: smoothed round trip to the agent that asks; None if it has not been measured yet.
    """

    active_tasks: int
    battery_level: float | None = None
    agent_share: float | None = None
    host_share: float | None = None
    lateness_share: float | None = None
    rtt_s: float | None = None


class CostFacts(msgspec.Struct, frozen=True):
    """All that a cost function may know.

    Attributes:
        load: how busy the agent is that is asked.
        readings: the newest reading of each device type that the function `reads`, as far as this agent has one.
        settings: the settings that the task was given, as plain values. One that has its default may be missing:
            `settings.get(name, default)`.
        state: of the task's state the fields that its class `offers`, as plain values; as of its last checkpoint.
    """

    load: HostLoad
    readings: Mapping[str, Any] = {}
    settings: Mapping[str, Any] = {}
    state: Mapping[str, Any] = {}

    def reading(self, type: str) -> Any:
        """Return the newest reading of a device type.

        Raises:
            MigrationError: there has been none yet; the agent then refuses.
        """
        if type not in self.readings:
            raise MigrationError(f"its {type} has not been read yet")
        return self.readings[type]

    def offered(self, field: str) -> Any:
        """Return a field of the task's state.

        Raises:
            MigrationError: the task does not tell it, or has none yet; the agent then refuses.
        """
        if self.state.get(field) is None:
            raise MigrationError(f"the task does not tell its {field}")
        return self.state[field]


class Cost(ABC):
    """A cost function. The entry point names the class, which is called without arguments, once in each agent.

    Attributes:
        name: its name in `migrate = { cost = "NAME" }`.
        reads: the device types whose readings it needs.
    """

    name: ClassVar[str]
    reads: ClassVar[tuple[str, ...]] = ()
    _made_as: ClassVar[Made] = Made((), "a cost", "`def terms(self, facts)`")

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if `terms` cannot be called as Pancakes calls it, or `reads` is no tuple of names."""
        super().__init_subclass__(**others)
        check_overrides(cls)
        check_marks(cls, "a cost")
        check_made(cls)
        if not isinstance(cls.reads, tuple) or not all(isinstance(it, str) for it in cls.reads):
            raise ClassError(
                f"{cls.__qualname__}.reads is {cls.reads!r}: write a tuple of device types, as `reads = ('pose',)`"
            )

    @abstractmethod
    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        """Return what the cost is made of, by a name for people; their sum is the cost.

        Each must be finite and not negative, else the agent refuses, as it does if the function takes longer than
        0.4 s. It is called in a thread of its own; those of the core in the Task Migrator's.

        Raises:
            MigrationError: the cost cannot be told, for the reason that it says; the agent then refuses.
        """

    def __call__(self, facts: CostFacts) -> float:
        """Return the cost."""
        return math.fsum(self.terms(facts).values())


class ActiveTasks(Cost):
    """The number of active tasks (the paper's)."""

    name = "tasks"

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        return {"active tasks": float(facts.load.active_tasks)}


class EmptyBattery(Cost):
    """What is gone of the battery, from 0 (full, or no battery at all) to 1 (empty)."""

    name = "battery"

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        level = facts.load.battery_level
        if level is None:
            return {"battery used": 0.0}
        if math.isnan(level):
            raise MigrationError("its battery has not been read yet")
        return {"battery used": 1.0 - level}


class ShortReserve(Cost):
    """How short its reserve is: 60 divided by the seconds of its `reserve` reading (0.1: ten minutes; 1: one minute).

    0 if it has no battery. It refuses if it has no reserve: it could not get to a dock at the end of the task.
    """

    name = "reserve"
    reads = ("reserve",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        if facts.load.battery_level is None:
            return {"short reserve": 0.0}
        seconds = facts.reading("reserve").seconds
        if seconds <= 0.0:
            raise MigrationError(f"it must go to a dock itself: its reserve is {seconds:.0f} s")
        return {"short reserve": 60.0 / seconds}


class BusyHost(Cost):
    """How busy it is: processors that the agent takes, load of its computer for each processor, lateness in periods."""

    name = "load"

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        load = facts.load
        if load.agent_share is None or load.host_share is None or load.lateness_share is None:
            raise MigrationError("its load has not been measured yet")
        return {"agent": load.agent_share, "host": load.host_share, "lateness": load.lateness_share}


class RoundTrip(Cost):
    """The measured round trip between the two agents, in seconds."""

    name = "link"

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        if facts.load.rtt_s is None:
            raise MigrationError("its round trip to the source has not been measured yet")
        return {"round trip": facts.load.rtt_s}


class Weighted(Cost):
    """A weighted sum of cost functions.

    Args:
        parts: each function with its weight; None: the core's four, each with the weight 1.
    """

    name = "weighted"

    def __init__(self, parts: Mapping[str, tuple[Cost, float]] | None = None) -> None:
        core = (ActiveTasks(), EmptyBattery(), BusyHost(), RoundTrip())
        self._parts = dict(parts) if parts is not None else {cost.name: (cost, 1.0) for cost in core}

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        return {
            f"{name}: {term}": weight * value
            for name, (cost, weight) in self._parts.items()
            for term, value in cost.terms(facts).items()
        }


CORE: Final = tuple(cost.name for cost in (ActiveTasks, EmptyBattery, BusyHost, RoundTrip, Weighted))
"""The names of the core's own cost functions; they know nothing of the task, and read no device."""


def cost_of(choice: CostChoice, known: Mapping[str, Cost]) -> Cost:
    """Return the cost function that is chosen, among those that are `known` by name.

    Raises:
        MigrationError: one is not known, or a weight is no weight.
    """
    fault = fault_of_choice(choice)
    if fault:
        raise MigrationError(fault)
    for name in names_of(choice):
        if name not in known:
            raise MigrationError(f"knows no cost function {name!r}")
    if isinstance(choice, str):
        return known[choice]
    return Weighted({name: (known[name], weight) for name, weight in choice.items()})


def is_of_core(choice: CostChoice) -> bool:
    """Return whether all cost functions that are chosen are the core's: these wait for nothing."""
    return all(name in CORE for name in names_of(choice))


def names_of(choice: CostChoice) -> tuple[str, ...]:
    """Return the names of the cost functions that are chosen."""
    return (choice,) if isinstance(choice, str) else tuple(choice)


def cost_text(choice: CostChoice) -> str:
    """Return the choice for people: `tasks`, or `1 tasks + 2 battery`."""
    return choice if isinstance(choice, str) else " + ".join(f"{weight:g} {name}" for name, weight in choice.items())


def faults_of_weights(weights: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return (name, problem) for each weight that is none; an empty name means the table as a whole."""
    if not weights:
        return [("", "names no cost function")]
    return [
        (name, f"a weight is a finite number of at least 0, not {weight:g}")
        for name, weight in weights.items()
        if not (math.isfinite(weight) and weight >= 0)
    ]


def fault_of_choice(choice: CostChoice) -> str:
    """Return what is wrong with a choice by itself, whatever functions there are; or an empty string."""
    if isinstance(choice, str):
        return "" if choice else "no cost function is named"
    faults = faults_of_weights(choice)
    return "; ".join(f"cost.{name}: {problem}" if name else f"cost {problem}" for name, problem in faults)


def fault_of(cost: float, terms: Mapping[str, float]) -> str:
    """Return why an answer cannot be compared with others, or an empty string."""
    for name, value in (("cost", cost), *sorted(terms.items())):
        if not math.isfinite(value):
            return f"its {name} is {value}"
        if value < 0:
            return f"its {name} is negative ({value:g})"
    return ""


def appraise(choice: CostChoice, facts: CostFacts, known: Mapping[str, Cost]) -> tuple[Mapping[str, float], str]:
    """Work out what a task would cost.

    Returns:
        What the cost is made of, and why it cannot be told, as a phrase; empty: it can.
    """
    function = f"its cost function {cost_text(choice)!r}"
    try:
        terms = dict(cost_of(choice, known).terms(facts))
        cost = sum(value + 0.0 for value in terms.values())  # an integer beyond all floats raises here
    except MigrationError as error:
        return {}, f"cannot tell its cost: {error}"
    except (Exception, SystemExit) as error:  # a cost function is a plug-in, and may raise anything
        return {}, f"{function} failed: {type(error).__name__}: {error}"
    if not all(isinstance(name, str) and type(value) in (int, float) for name, value in terms.items()):
        return {}, f"{function} told no numbers by name, but {terms!r:.80}"
    if fault := fault_of(cost, terms):
        return {}, f"{function} is of no use: {fault}"
    return terms, ""


AGAIN_S: Final = 60.0
ALLOCATION: Final = "allocation"
"""With this `when` the team decides which agent has the task."""
TAKE_PART: Final = "write `settings = { allocation = { at_most = 3 } }` under [service.network]"
"""How an agent takes part in the team's allocation, for people."""
MOST_UNITS: Final = 1e12
"""The highest value, cost, price or time (s) in an allocation: sums of them are numbers, also if an agent lies."""


class MigrationRule(msgspec.Struct, frozen=True):
    """Moves a task when a reading passes a threshold, or as the team's allocation says.

    Attributes:
        when: the type of the readings to watch, on `system`; `allocation`: the team decides (docs/allocation.md).
        below: moves the task when the field lies below this.
        above: moves the task when the field lies above this.
        field: the field of the reading; empty: `seconds` of a `reserve`, and `level` of all others.
        cost: the cost function that neighbours answer with, or the weight of each of several.
        then: a task to start here once this one has gone; empty: none. Not after a take-over: the agent that had the
            task is silent then.
        otherwise: a task to start here in the place of this one, which is stopped, if no agent can take it; empty:
            it goes on.
        again_s: after no agent could take the task, the rule asks again after this long, in host time. With
            `allocation`: how long an agent that refused the task does not get it.
        value: `allocation`: what it is worth that an agent has the task, in the unit of its cost. An agent to which it
            costs more does not take it.
        move_price: `allocation`: what a migration costs in addition. A smaller gain moves nothing.
        takes_mission_s: `allocation`: how long an agent works at it, in mission seconds, one such task after the
            other; 0: it runs beside others.
        ends_by_mission_s: `allocation`: the mission time at which it must be over; None: none.
        after: `allocation`: names of tasks that must be over before it begins.
        together: `allocation`: names of tasks that other agents must have at the same time.
    """

    when: str
    below: float | None = None
    above: float | None = None
    field: str = ""
    cost: CostChoice = "tasks"
    then: str = ""
    otherwise: str = ""
    again_s: float = AGAIN_S
    value: float = 100.0
    move_price: float = 1.0
    takes_mission_s: float = 0.0
    ends_by_mission_s: float | None = None
    after: tuple[str, ...] = ()
    together: tuple[str, ...] = ()

    @property
    def allocated(self) -> bool:
        """Whether the team decides which agent has the task."""
        return self.when == ALLOCATION

    def __post_init__(self) -> None:
        if not self.field:
            force_setattr(self, "field", "seconds" if self.when == "reserve" else "level")

    @property
    def least_level(self) -> float | None:
        """The battery level at which it moves the task; None: it watches something else."""
        return self.below if self.when == "battery" and self.field == "level" else None

    @property
    def least_reserve_s(self) -> float | None:
        """The reserve, in seconds, at which it moves the task; 0: another field decides. None: no rule on a reserve."""
        if self.when != "reserve":
            return None
        return self.below if self.field == "seconds" and self.below is not None else 0.0

    def met_by(self, reading: object) -> bool:
        """Return whether a reading (a packet's body) asks for a move.

        Raises:
            MigrationError: its field cannot be read.
        """
        try:
            value = reading.get(self.field) if isinstance(reading, dict) else getattr(reading, self.field, None)
        except Exception as error:  # a property of a plug-in's packet may raise anything
            raise MigrationError(f"the {self.field} of {self.when} cannot be read: {describe(error)}") from None
        if not isinstance(value, (int, float)):
            return False
        return (self.below is not None and value < self.below) or (self.above is not None and value > self.above)


SHORTEST_LEASE_S: Final = 2.0
LONGEST_LEASE_S: Final = 600.0
PERMIT_SHARE: Final = 0.9
"""The share of a lease that a permit lasts: the clocks of two agents may differ by 5 % in speed."""
RENEWED: Final = 4
"""How often an owner asks for a lease while one lasts."""


class GuardRule(msgspec.Struct, frozen=True):
    """How agents guard a task: if its agent is lost, another one runs it from its last checkpoint.

    Attributes:
        copies: how many agents, including its own, keep its checkpoints and let one agent at a time run it.
        lease_s: how long after the loss of most guardians it is paused, in host seconds; another agent runs it a little
            later.
        checkpoint_s: how often its state is written to disk if it has changed, in host seconds.
        guardians: agents that become its guardians before others.
        takeover: `ask`: another agent runs it only after `pancakes task recover`.
    """

    copies: Literal[3, 5]
    lease_s: Annotated[float, msgspec.Meta(ge=SHORTEST_LEASE_S, le=LONGEST_LEASE_S)] = 5.0
    checkpoint_s: Annotated[float, msgspec.Meta(ge=0.05, le=3600.0)] = 1.0
    guardians: Annotated[tuple[str, ...], msgspec.Meta(max_length=4)] = ()
    takeover: Literal["auto", "ask"] = "auto"


Answer = Literal["bid", "refused", "silent"]
"""What a neighbour did; a bid that could not be compared, or came late, counts as `refused`."""

Fate = Literal["won", "lost", "failed", "refused", "silent"]
"""What became of it: `lost` to a cheaper bid; `failed` after it was chosen."""


class Line(msgspec.Struct, frozen=True):
    """What one neighbour said, and what became of that.

    Attributes:
        peer: the neighbour.
        answer: what it did.
        fate: what became of it.
        cost: what it asked for; None if it made no bid.
        terms: what that cost was made of.
        reason: why it did not get the task; empty if it did.
        code: of a refusal, the same for programs (`docs/refusals.md`); else empty.
        retry_after_s: of a refusal, after how long it may be worth asking again, in seconds.
    """

    peer: str
    answer: Answer
    fate: Fate
    cost: float | None = None
    terms: Mapping[str, float] = msgspec.field(default_factory=dict)
    reason: str = ""
    code: str = ""
    retry_after_s: float | None = None


@packet_type("migration.ledger")
class MigrationReport(msgspec.Struct, frozen=True):
    """The whole account.

    Attributes:
        task_id: the task, as `birthplace/name`.
        source: the agent that it should have migrated from, or was taken over from.
        asked_by: what asked for the move: an address, `rule`, or `guardians`.
        cost: the cost function that was used, or several with their weights (`1 tasks + 2 battery`).
        outcome: `moved`, `stayed`, `undecided` (still under way) or `dry run`; `fenced` if it did not move, and a
            person set the fence of an actuator of the source to the epoch that it has; `created` and `removed` if it
            began on the source, and if it ended there for good.
        winner: the agent that has it, or (dry run) would get it; empty if none.
        lines: one for each neighbour that was asked, by name.
        duration_s: host time from the first asking to the outcome.
        offer: the epoch under which the task goes on, such as `3@agent2`; empty if that is as before.
        to: the only neighbour to ask; empty: all.
        cause: of a task that was taken over: from which agent and from which checkpoint, as a sentence; else empty.
    """

    task_id: str
    source: str
    asked_by: str
    cost: str
    outcome: Literal["moved", "stayed", "undecided", "dry run", "fenced", "created", "removed"]
    winner: str
    lines: tuple[Line, ...]
    duration_s: float
    offer: str = ""
    to: str = ""
    cause: str = ""

    def moved(self, offer: str) -> MigrationReport:
        """Return the account of a move that was undecided: the task has migrated."""
        return replace(self, outcome="moved", offer=offer)

    def stayed(self, offer: str, reason: str) -> MigrationReport:
        """Return the account of a move that was undecided: it has come to nothing."""
        lines = tuple(
            replace(line, fate="failed", reason=reason) if line.peer == self.winner else line for line in self.lines
        )
        return replace(self, outcome="stayed", winner="", lines=lines, offer=offer)
