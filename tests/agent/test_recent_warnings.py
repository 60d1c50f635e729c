"""What an agent warns of is there for those who ask afterwards."""

from pancakes.agent.log_buffers import KEPT_S, MOST_LINES
from pancakes.control import Describe, Migrate, Start, Stop
from pancakes.service import Service
from pancakes.task import Task
from pancakes.testing import Fleet


class Grumbles(Task):
    def on_start(self):
        self.log("info", "all is well")
        self.log("warning", "the link to b has ended: connection reset by peer")
        self.log("warning", "the lamp flickers: 3 times in 2.5 s")
        self.after(1.0, lambda: self.log("warning", "the lamp flickers: 9 times in 7.0 s"))
        self.after(1.0, lambda: self.log("error", "the lamp is dark"))


def told(agent):
    return [(it["source"], it["level"], it["text"], it["count"]) for it in agent.ask(Describe()).result["warnings"]]


def test_warnings_are_told_once_with_the_newest_numbers():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Grumbles": Grumbles})
        fleet.run_for(2.0)
        assert told(agent) == [
            ("a/client/Grumbles", "warning", "the lamp flickers: 9 times in 7.0 s", 2),
            ("a/client/Grumbles", "error", "the lamp is dark", 1),
        ]
        fleet.run_for(KEPT_S)
        assert told(agent) == []


def test_warnings_are_bounded():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Grumbles": Grumbles})
        for letter in map(chr, range(97, 97 + 2 * MOST_LINES)):
            agent.kernel.log("warning", f"{letter} is wrong")
        assert [it[2] for it in told(agent)][-1] == f"{letter} is wrong" and len(told(agent)) == MOST_LINES


class Boom(Task):
    def on_start(self):
        raise ValueError("the wheel came off")


def texts(agent):
    return [it["text"] for it in agent.ask(Describe()).result["warnings"]]


def test_what_only_answers_a_request_is_no_warning():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Home": Task})
        assert not agent.ask(Migrate("Home", to="a")).ok
        assert not agent.ask(Migrate("Home")).ok
        assert not agent.ask(Start("Hom")).ok
        fleet.run_for(5.0)
        assert texts(agent) == []


def test_warnings_of_a_task_that_is_gone_are_gone():
    with Fleet() as fleet:
        agent = fleet.start("a", services={"extra": Extra}, tasks={"Grumbles": {"type": Grumbles, "service": "extra"}})
        fleet.run_for(2.0)
        assert len(texts(agent)) == 2
        assert agent.ask(Stop("extra")).ok
        assert texts(agent) == []


class Extra(Service):
    """A service whose tasks are gone with it."""


def test_warnings_of_a_failure_are_over_once_a_person_stops_the_task():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Boom": {"type": Boom, "restart": {"at_most": 1}}})
        fleet.run_for(5.0)
        assert [text.partition(":")[0].split(" in ")[0] for text in texts(agent)] == [
            "a/client/Boom is started again",
            "a/client/Boom is given up",
        ]
        assert agent.ask(Stop("Boom")).ok
        assert texts(agent) == []


def test_a_birth_that_waited_is_no_warning_once_it_is_over():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Grumbles": Task})
        agent.kernel.log("warning", "not born yet: Grumbles. They are new here and may run elsewhere, and nothing was")
        agent.kernel.log("warning", "a/Grumbles is born, although nothing was heard of it from b")
        fleet.run_for(0.1)
        assert agent.lines("warning") and texts(agent) == []
