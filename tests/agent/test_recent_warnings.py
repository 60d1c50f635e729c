"""What an agent warns of is there for those who ask afterwards."""

from pancakes.control import Describe
from pancakes.runtime.recent_warnings import KEPT_S, MOST_LINES
from pancakes.task import Task
from pancakes.testing import FleetInTest


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
    with FleetInTest() as fleet:
        agent = fleet.start("a", tasks={"Grumbles": Grumbles})
        fleet.run_for(2.0)
        assert told(agent) == [
            ("a/client/Grumbles", "warning", "the lamp flickers: 9 times in 7.0 s", 2),
            ("a/client/Grumbles", "error", "the lamp is dark", 1),
        ]
        fleet.run_for(KEPT_S)
        assert told(agent) == []


def test_warnings_are_bounded():
    with FleetInTest() as fleet:
        agent = fleet.start("a", tasks={"Grumbles": Grumbles})
        for letter in map(chr, range(97, 97 + 2 * MOST_LINES)):
            agent.kernel.log("warning", f"{letter} is wrong")
        assert [it[2] for it in told(agent)][-1] == f"{letter} is wrong" and len(told(agent)) == MOST_LINES
