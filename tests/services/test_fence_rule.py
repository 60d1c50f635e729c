"""Who may raise the fence of an actuator, and to what a person may set it."""

import pytest

from pancakes.durable.ownership import TaskAt, whereabouts
from pancakes.durable.record import Epoch, Phase, Record, TaskId
from pancakes.packet import Fence
from pancakes.services.fence_rule import (
    MOST_ASKED,
    MOST_STEP,
    MOST_TASKS,
    AskAgent,
    ClaimRefused,
    EpochClaim,
    Mark,
    May,
    PresentOwner,
    answered,
    judged,
    present_owner,
)

TASK = TaskId("b", "T")


def marks(mark):
    return {"b/T": mark} if mark is not None else {}


def claim(peer, n=3, task_id="b/T"):
    return EpochClaim(Fence(task_id, (n, "x")), peer)


def record(phase, peer="", n=1):
    return Record(TASK, phase, Epoch(n, "x"), Epoch(n, "x"), offer=Epoch(n, "x"), peer=peer)


@pytest.mark.parametrize(
    ("peer", "mark", "known"),
    [
        ("me", None, None),
        ("me", None, record(Phase.RELEASED, "c")),
        ("b", None, None),  # where it was born
        ("b", Mark(2, "c", "c"), None),
        ("c", Mark(2, "x", "c"), None),  # which brought the last epoch
        ("c", Mark(2, "x", "c"), record(Phase.OWNER)),  # a person has said so
        ("c", None, record(Phase.RELEASED, "c")),
        ("c", Mark(2, "me", "me"), record(Phase.COMMITTED, "c")),
    ],
)
def test_who_has_the_task_or_was_given_it_raises_the_fence(peer, mark, known):
    assert judged("me", claim(peer), marks(mark), known, ["b", "c", "d"]) == May()


@pytest.mark.parametrize(
    ("peer", "mark", "known", "linked", "why"),
    [
        ("c", None, record(Phase.OWNER), ["b", "c"], "b/T is here, under epoch 1"),
        ("b", None, record(Phase.FROZEN, "b"), ["b", "c"], "b/T is here, under epoch 1"),
        ("c", None, None, ["c"], "c is not known to have been given b/T, and b, which had it, cannot be asked"),
        (
            "c",
            Mark(2, "x", "d"),
            None,
            ["c"],
            "c is not known to have been given b/T, and d and b, which had it, cannot be asked",
        ),
    ],
)
def test_who_is_not_known_to_have_been_given_it_does_not(peer, mark, known, linked, why):
    assert judged("me", claim(peer), marks(mark), known, linked) == ClaimRefused(why)


def test_a_task_that_was_born_here_and_never_given_away_is_nobody_elses():
    verdict = judged("me", claim("c", task_id="me/T"), marks(None), None, ["c"])
    assert verdict == ClaimRefused("c is not known to have been given me/T")


@pytest.mark.parametrize("task_id", ["T", "", "a/b/c", "/T"])
def test_what_is_no_task_raises_no_fence(task_id):
    assert isinstance(judged("me", claim("c", task_id=task_id), marks(None), None, ["c"]), ClaimRefused)


def test_the_last_that_brought_an_epoch_is_asked_before_the_others():
    assert judged("me", claim("c"), marks(Mark(2, "x", "d")), None, ["b", "c", "d"]) == AskAgent("d")
    assert judged("me", claim("c"), marks(Mark(2, "x", "d")), None, ["b", "c"]) == AskAgent("b")
    assert judged("me", claim("c"), marks(None), record(Phase.RELEASED, "d"), ["b", "c", "d"]) == AskAgent("d")
    assert judged("me", claim("c"), marks(Mark(2, "me", "me")), None, ["b", "c", "d"]) == AskAgent("b")


def test_an_actuator_that_has_seen_very_many_tasks_takes_no_new_one_from_elsewhere():
    seen = {f"b/T{number}": Mark(1, "b", "b") for number in range(MOST_TASKS)}
    assert judged("me", claim("b"), seen, None, []) == ClaimRefused(
        "1000 tasks have commanded it, and b/T is none of them"
    )
    assert judged("me", claim("b", task_id="b/T7"), seen, None, []) == May()
    assert judged("me", claim("me"), seen, None, []) == May()


@pytest.mark.parametrize("phase", [Phase.PREPARED, Phase.ABSENT])
def test_an_agent_that_offers_a_task_is_not_thereby_known_to_have_it(phase):
    assert judged("me", claim("c"), marks(None), record(phase, "c"), ["b", "c"]) == AskAgent("b")


@pytest.mark.parametrize("mark", [None, Mark(135, "x", "c")])
def test_no_step_is_further_than_tasks_come(mark):
    n = MOST_STEP + (mark.n if mark else 0)
    known = record(Phase.RELEASED, "c", n=0)
    assert judged("me", claim("c", n), marks(mark), known, []) == May()
    assert isinstance(judged("me", claim("c", n + 1), marks(mark), known, []), ClaimRefused)
    assert judged("me", claim("me", n + 1), marks(mark), known, []) == May(), (
        "the kernel says under which epoch its tasks run"
    )


def test_answers_lead_from_one_that_had_it_to_the_next():
    def told(peer, by="b", asked=1, linked=("b", "c", "d")):
        return answered(claim("c"), asked, by, TaskAt("b/T", peer, Epoch(3, "x")), linked)

    assert told("c") == May()
    assert told("d") == AskAgent("d")
    assert told("b") == ClaimRefused("b has b/T, under epoch 3, and not c")
    assert told("") == ClaimRefused("b does not know that c was given b/T")
    assert told("e") == ClaimRefused("b gave b/T to e, and not to c")
    assert told("d", asked=MOST_ASKED) == ClaimRefused("b gave b/T to d, and not to c")


@pytest.mark.parametrize(
    ("known", "at"),
    [
        (None, TaskAt("b/T")),
        (record(Phase.OWNER), TaskAt("b/T", "me", Epoch(1, "x"))),
        (record(Phase.FROZEN, "c"), TaskAt("b/T", "me", Epoch(1, "x"))),
        (record(Phase.COMMITTED, "c", 2), TaskAt("b/T", "c", Epoch(2, "x"))),
        (record(Phase.PREPARED, "c", 2), TaskAt("b/T")),
        (record(Phase.ABSENT, "c", 2), TaskAt("b/T")),
        (record(Phase.RELEASED, "c"), TaskAt("b/T", "c", Epoch(1, "x"))),
    ],
)
def test_each_agent_says_what_its_record_says(known, at):
    assert whereabouts("me", "b/T", known) == at


def here(peer, n):
    return TaskAt("b/T", peer, Epoch(n, peer))


NOWHERE = TaskAt("b/T")


@pytest.mark.parametrize(
    ("own", "answers", "owner"),
    [
        (
            NOWHERE,
            {"b": here("b", 2), "c": here("b", 9)},
            PresentOwner("b", Mark(2, "b", "b")),
        ),  # what c says of b counts not
        (here("me", 4), {"b": NOWHERE}, PresentOwner("me", Mark(4, "me", "me"))),
        (here("me", 4), {"b": here("b", 7), "c": here("c", 6)}, PresentOwner("b", Mark(7, "b", "b"))),
    ],
)
def test_of_all_that_have_a_task_the_one_with_the_highest_epoch_is_its_owner(own, answers, owner):
    assert present_owner("me", "b/T", own, answers) == owner


def test_a_fence_is_set_to_nothing_that_is_not_known():
    gone = "no agent that is connected has b/T, so its fence stays as it is: adopt the task first"
    assert present_owner("me", "b/T", NOWHERE, {"b": NOWHERE}) == ClaimRefused(gone)
    silent = present_owner("me", "b/T", here("me", 4), {"b": None, "c": here("c", 1)})
    assert silent == ClaimRefused("b did not say whether b/T is there: ask again, or end it first")
