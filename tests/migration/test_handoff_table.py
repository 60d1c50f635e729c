"""The tables of the hand-off, row by row: in this phase, on this event, exactly these effects in this order."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from pancakes.migration.candidate import would_take
from pancakes.migration.core import TIMES, handle, recover
from pancakes.migration.effect import (
    Ack,
    After,
    AttemptFailed,
    Decline,
    Deliver,
    Discard,
    Effect,
    Forward,
    Freeze,
    HandedOver,
    Persist,
    Remember,
    Resume,
    Send,
    StartTask,
    Warn,
)
from pancakes.migration.event import (
    Adopt,
    Arrived,
    Award,
    Born,
    Checkpoint,
    Concluded,
    Ended,
    Forget,
    FreezeFailed,
    Frozen,
    GiveUp,
    InDoubt,
    PacketId,
    PersistFailed,
    Received,
    Resend,
    ReservationExpired,
    Start,
)
from pancakes.migration.messages import (
    Abort,
    Activated,
    Commit,
    Moved,
    Nak,
    Prepared,
    Reserve,
    Reserved,
    Solicit,
    Transfer,
    Unknown,
)
from pancakes.migration.record import NO_EPOCH, Epoch, Phase, Record, TaskId, Wanted
from pancakes.migration.volatile import Volatile

SCAN = TaskId("agent1", "ScanTarget")
REQUEST = Solicit(SCAN, 1, "encirclement.ScanTarget", "0.1.0", "client", ("pose", "motors"))
BIRTH = Epoch(0, "agent1")
OFFER = Epoch(1, "agent1")

REST = Volatile()
RUNNING = Volatile(running=True)
ASKED = Volatile(running=True, asked="agent2")
FREEZING = Volatile(running=True, asked="agent2", freezing=True)

OWNER = Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"checkpoint")
FROZEN = Record(SCAN, Phase.FROZEN, BIRTH, OFFER, OFFER, "agent2", snapshot=b"as it stopped")
COMMITTED = replace(FROZEN, phase=Phase.COMMITTED)
RELEASED = Record(SCAN, Phase.RELEASED, BIRTH, OFFER, NO_EPOCH, "agent2")
TAKEN_BACK = Record(SCAN, Phase.OWNER, BIRTH, OFFER, snapshot=b"as it stopped")

ABSENT = Record(SCAN)
PREPARED = Record(SCAN, Phase.PREPARED, NO_EPOCH, OFFER, OFFER, "agent1", snapshot=b"as it stopped")
NEW_OWNER = Record(SCAN, Phase.OWNER, OFFER, OFFER, snapshot=b"as it stopped")
DROPPED = Record(SCAN, Phase.ABSENT, NO_EPOCH, OFFER, NO_EPOCH, "agent1")


def at_source(record: Record, volatile: Volatile, event: object) -> list[Effect]:
    return handle("agent1", record, volatile, event)  # type: ignore[arg-type]


def at_destination(record: Record, event: object, volatile: Volatile = REST) -> list[Effect]:
    return handle("agent2", record, volatile, event)  # type: ignore[arg-type]


def from_agent2(message: object) -> Received:
    return Received("agent2", message)  # type: ignore[arg-type]


def from_agent1(message: object, refusal: str = "") -> Received:
    return Received("agent1", message, refusal)  # type: ignore[arg-type]


class TestSource:
    def test_owner_bids_compared_asks_for_a_reservation_and_runs_on(self) -> None:
        assert at_source(OWNER, RUNNING, Award("agent2", REQUEST)) == [
            Remember(ASKED),
            Send("agent2", Reserve(SCAN, OFFER, REQUEST)),
            After(1.0, ReservationExpired("agent2", OFFER)),
        ]

    def test_owner_that_is_already_handing_over_declines_another_award(self) -> None:
        (decline,) = at_source(OWNER, ASKED, Award("agent3", REQUEST))
        assert decline == Decline("agent1/ScanTarget is already being handed over to agent2")

    def test_a_task_that_does_not_run_is_not_given_away(self) -> None:
        for record in (OWNER, FROZEN, COMMITTED, RELEASED):
            (decline,) = at_source(record, REST, Award("agent2", REQUEST))
            assert isinstance(decline, Decline)

    def test_reserved_not_answered_in_time_is_the_next_bidder_s_turn(self) -> None:
        assert at_source(OWNER, ASKED, ReservationExpired("agent2", OFFER)) == [
            Remember(RUNNING),
            AttemptFailed("agent2", "did not answer the reservation in time"),
        ]
        # One of an earlier attempt changes nothing.
        assert at_source(OWNER, ASKED, ReservationExpired("agent3", OFFER)) == []
        assert at_source(OWNER, FREEZING, ReservationExpired("agent2", OFFER)) == []

    def test_reserved_refused_is_the_next_bidder_s_turn(self) -> None:
        assert at_source(OWNER, ASKED, from_agent2(Nak(SCAN, OFFER, "lacks the device type motors"))) == [
            Remember(RUNNING),
            AttemptFailed("agent2", "lacks the device type motors"),
        ]

    def test_owner_reserved_stops_the_task(self) -> None:
        assert at_source(OWNER, ASKED, from_agent2(Reserved(SCAN, OFFER))) == [Remember(FREEZING), Freeze(OFFER)]

    @pytest.mark.parametrize(
        "event",
        [
            Received("agent3", Reserved(SCAN, OFFER)),
            Received("agent2", Reserved(SCAN, Epoch(7, "agent1"))),
            Received("agent2", Reserved(SCAN, Epoch(1, "agent3"))),
        ],
        ids=["another's", "another number", "another minter"],
    )
    def test_a_reservation_that_was_not_asked_for_is_ignored(self, event: Received) -> None:
        assert at_source(OWNER, ASKED, event) == []
        assert at_source(OWNER, RUNNING, from_agent2(Reserved(SCAN, OFFER))) == []

    def test_stopped_is_written_down_with_its_snapshot_before_it_is_sent(self) -> None:
        effects = at_source(OWNER, FREEZING, Frozen(OFFER, b"as it stopped"))
        assert effects[:3] == [
            Persist(FROZEN),
            Remember(REST),
            Send("agent2", Transfer(SCAN, OFFER, b"as it stopped")),
        ]
        resend, give_up = effects[3:]
        assert resend == After(pytest.approx(0.2, abs=1e-3), Resend(OFFER, Phase.FROZEN, 0), 0.5)
        assert isinstance(give_up, After) and isinstance(give_up.event, GiveUp)
        assert give_up.delay_s == pytest.approx(2.0, abs=1e-3)

    def test_a_large_snapshot_gets_the_time_to_travel(self) -> None:
        size = 4 * 1024 * 1024
        *_, resend, give_up = at_source(OWNER, FREEZING, Frozen(OFFER, bytes(size)))
        assert isinstance(resend, After) and resend.delay_s == pytest.approx(4.2)
        assert isinstance(give_up, After) and give_up.delay_s == pytest.approx(6.0)

    def test_a_task_that_cannot_be_stopped_goes_on(self) -> None:
        assert at_source(OWNER, FREEZING, FreezeFailed(OFFER, "stuck")) == [
            Remember(RUNNING),
            AttemptFailed("agent2", "the task could not be stopped for it: stuck"),
        ]

    def test_frozen_prepared_is_the_point_of_no_return(self) -> None:
        assert at_source(FROZEN, REST, from_agent2(Prepared(SCAN, OFFER))) == [
            Persist(COMMITTED),
            Discard(),
            Send("agent2", Commit(SCAN, OFFER)),
            After(0.2, Resend(OFFER, Phase.COMMITTED, 0), 0.5),
            After(5.0, InDoubt(OFFER, Phase.COMMITTED)),
        ]

    @pytest.mark.parametrize(
        ("event", "reason"),
        [
            (Received("agent2", Nak(SCAN, OFFER, "the plug-in fails to load")), "the plug-in fails to load"),
            (GiveUp(OFFER, "the link broke"), "the link broke"),
        ],
        ids=["NAK", "time is up"],
    )
    def test_frozen_refused_or_late_takes_the_task_back(self, event: object, reason: str) -> None:
        assert at_source(FROZEN, REST, event) == [
            Persist(TAKEN_BACK),
            Remember(RUNNING),
            Resume(BIRTH, 0, b"as it stopped"),
            Send("agent2", Abort(SCAN, OFFER)),
            AttemptFailed("agent2", reason),
        ]

    def test_frozen_repeats_the_transfer_at_a_steady_pace(self) -> None:
        for attempt in (0, 5):
            send, after = at_source(FROZEN, REST, Resend(OFFER, Phase.FROZEN, attempt))
            assert send == Send("agent2", Transfer(SCAN, OFFER, b"as it stopped"))
            assert isinstance(after, After)
            assert after.event == Resend(OFFER, Phase.FROZEN, attempt + 1)
            assert after.delay_s == pytest.approx(0.2, abs=1e-3)

    def test_committed_activated_leaves_a_tombstone_and_drops_the_snapshot(self) -> None:
        assert at_source(COMMITTED, REST, from_agent2(Activated(SCAN, OFFER))) == [
            Persist(RELEASED),
            HandedOver("agent2", OFFER),
        ]

    def test_what_is_to_follow_lies_in_the_record_until_it_has_been_done(self) -> None:
        persist, *_ = at_source(OWNER, FREEZING, Frozen(OFFER, b"as it stopped", b"then"))
        assert isinstance(persist, Persist) and persist.record == replace(FROZEN, sequel=b"then")
        persist, *_ = at_source(replace(FROZEN, sequel=b"then"), REST, from_agent2(Prepared(SCAN, OFFER)))
        assert persist == Persist(replace(COMMITTED, sequel=b"then"))
        released = replace(RELEASED, sequel=b"then")
        assert at_source(replace(COMMITTED, sequel=b"then"), REST, from_agent2(Activated(SCAN, OFFER))) == [
            Persist(released),
            HandedOver("agent2", OFFER),
        ]
        # Where the agent is started anew before it was done, it is told again.
        assert recover(released) == [HandedOver("agent2", OFFER)]
        assert at_source(released, REST, Concluded()) == [Persist(RELEASED)]

    def test_nothing_follows_a_hand_over_that_came_to_nothing(self) -> None:
        persist, *_ = at_source(replace(FROZEN, sequel=b"then"), REST, GiveUp(OFFER, "the link broke"))
        assert persist == Persist(TAKEN_BACK)
        persist, *_ = recover(replace(FROZEN, sequel=b"then"))
        assert persist == Persist(TAKEN_BACK)
        adopted, *_ = at_source(replace(COMMITTED, sequel=b"then"), REST, Adopt())
        assert isinstance(adopted, Persist) and adopted.record.sequel == b""

    @pytest.mark.parametrize("record", [OWNER, FROZEN, COMMITTED, RELEASED, PREPARED])
    def test_nothing_is_concluded_where_nothing_was_to_follow(self, record: Record) -> None:
        assert at_source(record, REST, Concluded()) == []

    def test_committed_repeats_the_commit_ever_more_slowly_and_for_ever(self) -> None:
        pauses_s = []
        for attempt in (0, 1, 2, 3, 4, 5, 1000):
            send, after = at_source(COMMITTED, REST, Resend(OFFER, Phase.COMMITTED, attempt))
            assert send == Send("agent2", Commit(SCAN, OFFER))
            assert isinstance(after, After)
            pauses_s.append(after.delay_s)
        assert pauses_s == [0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]

    def test_committed_warns_after_five_seconds(self) -> None:
        (warn,) = at_source(COMMITTED, REST, InDoubt(OFFER, Phase.COMMITTED))
        assert isinstance(warn, Warn) and "agent2" in warn.text
        assert at_source(RELEASED, REST, InDoubt(OFFER, Phase.COMMITTED)) == []

    def test_committed_says_commit_again_where_it_is_asked_again(self) -> None:
        assert at_source(COMMITTED, REST, from_agent2(Prepared(SCAN, OFFER))) == [Send("agent2", Commit(SCAN, OFFER))]

    @pytest.mark.parametrize(
        "event",
        [
            Received("agent2", Nak(SCAN, OFFER, "too late")),
            GiveUp(OFFER, "time is up"),
            Received("agent2", Reserved(SCAN, OFFER)),
            Received("agent3", Activated(SCAN, OFFER)),
            Received("agent2", Activated(SCAN, Epoch(9, "agent1"))),
            Resend(OFFER, Phase.FROZEN, 3),
        ],
        ids=["NAK", "time is up", "RESERVED", "ACTIVATED by another", "ACTIVATED of another", "timer of FROZEN"],
    )
    def test_committed_ignores_what_is_stale(self, event: object) -> None:
        assert at_source(COMMITTED, REST, event) == []

    def test_committed_tells_people_that_the_other_side_lost_its_disk(self) -> None:
        (warn,) = at_source(COMMITTED, REST, from_agent2(Unknown(SCAN, OFFER)))
        assert isinstance(warn, Warn) and "agent2 has lost its disk" in warn.text

    def test_released_says_where_the_task_is_and_forwards(self) -> None:
        assert at_source(RELEASED, REST, Arrived("agent3")) == [
            Send("agent3", Moved(SCAN, "agent2", OFFER)),
            Forward("agent2"),
        ]

    @pytest.mark.parametrize("record", [RELEASED, TAKEN_BACK], ids=["released", "taken back"])
    def test_prepared_of_an_offer_that_is_past_is_aborted(self, record: Record) -> None:
        assert at_source(record, REST, from_agent2(Prepared(SCAN, OFFER))) == [Send("agent2", Abort(SCAN, OFFER))]

    def test_prepared_of_an_offer_that_nobody_remembers_is_unknown(self) -> None:
        send, warn = at_source(OWNER, RUNNING, from_agent2(Prepared(SCAN, OFFER)))
        assert send == Send("agent2", Unknown(SCAN, OFFER))
        assert isinstance(warn, Warn)

    def test_prepared_of_another_s_offer_is_ignored(self) -> None:
        assert at_source(OWNER, RUNNING, from_agent2(Prepared(SCAN, Epoch(1, "agent3")))) == []


class TestDestination:
    @pytest.mark.parametrize("record", [ABSENT, DROPPED], ids=["absent", "released"])
    def test_reserve_is_answered(self, record: Record) -> None:
        assert at_destination(record, from_agent1(Reserve(SCAN, OFFER, REQUEST))) == [
            Send("agent1", Reserved(SCAN, OFFER))
        ]

    def test_reserve_is_refused_where_the_host_has_changed_since_its_bid(self) -> None:
        assert at_destination(ABSENT, from_agent1(Reserve(SCAN, OFFER, REQUEST), "has a task of that name")) == [
            Send("agent1", Nak(SCAN, OFFER, "has a task of that name"))
        ]

    def test_transfer_is_on_disk_before_it_is_confirmed(self) -> None:
        assert at_destination(ABSENT, from_agent1(Transfer(SCAN, OFFER, b"as it stopped"))) == [
            Persist(PREPARED),
            Send("agent1", Prepared(SCAN, OFFER)),
            After(0.2, Resend(OFFER, Phase.PREPARED, 0), 0.5),
            After(5.0, InDoubt(OFFER, Phase.PREPARED)),
        ]

    def test_transfer_that_cannot_be_built_is_refused(self) -> None:
        assert at_destination(ABSENT, from_agent1(Transfer(SCAN, OFFER, b"x"), "the plug-in fails to load")) == [
            Send("agent1", Nak(SCAN, OFFER, "the plug-in fails to load"))
        ]

    def test_a_higher_offer_replaces_one_that_is_held(self) -> None:
        higher = Epoch(2, "agent1")
        persist, *_ = at_destination(PREPARED, from_agent1(Transfer(SCAN, higher, b"later")))
        assert persist == Persist(replace(PREPARED, seen=higher, offer=higher, snapshot=b"later"))

    def test_transfer_again_is_confirmed_again(self) -> None:
        assert at_destination(PREPARED, from_agent1(Transfer(SCAN, OFFER, b"as it stopped"))) == [
            Send("agent1", Prepared(SCAN, OFFER))
        ]

    @pytest.mark.parametrize("record", [NEW_OWNER, DROPPED], ids=["owner", "dropped"])
    def test_transfer_of_an_offer_that_is_past_is_ignored(self, record: Record) -> None:
        assert at_destination(record, from_agent1(Transfer(SCAN, OFFER, b"as it stopped"))) == []

    def test_commit_makes_it_the_owner_on_disk_then_in_deed_then_it_says_so(self) -> None:
        assert at_destination(PREPARED, from_agent1(Commit(SCAN, OFFER))) == [
            Persist(NEW_OWNER),
            Remember(RUNNING),
            StartTask(OFFER, 0, b"as it stopped", fresh=True),
            Send("agent1", Activated(SCAN, OFFER)),
        ]

    @pytest.mark.parametrize("record", [NEW_OWNER, DROPPED], ids=["owner", "moved on"])
    def test_commit_again_is_answered_again(self, record: Record) -> None:
        assert at_destination(record, from_agent1(Commit(SCAN, OFFER))) == [Send("agent1", Activated(SCAN, OFFER))]

    def test_commit_of_an_offer_that_nobody_remembers_is_unknown(self) -> None:
        send, warn = at_destination(ABSENT, from_agent1(Commit(SCAN, OFFER)))
        assert send == Send("agent1", Unknown(SCAN, OFFER))
        assert isinstance(warn, Warn)

    def test_abort_drops_the_snapshot_and_remembers_what_was_seen(self) -> None:
        assert at_destination(PREPARED, from_agent1(Abort(SCAN, OFFER))) == [Persist(DROPPED), Discard()]

    @pytest.mark.parametrize("record", [NEW_OWNER, ABSENT, DROPPED], ids=["owner", "absent", "dropped"])
    def test_abort_changes_nothing_elsewhere(self, record: Record) -> None:
        assert at_destination(record, from_agent1(Abort(SCAN, OFFER))) == []

    def test_prepared_never_drops_by_itself_but_asks_and_warns(self) -> None:
        send, after = at_destination(PREPARED, Resend(OFFER, Phase.PREPARED, 0))
        assert send == Send("agent1", Prepared(SCAN, OFFER))
        assert after == After(0.4, Resend(OFFER, Phase.PREPARED, 1), 0.5)
        (warn,) = at_destination(PREPARED, InDoubt(OFFER, Phase.PREPARED))
        assert isinstance(warn, Warn) and "agent1" in warn.text
        assert at_destination(PREPARED, GiveUp(OFFER, "time is up")) == []


class TestRestart:
    def test_owner_runs_from_its_checkpoint(self) -> None:
        assert recover(OWNER) == [Remember(RUNNING), StartTask(BIRTH, 0, b"checkpoint")]

    @pytest.mark.parametrize("wanted", [Wanted.STOPPED, Wanted.FAILED])
    def test_what_was_stopped_stays_stopped(self, wanted: Wanted) -> None:
        assert recover(replace(OWNER, wanted=wanted)) == []

    def test_frozen_is_presumed_aborted(self) -> None:
        assert recover(FROZEN) == [Persist(TAKEN_BACK), Remember(RUNNING), StartTask(BIRTH, 0, b"as it stopped")]

    def test_committed_stays_in_doubt_and_sends_again(self) -> None:
        assert recover(COMMITTED) == [
            Send("agent2", Commit(SCAN, OFFER)),
            After(0.2, Resend(OFFER, Phase.COMMITTED, 0), 0.5),
            After(5.0, InDoubt(OFFER, Phase.COMMITTED)),
        ]

    def test_prepared_stays_dormant_and_sends_again(self) -> None:
        assert recover(PREPARED) == [
            Send("agent1", Prepared(SCAN, OFFER)),
            After(0.2, Resend(OFFER, Phase.PREPARED, 0), 0.5),
            After(5.0, InDoubt(OFFER, Phase.PREPARED)),
        ]

    @pytest.mark.parametrize("record", [ABSENT, RELEASED], ids=["absent", "released"])
    def test_the_others_have_nothing_to_do(self, record: Record) -> None:
        assert recover(record) == []


class TestLifeOnOneAgent:
    def test_a_task_is_born_on_its_birthplace(self) -> None:
        assert at_source(ABSENT, REST, Born(b"new")) == [
            Persist(replace(OWNER, snapshot=b"new")),
            Remember(RUNNING),
            StartTask(BIRTH, 0, b"new"),
        ]

    @pytest.mark.parametrize(
        ("record", "moved_to"),
        [(OWNER, ""), (FROZEN, ""), (COMMITTED, "agent2"), (RELEASED, "agent2"), (PREPARED, ""), (DROPPED, "agent1")],
        ids=lambda value: value.phase.value if isinstance(value, Record) else None,
    )
    def test_the_journal_wins_over_start_in_the_configuration(self, record: Record, moved_to: str) -> None:
        (decline,) = at_source(record, REST, Born(b"new"))
        assert isinstance(decline, Decline)
        assert decline.moved_to == moved_to

    def test_a_task_of_another_s_is_not_born_here(self) -> None:
        (decline,) = at_destination(ABSENT, Born(b"new"))
        assert decline == Decline("agent1/ScanTarget can be born on agent1 alone, this is agent2")

    def test_a_start_is_refused_with_where_it_moved(self) -> None:
        assert at_source(RELEASED, REST, Start()) == [Decline("agent1/ScanTarget moved to agent2", "agent2")]

    def test_a_stop_outlives_a_reboot_and_a_start_ends_it(self) -> None:
        stopped = replace(OWNER, wanted=Wanted.STOPPED, snapshot=b"at the end")
        assert at_source(OWNER, RUNNING, Ended(Wanted.STOPPED, b"at the end")) == [Remember(REST), Persist(stopped)]
        assert recover(stopped) == []
        own = replace(stopped, wanted=Wanted.RUNNING, incarnation=1)
        assert at_source(stopped, REST, Start()) == [
            Remember(REST),
            Persist(own),
            Remember(RUNNING),
            StartTask(BIRTH, 1, b"at the end"),
        ]

    def test_a_restart_keeps_the_epoch_and_counts_an_incarnation(self) -> None:
        effects = at_source(OWNER, RUNNING, Start(again=True))
        assert effects[1] == Persist(replace(OWNER, incarnation=1))
        assert effects[3] == StartTask(BIRTH, 1, b"checkpoint")

    def test_a_task_that_runs_is_not_started_twice(self) -> None:
        assert at_source(OWNER, RUNNING, Start()) == [Decline("agent1/ScanTarget runs already")]

    def test_what_was_given_up_is_not_restarted(self) -> None:
        (decline,) = at_source(replace(OWNER, wanted=Wanted.FAILED), REST, Start(again=True))
        assert isinstance(decline, Decline)

    def test_a_stop_breaks_a_hand_off_off(self) -> None:
        *_, last = at_source(OWNER, FREEZING, Ended(Wanted.STOPPED, b"at the end"))
        assert last == AttemptFailed("agent2", "the task was stopped")

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
        assert at_source(OWNER, RUNNING, Arrived("agent3")) == [Deliver()]
        for record, volatile in ((OWNER, FREEZING), (OWNER, REST), (FROZEN, REST), (COMMITTED, REST), (PREPARED, REST)):
            assert at_source(record, volatile, Arrived("agent3")) == []
        assert at_destination(DROPPED, Arrived("agent3"))[-1] == Forward("agent1")

    def test_adoption_by_force_mints_a_new_epoch(self) -> None:
        epoch = Epoch(2, "agent1")
        assert at_source(COMMITTED, REST, Adopt()) == [
            Persist(Record(SCAN, Phase.OWNER, epoch, epoch, snapshot=b"as it stopped")),
            Remember(RUNNING),
            StartTask(epoch, 0, b"as it stopped"),
        ]
        (decline,) = at_source(RELEASED, REST, Adopt())
        assert isinstance(decline, Decline)


class TestFailedWrites:
    """Nothing that was to follow has happened; the core goes on from the record that is known to hold."""

    def test_a_task_that_could_not_be_frozen_goes_on(self) -> None:
        assert at_source(OWNER, FREEZING, PersistFailed("disk full", FROZEN)) == [
            Remember(RUNNING),
            Resume(BIRTH, 0, b"checkpoint"),
            AttemptFailed("agent2", "disk full"),
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
        assert at_source(ABSENT, REST, Adopt(b"as configured", 3, 1_000_000)) == [
            Persist(own),
            Remember(RUNNING),
            StartTask(epoch, 0, b"as configured"),
        ]
        (decline,) = at_source(OWNER, RUNNING, Adopt(b"as configured", 3, 1_000_000))
        assert isinstance(decline, Decline)

    def test_it_is_forgotten_and_neither_born_nor_started_again_but_may_come_back(self) -> None:
        _, persist = at_source(ABSENT, REST, Forget(Epoch(3, "agent2")))
        assert isinstance(persist, Persist)
        forgotten = persist.record
        assert (forgotten.phase, forgotten.seen) == (Phase.ABSENT, Epoch(3, "agent2"))
        for event in (Born(b"anew"), Start()):
            (decline,) = at_source(forgotten, REST, event)
            assert isinstance(decline, Decline)
        assert would_take(forgotten, Epoch(4, "agent2")) and not would_take(forgotten, Epoch(3, "agent2"))

    def test_one_of_which_nothing_is_known_is_not_born_again_either(self) -> None:
        _, persist = at_source(ABSENT, REST, Forget(NO_EPOCH))
        assert isinstance(persist, Persist)
        (decline,) = at_source(persist.record, REST, Born(b"anew"))
        assert isinstance(decline, Decline)

    def test_what_is_here_is_not_forgotten(self) -> None:
        (decline,) = at_source(RELEASED, REST, Forget(NO_EPOCH))
        assert isinstance(decline, Decline) and "nothing to forget" in decline.reason


def test_a_resend_is_spread_by_half_each_way() -> None:
    source = random.Random(1)
    drawn = [After(0.2, Resend(OFFER, Phase.FROZEN, 0), 0.5).drawn_s(source) for _ in range(1000)]
    assert 0.1 <= min(drawn) < 0.11 and 0.29 < max(drawn) <= 0.3
    assert After(1.0, ReservationExpired("agent2", OFFER)).drawn_s(source) == 1.0
