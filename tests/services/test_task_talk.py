"""Who asks whom, and in which order, as tasks are created, move, get guardians, are taken over and are removed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from services.talk import Talk

from pancakes.control import Create, Migrate, Remove, Start, Stop
from pancakes.durable.messages import Accept, Accepted, Prepare
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet

KEPT_BY_B_AND_C = [
    *(f"a/Registrar > {other}/Registrar: task.accept" for other in "bc"),
    *(f"{other}/Registrar > a/Registrar: task.accepted" for other in "bc"),
]
ASKED = ("task.may_guard", "task.can_guard")
GUARDED = {"guard": {"copies": 3, "lease_s": 4.0, "checkpoint_s": 2.0}}


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
        *(f"a/Registrar > {other}/Registrar: task.who_has" for other in "bcd"),
        *(f"{other}/Registrar > a/Registrar: task.known" for other in "bcd"),
        "a/client: asked",
        "a/client: task_started",
        "a/client: task_created",
        *(f"a/Registrar > {other}/Registrar: task.known" for other in "bcd"),
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
        "a/TaskMigrator > b/TaskMigrator: migration.solicit",  # which keeps room from here on
        "b/TaskMigrator > a/TaskMigrator: migration.bid",
        "a/client: task_frozen",
        "a/Registrar > b/Registrar: task.accept",
        "b/Registrar > a/Registrar: task.accepted",
        "b/Registrar > a/Registrar: task.prepare",
        "a/client: task_stopped",
        "a/Registrar > b/Registrar: task.promise",
        "b/client: task_arrived",
        "b/client: task_started",
        "b/Registrar > a/Registrar: task.known",
        "b/Registrar > a/Registrar: task.accept",
        *(f"b/Registrar > {other}/Registrar: task.known" for other in "cd"),
        "a/client: task_handed_over",
        "a/TaskMigrator: migration",
    ]


def test_guard_is_asked_of_all_and_kept_by_two(fleet: Fleet) -> None:
    """The task needs no permit until members are chosen, a second later. Then it acts on until they have answered."""
    talk = Talk(fleet)
    assert fleet.agents["a"].ask(Create("Slow", "test.Slow", keys=GUARDED)).ok
    assert talk.take("permit", "task_started", "guard") == ["a/client: task_started"]
    fleet.run_for(1.15)
    asked_and_told = [
        *(f"a/Registrar > {other}/Registrar: task.may_guard" for other in "bcd"),
        *(f"{other}/Registrar > a/Registrar: task.can_guard" for other in "bcd"),
    ]
    assert talk.take("task.may", "task.can", "guard", "permit") == asked_and_told
    fleet.run_for(0.1)
    # They are told twice: what they are to keep, and that a quorum of them keeps it.
    chosen = ["a/Registrar: guards_chosen", *KEPT_BY_B_AND_C, "a/Registrar: permit_given", *KEPT_BY_B_AND_C]
    assert talk.take("task.accept", "guard", "permit") == chosen
    first, *_ = [body for body in talk.bodies() if isinstance(body, Accept)]
    assert first.register.epoch.n == 1_000_000 and first.state is not None


def test_guard_rhythm(guarded: Fleet) -> None:
    """Guardians hear of the task four times a lease; its state comes only with each checkpoint, and with a number."""
    talk = Talk(guarded)
    guarded.run_for(7.9)
    keeps = [body for body in talk.bodies() if isinstance(body, Accept)]
    beats_told = {body.beat for body in keeps}
    kept = [body for body in talk.bodies() if isinstance(body, Accepted) and body.beat in beats_told]
    with_state = [body.register.no for body in keeps if body.state is not None]
    first = with_state[0]
    assert with_state == [first + n for n in range(3) for _ in "bc"]
    # A beat each second for each of the two, and one more for a checkpoint that falls between two of these.
    beats = sorted({body.beat for body in keeps})
    assert beats == list(range(beats[0], beats[-1] + 1)) and 7 <= len(beats) <= 7 + 3
    assert sorted(body.beat for body in keeps) == sorted(body.beat for body in kept) == sorted(2 * beats)
    assert {body.no for body in kept} == {first - 1, *with_state}


def test_guarded_migration_seizes_the_guardians(guarded: Fleet) -> None:
    """The new owner has the promises of a quorum, and a permit, before it starts the task."""
    guarded.run_for(0.5)  # no beat is under way
    talk = Talk(guarded)
    assert guarded.agents["a"].ask(Migrate("Slow", to="b")).ok
    guarded.run_for(0.5)
    lines = talk.take(
        "migration.", "permit", "task.pr", "task_started", "task_stopped", "task_handed_over", "task_frozen"
    )
    assert lines == [
        *("a/TaskMigrator > b/TaskMigrator: migration.solicit", "b/TaskMigrator > a/TaskMigrator: migration.bid") * 2,
        "a/client: task_frozen",
        *(f"b/Registrar > {other}/Registrar: task.prepare" for other in "ac"),
        "a/client: task_stopped",
        *(f"{other}/Registrar > b/Registrar: task.promise" for other in "ac"),
        "a/client: task_handed_over",
        "b/Registrar: permit_given",
        "b/client: task_started",
    ]
    (epoch,) = {body.epoch for body in talk.bodies() if isinstance(body, Prepare)}
    assert (epoch.n, epoch.minter.agent) == (1_000_001, "b")


TAKEN_OVER = [
    "b/Registrar > c/Registrar: task.who_has",
    "c/Registrar > b/Registrar: task.known",
    "b/TaskMigrator > c/TaskMigrator: migration.solicit",
    "b/TaskMigrator > d/TaskMigrator: migration.solicit",
    "c/TaskMigrator > b/TaskMigrator: migration.bid",
    "d/TaskMigrator > b/TaskMigrator: migration.bid",
    "b/Registrar: task_called",
    "b/Registrar > c/Registrar: task.prepare",
    "c/Registrar > b/Registrar: task.promise",
    "b/Registrar: task_taken",
    "b/Registrar: taken_over",
    "b/Registrar > c/Registrar: task.known",
    "b/Registrar > c/Registrar: task.accept",
    "b/Registrar > c/Registrar: task.accept",
    "b/Registrar > d/Registrar: task.known",
    "c/Registrar > b/Registrar: task.accepted",
    "b/Registrar: permit_given",
    "b/client: task_started",
]
"""One member asks the other, then all that could host the task; the cheapest takes it, and starts with a permit."""
TOLD = ("migration.", "guard", "permit", "task_called", "task_taken", "task.", "taken_over", "task_started")


def test_take_over_of_a_dead_owner_waits_for_the_lease(guarded: Fleet) -> None:
    talk = Talk(guarded)
    guarded.crash("a")
    guarded.run_for(3.9)
    assert talk.take(*TOLD) == []
    guarded.run_for(0.5)
    assert talk.take(*TOLD) == TAKEN_OVER
    (epoch,) = {body.epoch for body in talk.bodies() if isinstance(body, Prepare)}
    assert (epoch.n, epoch.minter.agent) == (1_000_001, "b")


def test_take_over_of_an_ended_owner_does_not_wait(guarded: Fleet) -> None:
    """An agent that ends in good order gives its members its last state, and the lease back."""
    guarded.run_for(0.5)  # no beat is under way
    talk = Talk(guarded)
    guarded.stop("a")
    guarded.run_for(0.5)
    lines = [line for line in talk.take(*TOLD) if not line.endswith("a/Registrar: task.accepted")]
    goodbye = [f"a/Registrar > {other}/Registrar: task.accept" for other in "bc"]
    assert lines[-len(TAKEN_OVER) :] == TAKEN_OVER and lines[: -len(TAKEN_OVER)][-2:] == goodbye


def test_take_over_after_a_cut_lets_only_one_side_act(guarded: Fleet) -> None:
    """The owner that is cut off loses its permit before the others take over."""
    talk = Talk(guarded)
    guarded.faults.cut("a", off=tuple("bcd"), for_s=20.0)
    guarded.run_for(3.7)  # nine tenths of a lease, and before the next tick of the task
    assert talk.take("permit", "task.prepare", "task_taken") == ["a/Registrar: permit_lost"]
    guarded.run_for(4.0)
    taken = ["b/Registrar > c/Registrar: task.prepare", "b/Registrar: task_taken", "b/Registrar: permit_given"]
    assert talk.take("permit", "task.prepare", "task_taken") == taken


def test_stop_start_and_removal_are_kept_at_once(guarded: Fleet) -> None:
    """Guardians learn of each at once, and no agent but the owner and its guardians has a part in it."""
    a = guarded.agents["a"]
    guarded.run_for(0.5)  # no beat is under way
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
    assert others.count("a/client: task_removed") == 1 and not any("guards_chosen" in line for line in others)
    assert sorted({*others} - {"a/client: task_removed"}) == sorted(KEPT_BY_B_AND_C)


def test_guard_that_is_thin_is_told_once_and_asked_for_again() -> None:
    """Agents are asked every two seconds until enough can guard it. One that is gone for a minute is replaced."""
    with Fleet(seed=5, classes={"test.Slow": Slow}) as fleet:
        a, _ = fleet.start("a"), fleet.start("b")
        fleet.connect()
        talk = Talk(fleet)
        assert a.ask(Create("Slow", "test.Slow", keys={"guard": {"copies": 3, "lease_s": 20.0}})).ok
        fleet.run_for(6.0)
        asked = ["a/Registrar > b/Registrar: task.may_guard", "b/Registrar > a/Registrar: task.can_guard"]
        assert talk.take("guard", *ASKED) == [*asked, "a/Registrar: guard_thin", *asked, *asked]
        for name in "cd":
            fleet.start(name)
            talk.hear(name)
        fleet.connect()
        fleet.run_for(4.0)
        chosen = [
            *(f"a/Registrar > {other}/Registrar: task.may_guard" for other in "bcd"),
            *(f"{other}/Registrar > a/Registrar: task.can_guard" for other in "bcd"),
            "a/Registrar: guards_chosen",
        ]
        assert talk.take(*ASKED, "guards") == chosen
        fleet.crash("b")
        fleet.run_for(50.0)
        assert talk.take(*ASKED, "guards") == []
        fleet.run_for(25.0)
        assert talk.take(*ASKED, "guards") == [line for line in chosen if "b/" not in line]
