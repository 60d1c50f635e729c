"""The tables of the hand-off, row by row: in this phase, on this event, exactly these effects in this order."""

from __future__ import annotations

import random

import pytest
from migration.handoff_samples import (
    ABSENT,
    ASKED,
    BIRTH,
    COMMITTED,
    DROPPED,
    FREEZING,
    FROZEN,
    NEW_OWNER,
    OFFER,
    OWNER,
    PREPARED,
    RELEASED,
    REQUEST,
    REST,
    RUNNING,
    SCAN,
    TAKEN_BACK,
    at_destination,
    at_source,
    from_agent1,
    from_agent2,
)
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.handoff import recover
from pancakes.durable.handoff_events import (
    AdoptionAsked,
    After,
    Arrived,
    AttemptFailed,
    Award,
    Concluded,
    Decline,
    Discard,
    Forward,
    Freeze,
    FreezeFailed,
    Frozen,
    GiveUp,
    HandedOver,
    InDoubt,
    LookForOwner,
    Persist,
    Received,
    Remember,
    Resend,
    ReservationExpired,
    Resume,
    Send,
    StartTask,
    Warn,
)
from pancakes.durable.messages import Abort, Activated, Commit, Nak, Prepared, Reserve, Reserved, Transfer, Unknown
from pancakes.durable.record import Epoch, Phase, Record, Volatile, Wanted

LACKS = Refusal("unsupported", "lacks the device type motors")


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
            AttemptFailed("agent2", Refusal("unable", "did not answer the reservation in time")),
        ]
        # One of an earlier attempt changes nothing.
        assert at_source(OWNER, ASKED, ReservationExpired("agent3", OFFER)) == []
        assert at_source(OWNER, FREEZING, ReservationExpired("agent2", OFFER)) == []

    def test_reserved_refused_is_the_next_bidder_s_turn(self) -> None:
        assert at_source(OWNER, ASKED, from_agent2(Nak(SCAN, OFFER, LACKS))) == [
            Remember(RUNNING),
            AttemptFailed("agent2", LACKS),
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
            AttemptFailed("agent2", Refusal("failed", "the task could not be stopped for it: stuck")),
        ]
        # One of an earlier attempt, or that comes too late, changes nothing.
        assert at_source(OWNER, FREEZING, FreezeFailed(BIRTH, "stuck")) == []
        assert at_source(OWNER, ASKED, FreezeFailed(OFFER, "stuck")) == []
        assert at_source(FROZEN, FREEZING, FreezeFailed(OFFER, "stuck")) == []

    def test_frozen_prepared_is_the_point_of_no_return(self) -> None:
        assert at_source(FROZEN, REST, from_agent2(Prepared(SCAN, OFFER))) == [
            Persist(COMMITTED),
            Discard(),
            Send("agent2", Commit(SCAN, OFFER)),
            After(0.2, Resend(OFFER, Phase.COMMITTED, 0), 0.5),
            After(5.0, InDoubt(OFFER, Phase.COMMITTED)),
        ]

    @pytest.mark.parametrize(
        ("event", "refusal"),
        [
            (Received("agent2", Nak(SCAN, OFFER, LACKS)), LACKS),
            (GiveUp(OFFER, "the link broke"), Refusal("unable", "the link broke")),
        ],
        ids=["NAK", "time is up"],
    )
    def test_frozen_refused_or_late_takes_the_task_back(self, event: object, refusal: Refusal) -> None:
        assert at_source(FROZEN, REST, event) == [
            Persist(TAKEN_BACK),
            Remember(RUNNING),
            Resume(BIRTH, 0, b"as it stopped"),
            Send("agent2", Abort(SCAN, OFFER)),
            AttemptFailed("agent2", refusal),
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
        adopted, *_ = at_source(replace(COMMITTED, sequel=b"then"), REST, AdoptionAsked())
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
            Received("agent2", Nak(SCAN, OFFER, LACKS)),
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
        assert at_source(RELEASED, REST, Arrived()) == [
            Forward("agent2", OFFER),
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


ANSWERS = [Activated(SCAN, OFFER), Nak(SCAN, OFFER, LACKS), Unknown(SCAN, OFFER)]


class TestOthers:
    """An agent that is no party to a hand-off changes nothing of it."""

    @pytest.mark.parametrize("message", [Commit(SCAN, OFFER), Abort(SCAN, OFFER), Unknown(SCAN, OFFER)], ids=repr)
    def test_what_is_prepared_is_given_and_taken_back_by_its_source_alone(self, message: object) -> None:
        assert at_destination(PREPARED, Received("agent3", message)) == []  # type: ignore[arg-type]

    @pytest.mark.parametrize("record", [FROZEN, COMMITTED], ids=["frozen", "committed"])
    @pytest.mark.parametrize(
        "message", [Activated(SCAN, OFFER), Nak(SCAN, OFFER, LACKS), Unknown(SCAN, OFFER)], ids=repr
    )
    def test_what_is_given_away_is_taken_and_declined_by_its_destination_alone(
        self, record: Record, message: object
    ) -> None:
        assert at_source(record, REST, Received("agent3", message)) == []  # type: ignore[arg-type]

    @pytest.mark.parametrize("record", [FROZEN, COMMITTED], ids=["frozen", "committed"])
    def test_another_that_says_it_is_prepared_is_told_to_drop_that(self, record: Record) -> None:
        assert at_source(record, REST, Received("agent3", Prepared(SCAN, OFFER))) == [
            Send("agent3", Abort(SCAN, OFFER))
        ]


class TestDestination:
    @pytest.mark.parametrize("record", [ABSENT, DROPPED], ids=["absent", "released"])
    def test_reserve_is_answered(self, record: Record) -> None:
        assert at_destination(record, from_agent1(Reserve(SCAN, OFFER, REQUEST))) == [
            Send("agent1", Reserved(SCAN, OFFER))
        ]

    def test_reserve_is_refused_where_the_host_has_changed_since_its_bid(self) -> None:
        assert at_destination(ABSENT, from_agent1(Reserve(SCAN, OFFER, REQUEST), LACKS)) == [
            Send("agent1", Nak(SCAN, OFFER, LACKS))
        ]

    def test_transfer_is_on_disk_before_it_is_confirmed(self) -> None:
        assert at_destination(ABSENT, from_agent1(Transfer(SCAN, OFFER, b"as it stopped"))) == [
            Persist(PREPARED),
            Remember(Volatile()),
            Send("agent1", Prepared(SCAN, OFFER)),
            After(0.2, Resend(OFFER, Phase.PREPARED, 0), 0.5),
            After(5.0, InDoubt(OFFER, Phase.PREPARED)),
        ]

    def test_transfer_that_cannot_be_built_is_refused(self) -> None:
        assert at_destination(ABSENT, from_agent1(Transfer(SCAN, OFFER, b"x"), LACKS)) == [
            Send("agent1", Nak(SCAN, OFFER, LACKS))
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
        send, after, look = at_destination(PREPARED, Resend(OFFER, Phase.PREPARED, 0))
        assert send == Send("agent1", Prepared(SCAN, OFFER))
        assert after == After(0.4, Resend(OFFER, Phase.PREPARED, 1), 0.5)
        assert look == LookForOwner()
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


def test_a_resend_is_spread_by_half_each_way() -> None:
    source = random.Random(1)
    drawn = [After(0.2, Resend(OFFER, Phase.FROZEN, 0), 0.5).drawn_s(source) for _ in range(1000)]
    assert 0.1 <= min(drawn) < 0.11 and 0.29 < max(drawn) <= 0.3
    assert After(1.0, ReservationExpired("agent2", OFFER)).drawn_s(source) == 1.0
