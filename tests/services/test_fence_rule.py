"""Who may raise the fence of an actuator, and to what a person may set it."""

import pytest

from pancakes.durable.answers import fact_of
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import NOBODY, Epoch, Identity, Register, Standing
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
    TaskAt,
    answered,
    judged,
    present_owner,
    task_at,
)

TASK = TaskId("b", "T")


def marks(mark):
    return {"b/T": mark} if mark is not None else {}


def claim(peer, n=3, task_id="b/T"):
    return EpochClaim(Fence(task_id, (n, "x")), peer)


ME = Identity("me", "j")


def identity(name):
    return Identity(name, "j") if name else NOBODY


def epoch(n, name):
    return Epoch(n, identity(name))


def record(standing, peer="", n=1):
    """Returns what an agent knows that stands so with the task; the peer has it, or it was offered to it or by it."""
    mine, theirs = epoch(n, "me"), epoch(n, peer)
    register = {
        Standing.OWNER: Register(mine, 0, ((ME,),), state=b"", promised=mine),
        Standing.OFFERED: Register(mine, 0, ((ME,),), heir=identity(peer), state=b"", promised=mine),
        Standing.YIELDED: Register(epoch(n - 1, "me"), 0, ((ME,),), heir=identity(peer), state=b"", promised=theirs),
        Standing.RELEASED: Register(theirs, -1, ((identity(peer),),), promised=theirs),
        Standing.HEIR: Register(theirs, 0, ((identity(peer),),), heir=ME, state=b"", promised=theirs),
        Standing.MEMBER: Register(theirs, 0, ((ME, identity(peer)),), state=b"", promised=theirs),
        Standing.NONE: Register(promised=theirs),
    }[standing]
    gave = peer if standing in (Standing.YIELDED, Standing.RELEASED) else ""
    found = Record(TASK, register, ME, gave=gave)
    assert found.standing is standing
    return found


@pytest.mark.parametrize(
    ("peer", "mark", "known"),
    [
        ("me", None, None),
        ("me", None, record(Standing.RELEASED, "c")),
        ("b", None, None),  # where it was born
        ("b", Mark(2, "c", "c"), None),
        ("c", Mark(2, "x", "c"), None),  # which brought the last epoch
        ("c", Mark(2, "x", "c"), record(Standing.OWNER)),  # a person has said so
        ("c", None, record(Standing.RELEASED, "c")),
        ("c", Mark(2, "me", "me"), record(Standing.YIELDED, "c")),
    ],
)
def test_who_has_the_task_or_was_given_it_raises_the_fence(peer, mark, known):
    assert judged("me", claim(peer), marks(mark), known, ["b", "c", "d"]) == May()


@pytest.mark.parametrize(
    ("peer", "mark", "known", "linked", "why"),
    [
        ("c", None, record(Standing.OWNER), ["b", "c"], "b/T is here, under epoch 1"),
        ("b", None, record(Standing.OFFERED, "b"), ["b", "c"], "b/T is here, under epoch 1"),
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
    assert judged("me", claim("c"), marks(None), record(Standing.RELEASED, "d"), ["b", "c", "d"]) == AskAgent("d")
    assert judged("me", claim("c"), marks(Mark(2, "me", "me")), None, ["b", "c", "d"]) == AskAgent("b")


def test_an_actuator_that_has_seen_very_many_tasks_takes_no_new_one_from_elsewhere():
    seen = {f"b/T{number}": Mark(1, "b", "b") for number in range(MOST_TASKS)}
    assert judged("me", claim("b"), seen, None, []) == ClaimRefused(
        "1000 tasks have commanded it, and b/T is none of them"
    )
    assert judged("me", claim("b", task_id="b/T7"), seen, None, []) == May()
    assert judged("me", claim("me"), seen, None, []) == May()


@pytest.mark.parametrize("standing", [Standing.HEIR, Standing.NONE, Standing.MEMBER])
def test_an_agent_that_offers_a_task_is_not_thereby_known_to_have_it(standing):
    assert judged("me", claim("c"), marks(None), record(standing, "c"), ["b", "c"]) == AskAgent("b")


def test_an_offer_that_was_taken_back_does_not_say_who_has_the_task():
    register = record(Standing.HEIR, "c").register._replace(heir=NOBODY, state=None)
    known = Record(TASK, register, ME)
    assert known.standing is Standing.RELEASED
    assert judged("me", claim("c"), marks(None), known, ["b", "c"]) == AskAgent("b")
    assert task_at("b/T", "me", fact_of(known)).peer == ""


@pytest.mark.parametrize("mark", [None, Mark(135, "x", "c")])
def test_no_step_is_further_than_tasks_come(mark):
    n = MOST_STEP + (mark.n if mark else 0)
    known = record(Standing.RELEASED, "c", n=0)
    assert judged("me", claim("c", n), marks(mark), known, []) == May()
    assert isinstance(judged("me", claim("c", n + 1), marks(mark), known, []), ClaimRefused)
    assert judged("me", claim("me", n + 1), marks(mark), known, []) == May(), (
        "the kernel says under which epoch its tasks run"
    )


def test_answers_lead_from_one_that_had_it_to_the_next():
    def told(peer, by="b", asked=1, linked=("b", "c", "d")):
        return answered(claim("c"), asked, by, TaskAt("b/T", peer, epoch(3, "x")), linked)

    assert told("c") == May()
    assert told("d") == AskAgent("d")
    assert told("b") == ClaimRefused("b has b/T, under epoch 3, and not c")
    assert told("") == ClaimRefused("b does not know that c was given b/T")
    assert told("e") == ClaimRefused("b gave b/T to e, and not to c")
    assert told("d", asked=MOST_ASKED) == ClaimRefused("b gave b/T to d, and not to c")


@pytest.mark.parametrize(
    ("known", "at"),
    [
        (record(Standing.OWNER), TaskAt("b/T", "me", epoch(1, "me"))),
        (record(Standing.OFFERED, "c"), TaskAt("b/T", "me", epoch(1, "me"))),
        (record(Standing.YIELDED, "c", 2), TaskAt("b/T", "c", epoch(2, "c"))),
        (record(Standing.HEIR, "c", 2), TaskAt("b/T", "", epoch(2, "c"))),
        (record(Standing.MEMBER, "c", 2), TaskAt("b/T", "", epoch(2, "c"))),
        (record(Standing.NONE, "c", 2), TaskAt("b/T", "", epoch(2, "c"))),
        (record(Standing.RELEASED, "c"), TaskAt("b/T", "c", epoch(1, "c"))),
    ],
)
def test_each_agent_says_what_its_record_says(known, at):
    assert task_at("b/T", "me", fact_of(known)) == at


def test_an_agent_that_has_never_heard_of_a_task_says_so():
    assert task_at("b/T", "c", None) == TaskAt("b/T")


def here(peer, n):
    return TaskAt("b/T", peer, epoch(n, peer))


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
    gone = "no agent that is connected has b/T, so its fence stays as it is: recover the task first"
    assert present_owner("me", "b/T", NOWHERE, {"b": NOWHERE}) == ClaimRefused(gone)
    silent = present_owner("me", "b/T", here("me", 4), {"b": None, "c": here("c", 1)})
    assert silent == ClaimRefused("b did not say whether b/T is there: ask again, or end it first")
