"""The rules of registers: searched in small scenarios, and each rule that a sentence can tell."""

from __future__ import annotations

import pytest
from register.mutants import MUTANTS
from register.scenarios import IMPOSSIBLE, LIARS, SUITE
from register.search import Search

from pancakes.durable.register import (
    BLANK,
    NO_EPOCH,
    NOBODY,
    Epoch,
    Identity,
    Register,
    Standing,
    Wanted,
    is_quorum,
    standing_of,
)
from pancakes.durable.rules import (
    MOST_STEP,
    Accept,
    Accepted,
    Ask,
    Beat,
    Begin,
    Confirmed,
    Counts,
    Desired,
    Effects,
    Force,
    GiveUp,
    Known,
    Memory,
    Offer,
    Persist,
    Place,
    Prepare,
    Promise,
    Remember,
    Save,
    Send,
    Want,
    desired,
    handle,
    recover,
)

A, B, C = Identity("A"), Identity("B"), Identity("C")
FIRST = Epoch(0, A)
OWNED = Register(FIRST, 0, ((A,),), state="begun", promised=FIRST)
GUARDED = OWNED._replace(sets=((A, B, C),))
QUICK = (
    *("move, letters", "moves of three", "move, stop and start", "wrong word, then a right one"),
    *("a copy that is noticed", "guarded: the owner and a taker", "guarded: a member's disk lost, a letter"),
    *("liar: a stranger, a move", "liar: an old owner's place", "guarded: liar: a stranger, a migration"),
)


def register_after(place: Place, effects: Effects) -> Register:
    """Return the register that is on disk after the effects."""
    return next((it.register for it in reversed(effects) if isinstance(it, Persist)), place.register)


def sent(effects: Effects) -> list[object]:
    return [it.message for it in effects if isinstance(it, Send)]


@pytest.mark.parametrize("title", QUICK)
def test_quick_scenarios_keep_all_promises(title: str):
    (scenario,) = [it for it in (*SUITE, *LIARS) if it.title == title]
    found = Search(scenario).run()
    assert found.verdict == "ok", "\n".join((found.verdict, *found.trace))


@pytest.mark.parametrize("mutant", [it for it in MUTANTS if it.found_in == "move, letters"], ids=lambda it: it.name)
def test_broken_rules_of_a_migration_are_convicted(mutant):
    _, found = mutant.convict(limit=20_000)
    assert found.verdict[:2] in ("S1", "S2", "S3", "S4", "S5", "S6", "S7", "L1") and found.trace


def test_edits_of_all_mutants_are_there():
    assert all(mutant.make() is not None for mutant in MUTANTS)


def test_search_that_is_cut_short_says_so():
    assert Search(SUITE[0], limit=100).run().verdict == "unfinished"


def test_one_liar_among_three_members_makes_two_act():
    """No rules can keep that: it is in each quorum of the other two (docs/security.md)."""
    found = Search(IMPOSSIBLE[0]).run()
    assert found.verdict.startswith("S1")


def test_quorum_is_more_than_half_of_each_set():
    assert is_quorum(((A, B, C),), {A, B}) and not is_quorum(((A, B, C),), {A})
    assert not is_quorum(((A, B, C), (A, C)), {A, B}) and is_quorum(((A, B, C), (A, C)), {A, C})
    assert not is_quorum((), {A})


def test_write_of_an_unguarded_task_counts_at_once():
    effects = handle(Place(A, OWNED), Save("later"))
    assert [it for it in effects if isinstance(it, Counts)] == [Counts(OWNED._replace(no=1, state="later"))]


def test_write_of_a_guarded_task_does_not_count_yet():
    effects = handle(Place(A, GUARDED, Memory(permit=1)), Save("later"))
    assert register_after(Place(A, GUARDED), effects).no == 1
    assert not any(isinstance(it, Counts) for it in effects)


def test_guarded_owner_acts_only_with_a_permit():
    assert desired(A, GUARDED, Memory()) is Desired.PAUSE
    assert desired(A, GUARDED, Memory(permit=1)) is Desired.RUN


def test_offer_pauses_the_task_and_a_later_write_takes_it_back():
    place = Place(A, OWNED)
    offered = register_after(place, handle(place, Offer(B)))
    assert standing_of(A, offered) is Standing.OFFERED and desired(A, offered, Memory()) is Desired.PAUSE
    for event in (GiveUp(), Want(Wanted.STOPPED)):
        back = register_after(place, handle(Place(A, offered, Memory(offered=True)), event))
        assert back.heir == NOBODY and back.no == offered.no + 1
    restarted = recover(Place(A, offered), 0)
    assert register_after(place, restarted).heir == NOBODY


def test_owner_promises_only_its_heir_on_its_newest_write():
    offered = OWNED._replace(no=3, heir=B)
    for epoch, held in ((Epoch(1, C), offered.stamp), (Epoch(1, B), (FIRST, 2)), (Epoch(2, B), (Epoch(1, B), 9))):
        (answer,) = sent(handle(Place(A, offered), Prepare(epoch, held, offered.sets)))
        assert isinstance(answer, Known)
    effects = handle(Place(A, offered), Prepare(Epoch(1, B), offered.stamp, offered.sets))
    assert isinstance(effects[0], Persist) and isinstance(sent(effects)[0], Promise)


def test_word_of_one_agent_neither_pauses_an_owner_nor_destroys_a_state():
    claim = Register(Epoch(5, C), 0, ((C,),))
    given = OWNED._replace(heir=B, promised=Epoch(1, B))
    for register in (OWNED, given):
        assert handle(Place(A, register), Known(C, claim)) == [Ask(Known(C, claim))]
    (asked,) = handle(Place(A, OWNED), Accept(claim._replace(heir=A), 0, A))
    assert isinstance(asked, Ask)
    disputed = register_after(Place(A, OWNED), handle(Place(A, OWNED), Confirmed(Known(C, claim))))
    assert disputed.wanted is Wanted.DISPUTED and disputed.state == "begun"


def test_former_owner_lets_go_on_the_word_of_the_agent_that_has_the_task():
    given = OWNED._replace(heir=B, promised=Epoch(1, B))
    effects = handle(Place(A, given), Known(B, Register(Epoch(1, B), 0, ((B,),))))
    assert standing_of(A, register_after(Place(A, given), effects)) is Standing.RELEASED


def test_epochs_out_of_reach_are_ignored():
    far = Epoch(MOST_STEP + 1, C)
    assert handle(Place(A, OWNED), Known(C, Register(far, 0, ((C,),)))) == []
    assert isinstance(sent(handle(Place(A, GUARDED), Prepare(far, (far, 0), GUARDED.sets)))[0], Known)


def test_begin_is_above_all_epochs_that_are_known():
    begun = register_after(Place(B), handle(Place(B, draw=7), Begin(Epoch(4, A), "new")))
    assert begun.epoch == Epoch(5, B, 7) and begun.unguarded
    assert handle(Place(A, OWNED), Begin(NO_EPOCH, "new")) == [], "it is here already"
    assert standing_of(B, BLANK) is Standing.NONE


def test_word_of_a_person_is_far_above_all_migrations():
    forced = register_after(Place(B), handle(Place(B), Force(Epoch(4, A), "kept")))
    assert forced.epoch.n > 1_000_000 and forced.state == "kept"


def test_beat_asks_no_lease_while_only_the_heir_knows_of_an_offer():
    offered = GUARDED._replace(heir=Identity("D"))
    assert handle(Place(A, offered), Beat(1)) == []
    assert sent(handle(Place(A, GUARDED), Beat(1)))


def test_promise_of_an_agent_that_was_not_asked_changes_nothing():
    taking = Epoch(1, B)
    place = Place(B, GUARDED._replace(promised=FIRST), Memory(taking=taking, asked=GUARDED.sets))
    stranger = Identity("L")
    lie = Register(Epoch(6, stranger), 9, ((stranger,),), state="made up", promised=taking)
    assert handle(place, Promise(taking, stranger, lie)) == []


def test_one_member_that_names_itself_alone_decides_nothing_among_five():
    taking, (d, e) = Epoch(1, B), (Identity("D"), Identity("E"))
    five = GUARDED._replace(sets=((A, B, C, d, e),))
    held = Memory(taking=taking, asked=five.sets, promises=(Promise(taking, B, five),))
    place = Place(B, five._replace(promised=taking), held)
    claim = five._replace(epoch=Epoch(0, A), no=9, sets=((e,),), promised=taking, state="a lie")
    effects = handle(place, Promise(taking, e, claim))
    assert not any(isinstance(it, Persist) for it in effects)
    (asked,) = (it.message for it in effects if isinstance(it, Send))
    assert isinstance(asked, Prepare) and asked.sets == ((e,), *five.sets), "its own members must promise too"


def test_acceptance_of_an_agent_that_is_no_member_pauses_no_owner():
    place = Place(A, GUARDED, Memory(permit=1))
    assert handle(place, Accepted(FIRST, Identity("L"), 0, 99)) == []
    assert handle(place, Accepted(FIRST, B, 0, 99)) == [Remember(Memory(behind=True))]


def test_owner_needs_a_lease_until_its_members_know_that_they_are_none():
    for sets, needs_none in (
        (((A,),), True),
        (((A,), (A, B, C)), True),
        (((A, B, C),), False),
        (((A, B, C), (A,)), False),
    ):
        register = OWNED._replace(sets=sets)
        assert (desired(A, register, Memory()) is Desired.RUN) is needs_none is register.clockless
