"""The tables of a record on one agent, row by row: births, starts and stops, failed writes, lost records."""

from __future__ import annotations

import pytest
from migration.handoff_samples import (
    ABSENT,
    BIRTH,
    COMMITTED,
    DROPPED,
    FREEZING,
    FROZEN,
    OWNER,
    PREPARED,
    RELEASED,
    REST,
    RUNNING,
    SCAN,
    TAKEN_BACK,
    at_destination,
    at_source,
)
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.handoff import TIMES, recover, would_take
from pancakes.durable.handoff_events import (
    Ack,
    AdoptionAsked,
    After,
    Arrived,
    AttemptFailed,
    Born,
    Checkpoint,
    Decline,
    Deliver,
    Ended,
    ForgettingAsked,
    Forward,
    PacketId,
    Persist,
    PersistFailed,
    Remember,
    Resume,
    RunAsked,
    StartTask,
)
from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Record, Wanted


class TestLifeOnOneAgent:
    def test_a_task_is_born_on_its_birthplace(self) -> None:
        assert at_source(ABSENT, REST, Born(b"new")) == [
            Persist(replace(OWNER, snapshot=b"new")),
            Remember(RUNNING),
            StartTask(BIRTH, 0, b"new"),
        ]

    @pytest.mark.parametrize(
        ("record", "why"),
        [
            (OWNER, "is here already"),
            (FROZEN, "is being handed over to agent2"),
            (COMMITTED, "was given to agent2, which has not yet said that it has it"),
            (RELEASED, "moved to agent2"),
            (PREPARED, "is on its way here from agent1, which has not yet given it away"),
            (DROPPED, "is not here, agent1 had it last"),
        ],
    )
    def test_the_journal_wins_over_start_in_the_configuration(self, record: Record, why: str) -> None:
        assert at_source(record, REST, Born(b"new")) == [Decline(f"agent1/ScanTarget {why}")]

    def test_a_task_of_another_s_is_not_born_here(self) -> None:
        (decline,) = at_destination(ABSENT, Born(b"new"))
        assert decline == Decline("agent1/ScanTarget can be born on agent1 alone, this is agent2")

    def test_a_start_is_refused_with_where_it_moved(self) -> None:
        assert at_source(RELEASED, REST, RunAsked()) == [Decline("agent1/ScanTarget moved to agent2")]

    def test_a_stop_outlives_a_reboot_and_a_start_ends_it(self) -> None:
        stopped = replace(OWNER, wanted=Wanted.STOPPED, snapshot=b"at the end")
        assert at_source(OWNER, RUNNING, Ended(Wanted.STOPPED, b"at the end")) == [Remember(REST), Persist(stopped)]
        assert recover(stopped) == []
        own = replace(stopped, wanted=Wanted.RUNNING, incarnation=1)
        assert at_source(stopped, REST, RunAsked()) == [
            Remember(REST),
            Persist(own),
            Remember(RUNNING),
            StartTask(BIRTH, 1, b"at the end"),
        ]

    def test_a_restart_keeps_the_epoch_and_counts_an_incarnation(self) -> None:
        effects = at_source(OWNER, RUNNING, RunAsked(again=True))
        assert effects[1] == Persist(replace(OWNER, incarnation=1))
        assert effects[3] == StartTask(BIRTH, 1, b"checkpoint")

    def test_a_task_that_runs_is_not_started_twice(self) -> None:
        assert at_source(OWNER, RUNNING, RunAsked()) == [Decline("agent1/ScanTarget runs already")]

    def test_what_was_given_up_is_not_restarted(self) -> None:
        (decline,) = at_source(replace(OWNER, wanted=Wanted.FAILED), REST, RunAsked(again=True))
        assert isinstance(decline, Decline)

    def test_a_stop_breaks_a_hand_off_off(self) -> None:
        effects = at_source(OWNER, FREEZING, Ended(Wanted.STOPPED, b"at the end"))
        # Before the write, which may fail.
        assert effects[1] == AttemptFailed("agent2", Refusal("conflict", "the task was stopped"))

    def test_a_stop_during_the_hand_off_is_refused(self) -> None:
        assert at_source(FROZEN, REST, Ended(Wanted.STOPPED)) == [
            Decline("agent1/ScanTarget is being handed over to agent2")
        ]

    def test_a_packet_is_acknowledged_after_the_checkpoint_that_holds_its_effect(self) -> None:
        packet = PacketId("agent3", 7)
        assert at_source(OWNER, RUNNING, Checkpoint(BIRTH, 0, b"newer", (packet,))) == [
            Persist(replace(OWNER, snapshot=b"newer")),
            Ack(packet),
        ]

    @pytest.mark.parametrize(
        ("record", "checkpoint"),
        [
            (OWNER, Checkpoint(Epoch(5, "agent1"), 0, b"old")),
            (replace(OWNER, incarnation=2), Checkpoint(BIRTH, 1, b"old")),
            (FROZEN, Checkpoint(BIRTH, 0, b"old")),
            (RELEASED, Checkpoint(BIRTH, 0, b"old")),
        ],
        ids=["another epoch", "an earlier incarnation", "frozen", "released"],
    )
    def test_a_checkpoint_that_comes_too_late_is_not_taken(self, record: Record, checkpoint: Checkpoint) -> None:
        assert at_source(record, RUNNING, checkpoint) == []

    def test_a_packet_for_a_task_goes_to_it_or_waits_with_its_sender(self) -> None:
        assert at_source(OWNER, RUNNING, Arrived()) == [Deliver()]
        for record, volatile in ((OWNER, FREEZING), (OWNER, REST), (FROZEN, REST), (COMMITTED, REST), (PREPARED, REST)):
            assert at_source(record, volatile, Arrived()) == []
        assert at_destination(DROPPED, Arrived()) == [Forward("agent1", DROPPED.seen)]

    def test_adoption_by_force_mints_a_new_epoch(self) -> None:
        epoch = Epoch(2, "agent1")
        assert at_source(COMMITTED, REST, AdoptionAsked()) == [
            Persist(Record(SCAN, Phase.OWNER, epoch, epoch, snapshot=b"as it stopped")),
            Remember(RUNNING),
            StartTask(epoch, 0, b"as it stopped"),
        ]
        (decline,) = at_source(RELEASED, REST, AdoptionAsked())
        assert isinstance(decline, Decline)


class TestFailedWrites:
    """Nothing that was to follow has happened; the core goes on from the record that is known to hold."""

    def test_a_task_that_could_not_be_frozen_goes_on(self) -> None:
        assert at_source(OWNER, FREEZING, PersistFailed("disk full", FROZEN)) == [
            Remember(RUNNING),
            Resume(BIRTH, 0, b"checkpoint"),
            AttemptFailed("agent2", Refusal("failed", "disk full")),
        ]

    def test_a_frozen_task_is_taken_back_as_soon_as_the_disk_allows_it(self) -> None:
        (after,) = at_source(FROZEN, REST, PersistFailed("disk full", COMMITTED))
        assert isinstance(after, After) and after.delay_s == TIMES.retry_write_s
        assert at_source(FROZEN, REST, after.event)[0] == Persist(TAKEN_BACK)

    @pytest.mark.parametrize(
        ("record", "wanted"),
        [
            (ABSENT, OWNER),
            (OWNER, replace(OWNER, incarnation=1)),
            (OWNER, replace(OWNER, wanted=Wanted.STOPPED)),
        ],
        ids=["birth", "start", "stop"],
    )
    def test_a_birth_a_start_and_a_stop_are_tried_again(self, record: Record, wanted: Record) -> None:
        remember, after = at_source(record, REST, PersistFailed("disk full", wanted))
        assert isinstance(remember, Remember) and isinstance(after, After)
        run = [Remember(RUNNING), StartTask(BIRTH, wanted.incarnation, b"checkpoint")]
        assert at_source(record, remember.volatile, after.event) == [
            Remember(REST),
            Persist(wanted),
            *(run if wanted.wanted is Wanted.RUNNING else []),
        ]

    def test_a_write_is_not_tried_again_where_somebody_has_decided_otherwise_since(self) -> None:
        stopped = replace(OWNER, wanted=Wanted.STOPPED)
        _, after = at_source(OWNER, REST, PersistFailed("disk full", stopped))
        assert isinstance(after, After)
        assert at_source(replace(OWNER, incarnation=1), RUNNING, after.event) == []

    def test_of_two_decisions_that_could_not_be_written_the_later_one_is_tried_again(self) -> None:
        stopped, started = replace(OWNER, wanted=Wanted.STOPPED), replace(OWNER, incarnation=1)
        _, first = at_source(OWNER, REST, PersistFailed("disk full", stopped))
        remember, second = at_source(OWNER, REST, PersistFailed("disk full", started))
        assert isinstance(remember, Remember) and isinstance(first, After) and isinstance(second, After)
        assert at_source(OWNER, remember.volatile, first.event) == []
        assert Persist(started) in at_source(OWNER, remember.volatile, second.event)

    def test_a_checkpoint_that_failed_is_left_to_the_next_one(self) -> None:
        assert at_source(OWNER, RUNNING, PersistFailed("disk full", OWNER)) == []


class TestLostRecords:
    """What a person decides about a task of which this agent has lost its record."""

    def test_it_is_adopted_under_an_epoch_that_it_cannot_have_reached(self) -> None:
        epoch = Epoch(1_000_003, "agent1")
        own = Record(SCAN, Phase.OWNER, epoch, epoch, snapshot=b"as configured")
        assert at_source(ABSENT, REST, AdoptionAsked(b"as configured", 3, 1_000_000)) == [
            Persist(own),
            Remember(RUNNING),
            StartTask(epoch, 0, b"as configured"),
        ]
        (decline,) = at_source(OWNER, RUNNING, AdoptionAsked(b"as configured", 3, 1_000_000))
        assert isinstance(decline, Decline)

    def test_it_is_forgotten_and_neither_born_nor_started_again_but_may_come_back(self) -> None:
        _, persist = at_source(ABSENT, REST, ForgettingAsked(Epoch(3, "agent2")))
        assert isinstance(persist, Persist)
        forgotten = persist.record
        assert (forgotten.phase, forgotten.seen) == (Phase.ABSENT, Epoch(3, "agent2"))
        for event in (Born(b"anew"), RunAsked()):
            (decline,) = at_source(forgotten, REST, event)
            assert isinstance(decline, Decline)
        assert would_take(forgotten, Epoch(4, "agent2")) and not would_take(forgotten, Epoch(3, "agent2"))

    def test_one_of_which_nothing_is_known_is_not_born_again_either(self) -> None:
        _, persist = at_source(ABSENT, REST, ForgettingAsked(NO_EPOCH))
        assert isinstance(persist, Persist)
        (decline,) = at_source(persist.record, REST, Born(b"anew"))
        assert isinstance(decline, Decline)

    def test_what_is_here_is_not_forgotten(self) -> None:
        (decline,) = at_source(RELEASED, REST, ForgettingAsked(NO_EPOCH))
        assert isinstance(decline, Decline) and "nothing to forget" in decline.reason
