"""Tasks ask tasks: an answer, an error or a time-out, once, wherever both of them are by then."""

import gc
import weakref

import pytest
from services.asking import (
    DRIVER,
    FINDER,
    Asker,
    AsksAtStart,
    Both,
    Deaf,
    Driver,
    Finder,
    Go,
    Position,
    Sleeper,
    Stateless,
    StatelessSleeper,
    Waiter,
    Wheeled,
    Wheels,
)

from pancakes import control
from pancakes.control import Migrate, Restart, Start, Stop
from pancakes.kernel.handlers import QueuePolicy
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.request_packets import REQUESTS, Answered
from pancakes.mesh.memory_network import Quality
from pancakes.packet import Packet, task_address
from pancakes.request import Pending
from pancakes.service import Service
from pancakes.testing import Fleet

ASKERS = pytest.mark.parametrize("asker", [Asker, Waiter])
CUP = [str(Position(1.5))]


@pytest.fixture
def fleet():
    with Fleet(seed=5) as made:
        yield made


def start(fleet, asker, **others):
    """An asker on a, a finder and a driver on b, and room for all of them on c."""
    classes = {"Asker": asker, "Finder": Finder, "Driver": Driver}
    a = fleet.start("a", tasks={"Asker": {"type": asker, **others}}, classes=classes)
    b = fleet.start("b", tasks={"Finder": Finder, "Driver": Driver}, classes=classes)
    c = fleet.start("c", classes=classes)
    fleet.connect()
    return a, b, c


def go(agent, *args, **others):
    agent.publish("system", Go(*args, **others), to="a/client/Asker" if agent.name == "a" else "task:a/Asker")


def state(fleet, task):
    """The state of the one copy that runs."""
    for agent in fleet.agents.values():
        component = agent.component(f"client/{task}")
        if component is not None and not component.is_frozen:
            return component.facade.state
    return None


@ASKERS
class TestAnAnswer:
    @pytest.mark.parametrize("to", [FINDER, "b/client/Finder"])
    def test_comes_back(self, fleet, asker, to):
        a, *_ = start(fleet, asker)
        go(a, to=to)
        fleet.run_for(0.5)
        assert state(fleet, "Asker").answers == CUP

    def test_comes_with_the_feedback_before_it(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "SlowWhere", value=3)
        fleet.run_for(4.0)
        heard = state(fleet, "Asker")
        assert (heard.answers, heard.feedback) == ([str(Position(3.0))], [1.0, 2.0, 3.0])

    def test_may_be_given_later_from_a_tick(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "Drive", DRIVER, 3)
        fleet.run_for(4.5)
        heard = state(fleet, "Asker")
        assert (heard.answers, heard.feedback) == (["there, on b"], [1.0, 2.0, 3.0])
        assert state(fleet, "Driver").late == 0

    def test_is_the_error_that_the_method_raised_to_refuse(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, value="nothing")
        fleet.run_for(0.5)
        assert state(fleet, "Asker").answers == ["RequestError not_found: there is none"]

    def test_is_the_text_of_any_other_error_and_the_task_goes_on(self, fleet, asker):
        a, b, _ = start(fleet, asker)
        go(a, value="bug")
        fleet.run_for(0.5)
        (answer,) = state(fleet, "Asker").answers
        assert answer.startswith("RequestError failed: ZeroDivisionError: by nought at asking.py:")
        assert b.events("task_failed") == [] and len(b.lines("error")) == 1

    def test_that_does_not_fit_its_type_is_an_error_on_both_sides(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, value="odd")
        fleet.run_for(0.5)
        (answer,) = state(fleet, "Asker").answers
        assert answer.startswith("RequestError invalid: the answer to 'test.where' does not fit its type")

    def test_to_a_request_that_does_not_fit_its_type_is_an_error(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, value=7)
        fleet.run_for(0.5)
        (answer,) = state(fleet, "Asker").answers
        assert answer.startswith("RequestError invalid:")
        assert state(fleet, "Finder").asked == 0

    @pytest.mark.parametrize("to", [FINDER, "b/client/Finder"])
    def test_to_a_request_that_is_too_large_is_an_error_at_once(self, fleet, asker, to):
        a, *_ = start(fleet, asker)
        go(a, value="x" * 240_000, to=to)
        fleet.run_for(2.0)
        assert state(fleet, "Asker").answers == CUP
        go(a, value="x" * 250_000, to=to)
        fleet.run_for(0.0)
        assert state(fleet, "Asker").answers[1:] == [
            "RequestError invalid: the request 'test.where' takes 250011 bytes, and 250000 is the most:"
            " send it in parts"
        ]

    @pytest.mark.parametrize("what", ["answer", "feedback"])
    def test_that_is_too_large_is_an_error_at_once(self, fleet, asker, what):
        a, *_ = start(fleet, asker)
        go(a, "GiveMe", value={what: 240_000})
        go(a, "GiveMe", value={what: 300_000})
        fleet.run_for(1.0)
        heard = state(fleet, "Asker")
        (error,) = [it for it in heard.answers if it.startswith("RequestError invalid: the ")]
        assert error.endswith("takes 300005 bytes, and 250000 is the most: send it in parts")
        assert [len(it) for it in (*heard.answers, *heard.feedback)].count(240_000) == 1

    def test_that_refuses_at_length_is_cut(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "GiveMe", value={"refusal": 300_000})
        fleet.run_for(1.0)
        (answer,) = state(fleet, "Asker").answers
        assert answer.startswith("RequestError busy: nnn") and answer.endswith("n ...") and len(answer) < 5000

    def test_is_a_refusal_if_the_task_answers_no_such_request(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "Drive", FINDER, 3)
        fleet.run_for(0.5)
        (answer,) = state(fleet, "Asker").answers
        assert answer.startswith("RequestError unsupported:")

    @pytest.mark.parametrize(("to", "code"), [("b/client/Fnder", "not_found"), ("a/client/Nobody", "not_found")])
    def test_is_an_error_at_once_if_no_such_task_is_there(self, fleet, asker, to, code):
        a, *_ = start(fleet, asker)
        go(a, to=to)
        fleet.run_for(0.5)
        (answer,) = state(fleet, "Asker").answers
        assert answer.startswith(f"RequestError {code}: ")

    def test_is_an_error_at_once_if_the_task_there_is_stopped_or_its_agent_is_not_linked(self, fleet, asker):
        a, b, _ = start(fleet, asker)
        assert b.ask(Stop("Finder")).ok
        go(a, to="b/client/Finder")
        go(a, to="d/client/Finder")
        fleet.run_for(0.5)
        assert [it[:20] for it in state(fleet, "Asker").answers] == ["RequestError unable:"] * 2

    def test_that_does_not_come_in_time_is_a_time_out_and_the_request_is_cancelled(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "Drive", DRIVER, 30, timeout_s=2.5)
        go(a, "SlowWhere", value=30, timeout_s=2.5)
        fleet.run_for(10.0)
        assert [it[:27] for it in state(fleet, "Asker").answers] == ["RequestTimeoutError unable:"] * 2
        driver, finder = state(fleet, "Driver"), state(fleet, "Finder")
        assert (driver.cancelled, driver.driven_m <= 3, driver.drive) == (1, True, None)
        assert (finder.begun, finder.ended) == (1, 0)
        assert state(fleet, "Asker").feedback[-1] <= 3.0

    def test_waits_for_a_task_that_is_stopped_for_a_while(self, fleet, asker):
        a, b, _ = start(fleet, asker)
        assert b.ask(Stop("Finder")).ok
        go(a)
        fleet.run_for(1.0)
        assert b.ask(Start("Finder")).ok
        fleet.run_for(3.0)
        assert state(fleet, "Asker").answers == CUP

    def test_of_no_task_at_all_is_a_time_out(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, to="task:nowhere/Nothing", timeout_s=1.0)
        fleet.run_for(2.0)
        assert [it[:27] for it in state(fleet, "Asker").answers] == ["RequestTimeoutError unable:"]

    def test_is_worked_for_by_no_task_once_the_request_was_on_its_way_for_too_long(self, fleet, asker):
        a, *_ = start(fleet, asker)
        fleet.run_for(5.0)
        fleet.network.set_quality("a", "b", Quality(latency_s=1.5))
        fleet.run_for(5.0)
        go(a, "Drive", "b/client/Driver", 30, timeout_s=1.4)
        fleet.run_for(10.0)
        assert len(state(fleet, "Asker").answers) == 1
        assert (state(fleet, "Driver").driven_m, state(fleet, "Driver").cancelled) == (0, 0)

    def test_that_finds_no_room_is_sent_again(self, fleet, asker, monkeypatch):
        a, *_ = start(fleet, asker)
        with monkeypatch.context() as full:
            full.setattr("pancakes.durable.delivery.WINDOW", 0)
            go(a, "Drive", "b/client/Driver", 1, timeout_s=30.0)
            fleet.run_for(3.0)
            assert state(fleet, "Asker").answers == []
            assert (state(fleet, "Driver").driven_m, state(fleet, "Driver").late) == (1, 0)
        fleet.run_for(2.0)
        assert state(fleet, "Asker").answers == ["there, on b"]

    def test_survives_a_bad_network(self, fleet, asker):
        a, *_ = start(fleet, asker)
        fleet.network.set_quality("a", "b", Quality(latency_s=0.2, jitter_s=0.1))
        for _ in range(5):
            go(a, timeout_s=20.0)
        fleet.run_for(1.0)
        fleet.network.partition({"a"}, {"b", "c"})
        fleet.run_for(3.0)
        fleet.network.heal()
        fleet.run_for(15.0)
        assert state(fleet, "Asker").answers == CUP * 5

    def test_can_be_cancelled(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "Drive", DRIVER, 30, timeout_s=60.0, cancel_after_s=1.5)
        go(a, "SlowWhere", value=30, timeout_s=60.0, cancel_after_s=1.5)
        fleet.run_for(10.0)
        assert state(fleet, "Asker").answers == (["given up"] * 2 if asker is Waiter else [])
        driver, finder = state(fleet, "Driver"), state(fleet, "Finder")
        assert (driver.cancelled, driver.drive) == (1, None)
        assert (finder.begun, finder.ended) == (1, 0)
        go(a)
        fleet.run_for(0.5)
        assert state(fleet, "Asker").answers[-1:] == CUP


@ASKERS
@pytest.mark.parametrize(("right", "to"), [("write", FINDER), ("publish", "b/client/Finder")])
def test_a_request_needs_the_same_right_as_any_packet(fleet, asker, right, to):
    a = fleet.start("a", tasks={"Asker": asker})
    fleet.start("b", f'[access]\nrefuse = ["{right}"]\n', tasks={"Finder": Finder})
    fleet.connect()
    go(a, to=to, timeout_s=2.0)
    fleet.run_for(4.0)
    assert [it[:27] for it in state(fleet, "Asker").answers] == ["RequestTimeoutError unable:"]
    assert state(fleet, "Finder").asked == 0


def test_what_waits_for_a_task_without_a_turn_has_a_bound():
    mailbox = Mailbox()
    queues = mailbox.subscribe(REQUESTS)
    queues.bound("request.cancel", QueuePolicy(2, urgent=True))
    for seq in range(3):
        queues.of("request.cancel").put(Packet(REQUESTS, "request.cancel", "b/client/B", "a/client/A", 0.0, seq, None))
    assert (len(queues), queues.dropped(), list(mailbox.order)) == (2, 1, [])


class TestATaskThatIsAsked:
    @ASKERS
    def test_takes_the_request_along_when_it_moves_and_its_method_begins_again(self, fleet, asker):
        a, b, _ = start(fleet, asker)
        go(a, "SlowWhere", value=4, timeout_s=30.0)
        fleet.run_for(2.5)
        assert b.ask(Migrate("Finder", to="c")).ok
        fleet.run_for(6.0)
        heard = state(fleet, "Asker")
        assert heard.answers == [str(Position(4.0))]
        assert (state(fleet, "Finder").begun, state(fleet, "Finder").ended) == (2, 1)

    @ASKERS
    def test_goes_on_from_its_state_when_it_moves_if_it_answers_later(self, fleet, asker):
        a, b, _ = start(fleet, asker)
        go(a, "Drive", DRIVER, 6, timeout_s=30.0)
        fleet.run_for(2.5)
        assert b.ask(Migrate("Driver", to="c")).ok
        fleet.run_for(6.0)
        heard = state(fleet, "Asker")
        assert (heard.answers, heard.feedback) == (["there, on c"], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])

    @pytest.mark.parametrize("durability", ["lazy", "each"])
    def test_answers_after_the_death_of_its_agent(self, fleet, durability):
        """The request is in the checkpoint, and with it how far the task was."""
        a = fleet.start("a", tasks={"Asker": Asker})
        fleet.start("b", tasks={"Driver": {"type": Driver, "durability": durability}})
        fleet.connect()
        go(a, "Drive", DRIVER, 8, timeout_s=60.0)
        fleet.run_for(4.2)
        fleet.crash("b")
        fleet.restart("b")
        fleet.connect()
        fleet.run_for(12.0)
        assert state(fleet, "Asker").answers == ["there, on b"]

    def test_hears_that_the_time_is_up_although_it_was_restarted(self, fleet):
        a, b, _ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 30, timeout_s=4.5)
        fleet.run_for(3.0)
        assert b.ask(Restart("Driver")).ok
        fleet.run_for(2.0)
        assert (state(fleet, "Driver").cancelled, state(fleet, "Driver").drive) == (1, None)

    def test_hears_of_a_cancellation_after_it_has_moved(self, fleet):
        a, b, _ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 30, timeout_s=60.0, cancel_after_s=5.0)
        fleet.run_for(2.5)
        assert b.ask(Migrate("Driver", to="c")).ok
        fleet.run_for(5.0)
        assert (state(fleet, "Driver").cancelled, state(fleet, "Driver").drive) == (1, None)

    def test_gives_up_by_itself_if_the_one_that_asked_is_gone_for_good(self, fleet):
        a, *_ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 300, timeout_s=4.0)
        fleet.run_for(1.5)
        fleet.crash("a")
        fleet.run_for(5.0)
        assert (state(fleet, "Driver").cancelled, state(fleet, "Driver").drive) == (1, None)

    def test_refuses_more_than_it_can_keep(self, fleet, monkeypatch):
        monkeypatch.setattr("pancakes.supervision.requests.MOST_OPEN", 2)
        a, *_ = start(fleet, Asker)
        for _ in range(3):
            go(a, "SlowWhere", value=1)
        fleet.run_for(4.0)
        answers = state(fleet, "Asker").answers
        assert [it[:18] for it in answers] == ["RequestError busy:", *[str(Position(1.0))] * 2]

    def test_refuses_a_second_goal_while_it_works_on_one(self, fleet):
        a, *_ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 3)
        go(a, "Drive", DRIVER, 3)
        fleet.run_for(5.0)
        assert state(fleet, "Asker").answers == ["RequestError busy: it drives already", "there, on b"]

    def test_hears_its_other_packets_in_order_behind_what_it_works_on(self, fleet):
        a, b, _ = start(fleet, Asker)
        go(a, "SlowWhere", value=2)
        fleet.run_for(0.5)
        b.publish("system", Go("heard"), to="b/client/Finder")
        fleet.run_for(0.5)
        assert state(fleet, "Finder").heard == []
        fleet.run_for(2.0)
        assert state(fleet, "Finder").heard == ["heard"]


class TestATaskThatAsks:
    def test_logs_an_answer_that_its_class_has_no_method_for_any_more(self, fleet, monkeypatch):
        a, _, c = start(fleet, Asker)
        go(a, "Drive", DRIVER, 3, timeout_s=30.0)
        fleet.run_for(1.5)
        assert a.ask(Migrate("Asker", to="c")).ok
        monkeypatch.delattr(Asker, "answered")  # as in another version of it
        fleet.run_for(6.0)
        lost = [it for it in c.lines("warning") if "is lost" in it]
        assert lost == ["c/client/Asker has no method 'answered' any more: an answer for it is lost"]

    def test_gets_the_answer_where_it_has_moved_to(self, fleet):
        a, *_ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 5, timeout_s=30.0)
        fleet.run_for(2.5)
        assert a.ask(Migrate("Asker", to="c")).ok
        fleet.run_for(6.0)
        heard = state(fleet, "Asker")
        assert (heard.answers, heard.feedback) == (["there, on b"], [1.0, 2.0, 3.0, 4.0, 5.0])
        assert fleet.agents["c"].task("Asker") is not None

    @pytest.mark.parametrize("to", ["a/client/Asker", "task:a/Asker"])
    def test_takes_no_answer_a_second_time(self, fleet, to):
        a, b, _ = start(fleet, Asker)
        go(a)
        fleet.run_for(0.5)
        asked = state(fleet, "Asker").asked
        b.publish(REQUESTS, Answered(asked.source, asked.seq, {"x_m": 9.0}), to=to)
        fleet.run_for(1.0)
        assert state(fleet, "Asker").answers == CUP

    @ASKERS
    def test_takes_no_answer_after_its_time_out(self, fleet, asker):
        a, *_ = start(fleet, asker)
        fleet.network.set_quality("a", "b", Quality(latency_s=2.0))
        go(a, to="b/client/Finder", timeout_s=3.0)
        fleet.run_for(10.0)
        assert [it[:27] for it in state(fleet, "Asker").answers] == ["RequestTimeoutError unable:"]
        assert state(fleet, "Finder").asked == 1

    def test_gets_the_answer_if_both_have_moved(self, fleet):
        a, b, _ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 9, timeout_s=60.0)
        fleet.run_for(1.5)
        assert b.ask(Migrate("Driver", to="c")).ok
        assert a.ask(Migrate("Asker", to="b")).ok
        fleet.run_for(10.0)
        assert state(fleet, "Asker").answers == ["there, on c"]

    def test_calls_off_what_it_awaited_when_it_has_moved(self, fleet):
        a, *_ = start(fleet, Waiter)
        go(a, "Drive", DRIVER, 30, timeout_s=60.0)
        fleet.run_for(2.5)
        assert a.ask(Migrate("Asker", to="c")).ok
        fleet.run_for(2.0)
        assert (state(fleet, "Driver").cancelled, state(fleet, "Driver").drive) == (1, None)
        assert state(fleet, "Asker").answers == []
        go(fleet.agents["c"])
        fleet.run_for(1.0)
        assert state(fleet, "Asker").answers == CUP

    def test_goes_on_awaiting_if_its_migration_fails(self, fleet):
        a, *_ = start(fleet, Waiter)
        go(a, "Drive", DRIVER, 5, timeout_s=60.0)
        fleet.run_for(1.5)
        fleet.faults.fill_disk("c")
        assert not a.ask(Migrate("Asker", to="c")).ok
        fleet.faults.calm()
        fleet.run_for(6.0)
        assert state(fleet, "Asker").answers == ["there, on b"]

    @ASKERS
    def test_that_is_stopped_calls_off_what_it_awaited_only(self, fleet, asker):
        a, *_ = start(fleet, asker)
        go(a, "Drive", DRIVER, 4, timeout_s=60.0)
        fleet.run_for(1.5)
        assert a.ask(Stop("Asker")).ok
        fleet.run_for(1.0)
        assert state(fleet, "Driver").cancelled == (asker is Waiter)
        assert a.ask(Start("Asker")).ok
        fleet.run_for(6.0)
        assert state(fleet, "Asker").answers == ([] if asker is Waiter else ["there, on b"])

    def test_gets_the_answer_after_the_death_of_its_agent(self, fleet):
        a, *_ = start(fleet, Asker)
        fleet.run_for(1.0)
        go(a, "Drive", DRIVER, 6, timeout_s=60.0)
        fleet.run_for(2.5)
        fleet.crash("a")
        fleet.restart("a")
        fleet.connect()
        fleet.run_for(10.0)
        assert state(fleet, "Asker").answers == ["there, on b"]

    def test_that_has_forgotten_its_state_takes_no_answer(self, fleet):
        a, *_ = start(fleet, Asker)
        go(a, "Drive", DRIVER, 3, timeout_s=60.0)
        fleet.run_for(1.5)
        assert a.ask(Restart("Asker", keep_state=False)).ok
        fleet.run_for(5.0)
        assert state(fleet, "Asker").answers == []

    def test_may_await_the_answer_of_the_task_whose_packet_it_handles(self, fleet):
        """Feedback and answer are behind that packet in their stream, and come again and again."""
        classes = {"Asker": Both, "Other": Both}
        a = fleet.start("a", tasks={"Asker": Both}, classes=classes)
        b = fleet.start("b", tasks={"Other": Both}, classes=classes)
        fleet.connect()
        go = Go("SlowWhere", task_address("b/Other"), 2)
        b.task("Other").call(lambda: b.task("Other").publish("system", go, to="task:a/Asker"))
        fleet.run_for(3.0)
        heard = a.task("Asker").state
        assert (heard.answers, heard.feedback) == ([str(Position(2.5))], [1.0, 2.0])

    def test_without_state_gets_the_answer_after_the_death_of_its_agent(self, fleet, monkeypatch):
        monkeypatch.setattr(
            Pending, "feedback", lambda *_: False
        )  # each packet that comes is a reason for a checkpoint
        a, *_ = start(fleet, Stateless)
        fleet.run_for(2.0)
        go(a, "Drive", DRIVER, 6, timeout_s=60.0)
        fleet.run_for(2.5)
        fleet.crash("a")
        a = fleet.restart("a")
        fleet.connect()
        fleet.run_for(10.0)
        assert [event["text"] for event in a.events("answered")] == ["there, on b"]

    @ASKERS
    def test_asks_no_more_than_can_be_kept(self, fleet, asker, monkeypatch):
        monkeypatch.setattr("pancakes.supervision.requests.MOST_ASKED", 0)
        a, *_ = start(fleet, asker)
        if asker is Asker:
            a.may_fail.add("a/client/Asker")
            a.may_fail.add("client/Asker")
        go(a)
        fleet.run_for(0.2)
        if asker is Waiter:
            assert state(fleet, "Asker").answers == ["RequestError busy: a/client/Asker waits for 0 answers already"]
        else:
            assert a.events("task_failed")

    def test_gets_a_refusal_from_a_task_that_answers_nothing(self, fleet):
        a, *_ = start(fleet, Waiter)
        fleet.start("d", tasks={"Deaf": Deaf})
        fleet.connect()
        go(a, to="task:d/Deaf")
        go(a, to="d/client/Deaf")
        fleet.run_for(1.0)
        assert [it.split(":")[0] for it in state(fleet, "Asker").answers] == ["RequestError unsupported"] * 2

    def test_without_state_gets_an_answer_once_although_its_agent_is_killed_much_later(self, fleet, monkeypatch):
        monkeypatch.setattr(Pending, "feedback", lambda *_: False)
        a, *_ = start(fleet, StatelessSleeper)
        fleet.run_for(2.0)
        go(a, "Drive", DRIVER, 2, timeout_s=20.0)
        fleet.run_for(15.0)
        assert len(a.events("answered")) == 1
        fleet.crash("a")
        a = fleet.restart("a")
        fleet.connect()
        fleet.run_for(25.0)
        assert a.events("answered") == []

    def test_may_ask_as_it_starts_if_it_reads_the_same_channel(self, fleet):
        start(fleet, AsksAtStart)
        fleet.run_for(3.0)
        assert state(fleet, "Asker").answers == CUP

    def test_keeps_the_newest_feedback_and_the_answer_if_more_comes_than_it_can_take(self, fleet, monkeypatch):
        monkeypatch.setattr("pancakes.supervision.requests.MOST_CAME", 3)
        a, *_ = start(fleet, Sleeper)
        go(a, "SlowWhere", value=6, timeout_s=60.0)
        fleet.run_for(10.0)
        heard = state(fleet, "Asker")
        assert (heard.feedback, heard.answers) == ([5.0, 6.0], [str(Position(6.0))])

    def test_leaves_nothing_behind_when_it_is_restarted(self, fleet):
        a, b, _ = start(fleet, Asker)
        go(a, "Drive", "b/client/Driver", 300, timeout_s=600.0)
        fleet.run_for(1.5)
        before = [weakref.ref(a.component("client/Asker")), weakref.ref(b.component("client/Driver"))]
        assert a.ask(Restart("Asker")).ok and b.ask(Restart("Driver")).ok
        fleet.run_for(5.0)
        gc.collect()
        assert [it() for it in before] == [None, None]


GUARD = {"copies": 3, "lease_s": 4.0, "checkpoint_s": 0.5}


@pytest.mark.parametrize("lost", ["a", "b"])
def test_the_answer_comes_although_a_task_is_taken_over_by_another_agent(fleet, lost):
    classes = {"test.Asker": Asker, "test.Driver": Driver}
    a = fleet.start("a", tasks={"Asker": {"type": Asker, "guard": GUARD}}, classes=classes)
    fleet.start("b", tasks={"Driver": {"type": Driver, "guard": GUARD}}, classes=classes)
    for name in "cde":
        fleet.start(name, classes=classes)
    fleet.connect()
    fleet.run_for(8.0)
    go(a, "Drive", DRIVER, 20, timeout_s=100.0)
    fleet.run_for(4.0)
    fleet.crash(lost)
    there = "there, on b" if lost == "a" else "there, on c"
    assert fleet.run_until(lambda: (now := state(fleet, "Asker")) is not None and now.answers == [there], 80.0)


class Plain(Service):
    """Its tasks do not move, so that they are asked and answered at their addresses."""


@pytest.mark.parametrize("asker", [Asker, Waiter])
def test_tasks_that_do_not_move_hear_all_feedback_before_the_answer(fleet, asker):
    a = fleet.start("a", services={"plain": Plain}, tasks={"Asker": {"type": asker, "service": "plain"}})
    fleet.start("b", services={"plain": Plain}, tasks={"Finder": {"type": Finder, "service": "plain"}})
    fleet.connect()
    a.publish("system", Go("SlowWhere", "b/plain/Finder", 3), to="a/plain/Asker")
    fleet.run_for(5.0)
    heard = a.task("Asker", "plain").state
    assert (heard.answers, heard.feedback) == ([str(Position(3.0))], [1.0, 2.0, 3.0])


def test_a_paused_task_begins_no_request_until_it_goes_on(fleet):
    a, b, _ = start(fleet, Asker)
    driver = b.task("Driver")
    driver.call(driver.pause)
    go(a, "Drive", DRIVER, 2, timeout_s=60.0)
    go(a, "Drive", DRIVER, 2, timeout_s=1.0)
    fleet.run_for(3.0)
    assert (driver.state.drive, driver.state.cancelled) == (None, 0)
    driver.call(driver.resume)
    fleet.run_for(4.0)
    assert state(fleet, "Asker").answers[-1:] == ["there, on b"] and len(state(fleet, "Asker").answers) == 2


def test_a_task_whose_robot_is_driven_by_hand_begins_no_request_until_the_end_of_that(fleet):
    classes = {"Asker": Asker}
    a = fleet.start("a", tasks={"Asker": Asker}, classes=classes)
    b = fleet.start("b", tasks={"Driver": Wheeled}, devices={"motors": Wheels})
    alice = fleet.start("alice", role="client")
    fleet.connect()
    fleet.run_for(1.0)
    assert alice.ask(control.Drive("motors", "one", begin=True), to="b").ok
    go(a, "Drive", DRIVER, 2, timeout_s=60.0)
    fleet.run_for(2.0)
    assert b.task("Driver").state.drive is None
    assert alice.ask(control.EndDrive("motors", "one"), to="b").ok
    fleet.run_for(4.0)
    assert state(fleet, "Asker").answers == ["there, on b"]
