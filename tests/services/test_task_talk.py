"""Who asks whom, and in which order, as tasks are created, move, get guardians, are taken over and are removed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from services.talk import Talk

from pancakes.control import Create, Migrate, Remove, Start, Stop
from pancakes.durable.messages import KeepLease, LeaseKept, SeizeTask
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet

KEPT_BY_B_AND_C = [
    *(f"a/client > {other}/Guardian: guard.keep" for other in "bc"),
    *(f"{other}/Guardian > a/client: guard.kept" for other in "bc"),
]
GUARDED = {"guard": 3, "lease_s": 4.0, "checkpoint_s": 2.0}


class Slow(Task):
    @dataclass
    class State:
        n: int = 0

    state: State

    @every(hz=0.5)
    def tick(self, tick: Tick) -> None:
        self.state.n += 1


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Slow": Slow}) as made:
        for name in "abcd":
            made.start(name)
        made.connect()
        yield made


@pytest.fixture
def guarded(fleet: Fleet) -> Fleet:
    """Slow runs on a; b and c guard it."""
    assert fleet.agents["a"].ask(Create("Slow", "test.Slow", keys=GUARDED)).ok
    fleet.run_for(6.0)
    return fleet


def test_creation_asks_all_agents_before_it_tells_them(fleet: Fleet) -> None:
    talk = Talk(fleet)
    assert fleet.agents["a"].ask(Create("Slow", "test.Slow")).ok
    fleet.run_for(0.5)
    assert talk.take("") == [
        *(f"a/Census > {other}/Census: task.ask" for other in "bcd"),
        *(f"{other}/Census > a/Census: task.known" for other in "bcd"),
        "a/client: asked",
        "a/client: task_started",
        "a/client: task_created",
        *(f"a/Census > {other}/Census: task.owned" for other in "bcd"),
    ]


def test_migration_messages_come_in_order(fleet: Fleet) -> None:
    """The task is stopped before the other agent may start it, and only the named agent is asked."""
    a = fleet.agents["a"]
    assert a.ask(Create("Slow", "test.Slow")).ok
    fleet.run_for(1.0)
    talk = Talk(fleet)
    assert a.ask(Migrate("Slow", to="b")).ok
    fleet.run_for(1.0)
    assert talk.take("") == [
        "a/client: migration_asked",
        "a/TaskMigrator > b/TaskMigrator: migration.solicit",
        "b/TaskMigrator: migration_bid",
        "b/TaskMigrator > a/TaskMigrator: migration.bid",
        "a/client > b/client: migration.reserve",
        "b/client > a/client: migration.reserved",
        "a/client: task_frozen",
        "a/client > b/client: migration.transfer",
        "b/client > a/client: migration.prepared",
        "a/client: task_stopped",
        "a/client > b/client: migration.commit",
        "b/client: task_arrived",
        "b/client: task_started",
        "b/client > a/client: migration.activated",
        *(f"b/Census > {other}/Census: task.owned" for other in "acd"),
        "a/client: task_handed_over",
        "a/TaskMigrator: migration",
    ]


def test_guard_is_asked_of_all_and_kept_by_two(fleet: Fleet) -> None:
    """The task has its first permit before it starts; guardians are chosen a second later, and first get its state."""
    talk = Talk(fleet)
    assert fleet.agents["a"].ask(Create("Slow", "test.Slow", keys=GUARDED)).ok
    assert talk.take("permit", "task_started", "guard") == ["a/client: permit_given", "a/client: task_started"]
    fleet.run_for(1.15)
    asked_and_told = [
        *(f"a/client > {other}/Guardian: guard.ask" for other in "bcd"),
        *(f"{other}/Guardian > a/client: guard.can" for other in "bcd"),
    ]
    assert talk.take("guard", "permit") == asked_and_told
    fleet.run_for(0.1)
    # They are told twice: what they are to keep, and that a quorum of them keeps it.
    assert talk.take("guard", "permit") == ["a/client: guards_chosen", *KEPT_BY_B_AND_C, *KEPT_BY_B_AND_C]
    first, *_ = [body for body in talk.bodies() if isinstance(body, KeepLease)]
    assert first.epoch == (1_000_000, "a") and first.body is not None


def test_guard_rhythm(guarded: Fleet) -> None:
    """Guardians hear of the task four times a lease; its state comes only with each checkpoint, and with a number."""
    talk = Talk(guarded)
    guarded.run_for(7.9)
    keeps = [body for body in talk.bodies() if isinstance(body, KeepLease)]
    kept = [body for body in talk.bodies() if isinstance(body, LeaseKept)]
    with_state = [body.checkpoint.no for body in keeps if body.body is not None]
    first = with_state[0]
    assert with_state == [first + n for n in range(3) for _ in "bc"]
    # A beat each second for each of the two, and one more for a checkpoint that falls between two of these.
    beats = sorted({body.beat for body in keeps})
    assert beats == list(range(beats[0], beats[-1] + 1)) and 7 <= len(beats) <= 7 + 3
    assert sorted(body.beat for body in keeps) == sorted(body.beat for body in kept) == sorted(2 * beats)
    assert {body.no for body in kept} == {first - 1, *with_state}


def test_guarded_migration_seizes_the_guardians(guarded: Fleet) -> None:
    """The new owner has the pledges of the guardians, and a permit, before it starts the task."""
    talk = Talk(guarded)
    assert guarded.agents["a"].ask(Migrate("Slow", to="b")).ok
    guarded.run_for(0.5)
    assert talk.take("migration.", "guard", "permit", "task_started", "task_stopped", "task_handed_over") == [
        "a/TaskMigrator > b/TaskMigrator: migration.solicit",
        "b/TaskMigrator > a/TaskMigrator: migration.bid",
        "a/client > b/client: migration.reserve",
        "b/client > a/client: migration.reserved",
        "a/client > b/client: migration.transfer",
        "b/client > a/client: migration.prepared",
        "a/client: task_stopped",
        "a/client > b/Guardian: guard.yield",
        "a/client > b/client: migration.commit",
        "a/client > c/Guardian: guard.yield",
        # a, which it left, guards it in place of b.
        *(f"b/client > {other}/Guardian: guard.seize" for other in "ac"),
        *(f"{other}/Guardian > b/client: guard.pledge" for other in "ac"),
        "b/client > a/Guardian: guard.keep",
        "b/client > a/client: migration.activated",
        "b/client > c/Guardian: guard.keep",
        "a/client: task_handed_over",
        "a/Guardian > b/client: guard.kept",
        "b/client: permit_given",
        "b/client: task_started",
        "c/Guardian > b/client: guard.kept",
    ]
    (epoch,) = {body.epoch for body in talk.bodies() if isinstance(body, SeizeTask)}
    assert epoch == (1_000_002, "b")


TAKEN_OVER = [
    "b/Guardian > c/Guardian: guard.poll",
    "c/Guardian > b/Guardian: guard.seen",
    "b/TaskMigrator > c/TaskMigrator: migration.solicit",
    "b/TaskMigrator > d/TaskMigrator: migration.solicit",
    "c/TaskMigrator > b/TaskMigrator: migration.bid",
    "d/TaskMigrator > b/TaskMigrator: migration.bid",
    "b/client: task_called",
    "b/client > c/Guardian: guard.seize",
    "c/Guardian > b/client: guard.pledge",
    "b/client: task_taken",
    "b/client > c/Guardian: guard.keep",
    "b/Census > c/Census: task.owned",
    "b/Census > d/Census: task.owned",
    "b/Guardian: taken_over",
    "c/Guardian > b/client: guard.kept",
    "b/client: permit_given",
    "b/client: task_started",
]
"""One guardian asks the other, then all that could host the task; the cheapest seizes it, and starts with a permit."""
TOLD = ("migration.", "guard", "permit", "task_called", "task_taken", "task.owned", "taken_over", "task_started")


def test_take_over_of_a_dead_owner_waits_for_the_lease(guarded: Fleet) -> None:
    talk = Talk(guarded)
    guarded.crash("a")
    guarded.run_for(3.9)
    assert talk.take(*TOLD) == []
    guarded.run_for(0.5)
    assert talk.take(*TOLD) == TAKEN_OVER
    (epoch,) = {body.epoch for body in talk.bodies() if isinstance(body, SeizeTask)}
    assert epoch == (1_000_001, "b")


def test_take_over_of_an_ended_owner_does_not_wait(guarded: Fleet) -> None:
    """An agent that ends in good order gives its guardians its last state, and yields the lease."""
    talk = Talk(guarded)
    guarded.stop("a")
    yielded = [f"a/client > {other}/Guardian: guard.{what}" for other in "bc" for what in ("keep", "yield")]
    guarded.run_for(0.5)
    assert talk.take(*TOLD) == yielded + TAKEN_OVER


def test_take_over_after_a_cut_lets_only_one_side_act(guarded: Fleet) -> None:
    """The owner that is cut off loses its permit before the others take over."""
    talk = Talk(guarded)
    guarded.faults.cut("a", off=tuple("bcd"), for_s=20.0)
    guarded.run_for(3.7)  # nine tenths of a lease, and before the next tick of the task
    assert talk.take("permit", "guard.seize", "task_taken") == ["a/client: permit_lost"]
    guarded.run_for(4.0)
    taken = ["b/client > c/Guardian: guard.seize", "b/client: task_taken", "b/client: permit_given"]
    assert talk.take("permit", "guard.seize", "task_taken") == taken


def test_stop_start_and_removal_are_kept_at_once(guarded: Fleet) -> None:
    """Guardians learn of each at once, and no agent but the owner and its guardians has a part in it."""
    a = guarded.agents["a"]
    talk = Talk(guarded)
    assert a.ask(Stop("Slow")).ok
    guarded.run_for(0.1)
    assert talk.take("") == ["a/client: asked", "a/client: task_stopped", *KEPT_BY_B_AND_C]
    guarded.run_for(1.5)
    assert a.ask(Start("Slow")).ok
    talk.take("")
    guarded.run_for(2.5)
    talk.take("")
    assert a.ask(Remove("Slow")).ok
    guarded.run_for(1.0)
    ended, *others = talk.take("task", "guard")
    assert ended == "a/client: task_stopped"
    assert others == [
        *KEPT_BY_B_AND_C,
        "a/client: guards_chosen",
        *KEPT_BY_B_AND_C,
        "a/client: task_removed",
        *KEPT_BY_B_AND_C[:2],
    ]


def test_guard_that_is_thin_is_told_once_and_asked_for_again() -> None:
    """Agents are asked every two seconds until enough can guard it. One that is gone for a minute is replaced."""
    with Fleet(seed=5, classes={"test.Slow": Slow}) as fleet:
        a, _ = fleet.start("a"), fleet.start("b")
        fleet.connect()
        talk = Talk(fleet)
        assert a.ask(Create("Slow", "test.Slow", keys={"guard": 3, "lease_s": 20.0})).ok
        fleet.run_for(6.0)
        asked = ["a/client > b/Guardian: guard.ask", "b/Guardian > a/client: guard.can"]
        assert talk.take("guard") == [*asked, "a/client: guard_thin", *asked, *asked]
        for name in "cd":
            fleet.start(name)
            talk.hear(name)
        fleet.connect()
        fleet.run_for(4.0)
        chosen = [
            *(f"a/client > {other}/Guardian: guard.ask" for other in "bcd"),
            *(f"{other}/Guardian > a/client: guard.can" for other in "bcd"),
            "a/client: guards_chosen",
        ]
        assert talk.take("guard.ask", "guard.can", "guards") == chosen
        fleet.crash("b")
        fleet.run_for(50.0)
        assert talk.take("guard.ask", "guard.can", "guards") == []
        fleet.run_for(25.0)
        assert talk.take("guard.ask", "guard.can", "guards") == [line for line in chosen if "b/" not in line]
