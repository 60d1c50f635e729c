"""A task that does wrong harms itself alone: its service, and the other tasks of that, go on.

What of Pancakes itself fails, fails the test: see docs/testing.md, "What may not fail".
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta, Struct

from pancakes.control import Describe, Migrate, Restart, Start, Stop
from pancakes.packet import packet_type
from pancakes.settings import SettingsError, make_settings
from pancakes.task import Task, Tick, every
from pancakes.testing import AgentHandle, Fleet


@packet_type("bad_tasks.share")
class Share(Struct, frozen=True):
    """A reading with a property that fails."""

    part: float
    whole: float = 0.0

    @property
    def level(self) -> float:
        return self.part / self.whole


@dataclass
class Chain:
    """May contain itself."""

    links: list[Chain] = field(default_factory=list)


class Good(Task):
    """Counts its ticks."""

    @dataclass
    class State:
        n: int = 0

    state: State

    @every(hz=10)
    def tick(self, tick: Tick) -> None:
        self.state.n += 1
        if self.state.n == 12:
            self.do_wrong()

    def do_wrong(self) -> None:
        pass


class Keeps(Good):
    """Keeps what a subclass puts there."""

    @dataclass
    class State:
        n: int = 0
        whole: int = 0
        text: str = ""
        raw: bytes = b""
        chain: Chain = field(default_factory=Chain)

    state: Any


class KeepsALongInteger(Keeps):
    def do_wrong(self) -> None:
        self.state.whole = 2**64


class KeepsASurrogate(Keeps):
    def do_wrong(self) -> None:
        self.state.text = b"\xff".decode(errors="surrogateescape")


class KeepsTooMuch(Keeps):
    def do_wrong(self) -> None:
        self.state.raw = bytes(20 * 1024 * 1024)


class KeepsItself(Keeps):
    def do_wrong(self) -> None:
        self.state.chain.links.append(self.state.chain)


class KeepsAnotherClass(Keeps):
    def do_wrong(self) -> None:
        self.state = Chain()


class HasNoState(Keeps):
    def do_wrong(self) -> None:
        self.state = None


class HasNoSettings(Good):
    def do_wrong(self) -> None:
        self.settings = None


class KeepsWrongTypes(Good):
    """Keeps what can be written down, and not be read again."""

    @dataclass
    class State:
        n: int = 0
        part: Annotated[float, Meta(ge=0, le=1)] = 0.5
        side: Literal["left", "right"] = "left"
        counts: list[int] = field(default_factory=list)

    state: Any


class KeepsNothing(KeepsWrongTypes):
    def do_wrong(self) -> None:
        self.state.side = None


class KeepsTooMuchOfIt(KeepsWrongTypes):
    def do_wrong(self) -> None:
        self.state.part = 3.0


class KeepsAnotherWord(KeepsWrongTypes):
    def do_wrong(self) -> None:
        self.state.side = "up"


class KeepsTextAmongNumbers(KeepsWrongTypes):
    def do_wrong(self) -> None:
        self.state.counts = [1, "two"]


class SetsItsSettingsWrong(Good):
    @dataclass
    class Settings:
        speed: float = 1.0

    def on_start(self) -> None:
        self.settings.speed = None


class CannotBeMadeAgain(Good):
    @dataclass
    class State:
        n: int = 0

        def __post_init__(self) -> None:
            if self.n >= 12:
                raise KeyError("spare")


class ExitsWhereItIsMade(Good):
    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        sys.exit(4)


BAD = [
    KeepsALongInteger,
    KeepsASurrogate,
    KeepsTooMuch,
    KeepsItself,
    KeepsAnotherClass,
    HasNoState,
    HasNoSettings,
    KeepsNothing,
    KeepsTooMuchOfIt,
    KeepsAnotherWord,
    KeepsTextAmongNumbers,
    SetsItsSettingsWrong,
    CannotBeMadeAgain,
    ExitsWhereItIsMade,
]


def with_a_bad_task(fleet: Fleet, cls: type[Task]) -> AgentHandle:
    agent = fleet.start("a", tasks={"Bad": cls, "Good": Good})
    fleet.start("b")
    fleet.connect()
    fleet.run_for(2.5)
    return agent


@pytest.mark.parametrize("asked", [Stop, Restart, Migrate, partial(Describe, state=True), None])
def test_bad_task_harms_no_other(asked: Callable[[str], object] | None) -> None:
    """All bad tasks of one agent together, and whatever is asked of them."""
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={**{cls.__name__: cls for cls in BAD}, "Good": Good})
        fleet.start("b")
        fleet.connect()
        fleet.run_for(2.5)
        for cls in BAD:
            if asked is not None:
                agent.ask(asked(cls.__name__))
        fleet.run_for(1.0)
        good: Good = agent.task("Good")
        assert good.state.n == pytest.approx(10 * fleet.now(), abs=1)
        assert len(agent.events("task_started", task="Good")) == 1


@pytest.mark.parametrize(
    ("cls", "why"),
    [
        (KeepsALongInteger, "state.whole: can't serialize ints"),
        (KeepsASurrogate, "state.text: 'utf-8' codec can't encode character '\\udcff'"),
        (KeepsTooMuch, "the snapshot of a/Bad has"),
        (KeepsAnotherClass, "`self.state` is of the class Chain, and not Keeps.State"),
        (HasNoState, "`self.state` is of the class NoneType, and not Keeps.State"),
        (HasNoSettings, "`self.settings` is of the class NoneType, and not Nothing"),
        (KeepsNothing, "state.side: expected a string, got nothing"),
        (KeepsTooMuchOfIt, "state.part: expected a number <= 1, not 3.0"),
        (KeepsAnotherWord, "state.side: expected one of 'left', 'right', not 'up'"),
        (KeepsTextAmongNumbers, "state.counts[1]: expected an integer, got a string"),
        (SetsItsSettingsWrong, "settings.speed: expected a number, got nothing"),
        (CannotBeMadeAgain, "state: "),
    ],
)
def test_bad_state_is_told_once_with_its_place(cls: type[Task], why: str) -> None:
    with Fleet(1) as fleet:
        agent = with_a_bad_task(fleet, cls)
        fleet.run_for(3.0)
        told = [line for line in agent.lines("error") if "cannot be written down" in line]
        assert len(told) == 1, told
        assert told[0].startswith(f"what a/client/Bad carries cannot be written down: {why}")


@pytest.mark.parametrize("value", [None, "x", 2.5])
def test_bad_state_leaves_the_last_good_checkpoint(value: object) -> None:
    with Fleet(1) as fleet:
        agent = with_a_bad_task(fleet, KeepsWrongTypes)
        agent.task("Bad").reschedule(0.001)  # from here on its state stays as it is
        fleet.run_for(1.5)
        n = agent.task("Bad").state.n
        agent.task("Bad").state.n = value
        fleet.run_for(1.5)
        reply = agent.ask(Migrate("Bad", to="b"))
        assert reply.reason and "state.n: expected an integer" in reply.reason
        fleet.crash("a")
        again = fleet.start("a", tasks={"Bad": KeepsWrongTypes, "Good": Good})
        fleet.run_for(0.05)
        assert again.task("Bad").state.n in (n, n + 1)


def test_bad_state_of_a_record_is_called_state() -> None:
    with pytest.raises(SettingsError, match=r"^bad state for Bad: n: expected an integer"):
        make_settings(Keeps.State, {"n": "x"}, allow_nan=True, owner="Bad", noun="state")


def test_bad_state_that_is_mended_is_written_again() -> None:
    with Fleet(1) as fleet:
        agent = with_a_bad_task(fleet, KeepsALongInteger)
        for _ in range(2):
            agent.task("Bad").state.whole = 3
            fleet.run_for(1.5)
            agent.task("Bad").state.whole = 2**64
            fleet.run_for(1.5)
        assert len([line for line in agent.lines("error") if "cannot be written down" in line]) == 3
        fleet.crash("a")
        again = fleet.start("a", tasks={"Bad": KeepsALongInteger, "Good": Good})
        assert again.task("Bad").state.whole == 3


def test_bad_state_is_told_again_after_it_was_mended() -> None:
    class Flips(Keeps):
        def do_wrong(self) -> None:
            self.reschedule(0.001)  # from here on its state stays as it is

    with Fleet(1) as fleet:
        agent = with_a_bad_task(fleet, Flips)
        for _ in range(2):
            agent.task("Bad").state.whole = 2**64
            fleet.run_for(1.5)
            agent.task("Bad").state.whole = 0
            fleet.run_for(1.5)
        assert len([line for line in agent.lines("error") if "cannot be written down" in line]) == 2


def test_bad_state_at_the_end_loses_to_the_disk() -> None:
    with Fleet(1) as fleet:
        agent = with_a_bad_task(fleet, KeepsALongInteger)
        assert agent.ask(Stop("Bad")).ok
        lost = [line for line in agent.lines("error") if "carried is lost" in line]
        assert len(lost) == 1 and "state.whole: can't serialize ints" in lost[0]
        assert agent.ask(Start("Bad")).ok
        # The last checkpoint was taken before the twelfth tick.
        assert agent.task("Bad").state.n < 12 and agent.task("Bad").state.whole == 0


def test_rule_with_a_bad_reading_asks_again_later() -> None:
    with Fleet(1) as fleet:
        rule = {"when": "bad_tasks.share", "below": 0.5}
        agent = fleet.start("a", tasks={"Good": {"type": Good, "migrate": rule}})
        fleet.start("b")
        fleet.connect()
        for _ in range(3):
            agent.publish("system", Share(1.0))
            fleet.run_for(1.0)
        (told,) = [line for line in agent.lines("warning") if "the rule of" in line]
        assert "could not move it: the level of bad_tasks.share cannot be read: ZeroDivisionError" in told
        fleet.run_for(60.0)
        agent.publish("system", Share(1.0, 4.0))
        fleet.run_for(1.0)
        assert len(agent.events("migration_asked")) == 1
