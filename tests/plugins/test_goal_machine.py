"""When goals of an action server are sent and cancelled, as `pancakes_ros2.goal_machine` decides it."""

from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pancakes_ros2.goal_machine import (
    ABORTED,
    ANSWER_S,
    CANCEL_AGAIN_S,
    CANCELED,
    REJECTED,
    RESULT_S,
    SETTLED_S,
    STAYS_S,
    SUCCEEDED,
    TELL_WAITING_S,
    UNKNOWN,
    AskResult,
    Cancel,
    GoalMachine,
    Leave,
    Send,
    Tell,
    Warn,
)
from pancakes_ros2.goal_packets import GoalState

A, B = ("one/client/Go", 1), ("one/client/Go", 2)
FIELDS = {"order": 3}
TTL_S = 0.5


class Bench:
    """A machine, a clock, and a server that is there, unless said otherwise."""

    def __init__(self, ready=True):
        ids = count()
        self.machine = GoalMachine("/one/go", b"mark", lambda: b"%d" % next(ids))
        self.now_s = 0.0
        self.servers, self.ready = ({"s"}, True) if ready else (set(), False)
        self.told = []
        if ready:
            self.look()
            self.let(SETTLED_S)

    def add(self, effects):
        self.told += effects
        return effects

    def let(self, time_s):
        self.now_s += time_s
        return self.look()

    def look(self):
        return self.add(self.machine.look(self.servers, self.ready, self.now_s))

    def want(self, key=A, fields=FIELDS, ttl_s=TTL_S):
        return self.add(self.machine.want(key, fields, self.now_s + ttl_s, self.now_s))

    def keep(self, time_s, key=A, fields=FIELDS):
        """Wants a goal ten times a second."""
        effects = []
        for _ in range(round(time_s / 0.1)):
            effects += [*self.want(key, fields), *self.let(0.1)]
        return effects

    def runs(self, key=A):
        """Has a goal sent and accepted; returns its id."""
        (sent,) = [it for it in self.want(key) if isinstance(it, Send)]
        self.add(self.machine.answered(sent.id, True, self.now_s))
        return sent.id

    def result(self, id, status, result=None):
        return self.add(self.machine.result(id, status, result, self.now_s))

    def hold(self):
        return self.add(self.machine.hold(self.now_s))

    def alone(self):
        return self.add(self.machine.alone(self.now_s))

    def count(self, kind):
        return sum(isinstance(it, kind) for it in self.told)


def test_a_goal_that_is_commanded_again_and_again_is_sent_once_and_its_end_is_told():
    bench = Bench()
    id = bench.runs()
    assert AskResult(id) in bench.told
    assert bench.keep(2.0) == []
    assert bench.result(id, SUCCEEDED, {"n": 1}) == [Tell(A, "succeeded", "", {"n": 1})]
    assert bench.want() == [Tell(A, "succeeded", "", {"n": 1})], "its task may not have heard it"
    assert bench.count(Send) == 1
    assert bench.count(Cancel) == 0


def test_it_waits_for_a_server_and_says_so():
    bench = Bench(ready=False)
    told = bench.keep(TELL_WAITING_S + 0.3)
    assert [type(it) for it in told] == [Tell, Warn]
    assert "there is no action server /one/go: start it" in told[0].text
    bench.servers, bench.ready = {"s"}, True
    assert bench.want() == []
    assert bench.look() == [], "what it works on is not known yet"
    assert [type(it) for it in bench.let(SETTLED_S + 0.01)] == [Send]


@pytest.mark.parametrize("end", ["hold", "no command", "alone", "cancel", "another goal"])
def test_a_goal_that_is_not_wanted_is_cancelled_until_it_has_ended(end):
    bench = Bench()
    id = bench.runs()
    told = {
        "hold": bench.hold,
        "no command": lambda: bench.let(TTL_S),
        "alone": bench.alone,
        "cancel": lambda: bench.want(fields=None),
        "another goal": lambda: bench.want(B),
    }[end]()
    assert told == [Cancel(id)]
    keeps = {"cancel": (A, None), "another goal": (B, FIELDS)}.get(end)
    for _ in range(3):
        told = bench.keep(CANCEL_AGAIN_S, *keeps) if keeps else bench.let(CANCEL_AGAIN_S)
        assert Cancel(id) in told
    assert any("does not end a goal" in it.text for it in bench.told if isinstance(it, Warn))
    told = bench.result(id, CANCELED)
    state: GoalState = "canceled" if end == "cancel" else "held"
    assert Tell(A, state) in told
    assert {type(it) for it in told} == {"alone": {Tell, Leave}, "another goal": {Tell, Send}}.get(end, {Tell})
    assert Cancel(id) not in (bench.let(2 * CANCEL_AGAIN_S))


def test_nothing_begins_once_the_agent_is_gone():
    bench = Bench()
    bench.alone()
    assert not any(isinstance(it, Send) for it in bench.keep(0.3))


def test_a_goal_that_is_accepted_when_nobody_wants_it_any_more_is_cancelled_then():
    bench = Bench()
    (sent,) = bench.want()
    assert bench.alone() == [Cancel(sent.id)]
    told = bench.add(bench.machine.cancel_answered(sent.id, UNKNOWN, bench.now_s))
    assert told == [], "it may be accepted yet"
    told = bench.add(bench.machine.answered(sent.id, True, bench.now_s))
    assert Cancel(sent.id) in told
    assert bench.result(sent.id, CANCELED)[-1] == Leave()


def test_a_goal_that_was_held_for_a_moment_is_sent_again():
    bench = Bench()
    id = bench.runs()
    bench.let(TTL_S)
    assert bench.want() == [], "the first has not ended"
    told = bench.result(id, CANCELED)
    assert told[0] == Tell(A, "held")
    assert isinstance(told[1], Send)


def test_success_counts_also_if_it_comes_after_a_cancel():
    bench = Bench()
    id = bench.runs()
    bench.want(fields=None)
    assert bench.result(id, SUCCEEDED, {"n": 2}) == [Tell(A, "succeeded", "", {"n": 2})]
    assert not bench.keep(0.1, A, None)[1:], "told again, and nothing else"


def test_a_server_that_refuses_or_a_goal_that_is_none_is_an_end():
    bench = Bench()
    (sent,) = bench.want()
    (told,) = bench.add(bench.machine.answered(sent.id, False, bench.now_s))
    assert (told.state, told.text) == ("refused", "the server of /one/go refuses it")
    (sent,) = bench.want(B)
    assert bench.add(bench.machine.unsendable(sent.id, "no field x", 0.0)) == [Tell(B, "refused", "no field x")]


def test_what_the_server_ends_by_itself_is_told():
    bench = Bench()
    assert bench.result(bench.runs(), ABORTED)[0] == Tell(A, "aborted")
    assert bench.result(bench.runs(B), CANCELED)[0] == Tell(B, "canceled"), "by a third party"


def test_a_server_that_is_gone_or_restarted_loses_its_goal_and_no_other_is_sent_for_it():
    bench = Bench()
    bench.runs()
    bench.servers, bench.ready = set(), False
    told = bench.look()
    assert [type(it) for it in told][:2] == [Warn, Tell]
    assert told[1].state == "lost"
    bench.servers, bench.ready = {"t"}, True
    bench.keep(5.0)
    assert bench.count(Send) == 1


def test_of_two_servers_one_goes_and_it_was_the_right_one():
    bench = Bench()
    bench.servers = {"s", "dead"}
    bench.look()
    id = bench.runs()
    bench.servers = {"s"}
    assert bench.want() == [] and AskResult(id) in bench.look()
    assert bench.keep(1.0) == []
    bench.servers = {"s", "new"}
    assert bench.keep(1.0) == []


def test_a_server_that_does_not_answer_is_given_up_and_what_it_accepts_later_is_cancelled():
    bench = Bench()
    (sent,) = bench.want()
    told = bench.keep(ANSWER_S + 0.2)
    assert "does not answer" in next(it.text for it in told if isinstance(it, Tell))
    told = bench.keep(3.0, B)
    assert Cancel(sent.id) in told
    assert not any(isinstance(it, Send) for it in told)
    bench.add(bench.machine.cancel_answered(sent.id, UNKNOWN, bench.now_s))
    assert bench.count(Send) == 2, "the next goal is sent once nothing is left of this one"
    assert Cancel(sent.id) in bench.add(bench.machine.answered(sent.id, True, bench.now_s))


def test_a_server_that_does_not_cancel_is_told_of_and_gets_no_other_goal():
    bench = Bench()
    id = bench.runs()
    bench.want(B)
    for _ in range(10):
        bench.add(bench.machine.cancel_answered(id, REJECTED, bench.now_s))
        bench.keep(1.0, B)
    assert bench.count(Send) == 1
    assert bench.count(Cancel) >= 10
    assert bench.count(Warn) == 1
    assert Tell(B, "waiting", "the goal before it at /one/go has not ended") in bench.told


def test_a_goal_whose_result_does_not_come_is_given_up():
    bench = Bench()
    id = bench.runs()
    bench.hold()
    bench.add(bench.machine.cancel_answered(id, UNKNOWN, bench.now_s))
    assert any("gives no result" in it.text for it in bench.let(RESULT_S) if isinstance(it, Warn))


def test_goals_of_a_former_life_are_cancelled_and_those_of_others_are_not():
    bench = Bench()
    told = bench.add(bench.machine.listed([(b"mark-before", 2), (b"others", 2), (b"mark-over", 4)], bench.now_s))
    assert told == [Cancel(b"mark-before")]
    assert not any(isinstance(it, Send) for it in bench.want())
    told = bench.add(bench.machine.listed([(b"mark-before", 5)], bench.now_s))
    assert [type(it) for it in told] == [Send]


def test_a_keeper_without_an_agent_leaves_the_goals_of_the_next_life_alone():
    bench = Bench()
    id = bench.runs()
    bench.servers, bench.ready = set(), False
    bench.look()
    bench.alone()
    bench.servers, bench.ready = {"t"}, True
    told = bench.add(bench.machine.listed([(b"mark-of-the-next", 2)], bench.now_s)) + bench.let(CANCEL_AGAIN_S)
    assert {it.id for it in told if isinstance(it, Cancel)} == {id}


def test_a_goal_that_was_cancelled_before_it_was_sent_has_ended():
    bench = Bench(ready=False)
    bench.want()
    assert bench.want(fields=None) == [Tell(A, "canceled")]
    bench.servers, bench.ready = {"s"}, True
    bench.let(SETTLED_S)
    assert set(map(type, bench.keep(1.0))) == {Tell}, "as each further command of that goal is told"


OTHERS = {"order": 4}


def test_a_number_that_a_task_uses_once_more_for_another_goal_is_another_goal():
    bench = Bench()
    id = bench.runs()
    assert bench.want(fields=OTHERS) == [Cancel(id)], "a task that has begun anew counts from 1"
    told = bench.result(id, SUCCEEDED)
    assert told[0] == Tell(A, "held"), "it is not the new goal that was reached"
    (sent,) = [it for it in told if isinstance(it, Send)]
    assert sent.fields == OTHERS
    bench.add(bench.machine.answered(sent.id, True, bench.now_s))
    assert bench.result(sent.id, SUCCEEDED)[0] == Tell(A, "succeeded")
    assert [it.fields for it in bench.want() if isinstance(it, Send)] == [FIELDS], "nor after its end"


def test_the_end_of_a_goal_is_told_also_if_its_result_is_lost_on_the_way():
    bench = Bench()
    id = bench.runs()
    bench.add(bench.machine.listed([(id, SUCCEEDED)], bench.now_s))
    assert bench.keep(RESULT_S - 0.1) == []
    assert bench.keep(0.2)[0] == Tell(A, "succeeded", "the server of /one/go gives no result of it")


def test_a_goal_whose_result_comes_after_its_status_has_one_end():
    bench = Bench()
    id = bench.runs()
    bench.add(bench.machine.listed([(id, SUCCEEDED)], bench.now_s))
    assert bench.result(id, SUCCEEDED, {"n": 1}) == [Tell(A, "succeeded", "", {"n": 1})]
    assert bench.let(2 * RESULT_S) == []


def test_it_does_not_stay_for_ever():
    bench = Bench()
    bench.runs()
    bench.alone()
    assert not any(isinstance(it, Leave) for it in bench.let(STAYS_S - 1.0))
    bench.alone()  # it may be heard twice
    assert Leave() in bench.let(1.0)


def test_the_time_of_a_command_that_waited_in_the_pipe_has_run_all_the_same():
    bench = Bench()
    assert bench.want(ttl_s=0.0) == []


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["want A", "want B", "cancel A", "hold", "alone", "accept", "refuse", "result", "ok", "gone"]),
        st.sampled_from([0.0, 0.1, 0.6, 1.1, 6.0]),
    ),
    max_size=30,
)


@given(EVENTS)
def test_whatever_happens_at_most_one_goal_is_at_work_and_none_that_nobody_wants(events):
    """The server here does as it is told: it accepts, works, and ends a goal when it is asked to cancel it."""
    bench = Bench()
    sent: list[bytes] = []
    at_work: set[bytes] = set()

    def obey(effects):
        for effect in effects:
            if isinstance(effect, Send):
                sent.append(effect.id)
                assert not at_work, "one at a time"
            elif isinstance(effect, Cancel) and effect.id in at_work:
                at_work.discard(effect.id)
                obey(bench.result(effect.id, CANCELED))
            elif isinstance(effect, Cancel) and effect.id not in sent:
                obey(bench.add(bench.machine.cancel_answered(effect.id, UNKNOWN, bench.now_s)))

    for name, wait_s in events:
        if name.startswith("want"):
            obey(bench.want(A if name[-1] == "A" else B))
        elif name == "cancel A":
            obey(bench.want(fields=None))
        elif name in ("hold", "alone"):
            obey(getattr(bench, name)())
        elif name in ("accept", "refuse") and sent:
            id = sent.pop()
            if name == "accept":
                at_work.add(id)
            obey(bench.add(bench.machine.answered(id, name == "accept", bench.now_s)))
        elif name in ("result", "ok") and at_work:
            obey(bench.result(at_work.pop(), SUCCEEDED if name == "ok" else ABORTED))
        obey(bench.let(wait_s))
    obey(bench.let(TTL_S))
    obey(bench.let(CANCEL_AGAIN_S))
    assert not at_work, "half a second after the last command"
