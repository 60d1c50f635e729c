"""How a task is that does not run: one word for it, in the list and in each refusal."""

from dataclasses import dataclass

import pytest

from pancakes.client.rates import RateMeter
from pancakes.control import Configure, Describe, Migrate, Remove, Reschedule
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=1)
    def tick(self, tick):
        self.state.n += self.settings.step


@pytest.fixture
def fleet():
    with Fleet(classes={"test.Count": Count}) as fleet:
        yield fleet


def row(agent, name):
    (found,) = [it for it in agent.ask(Describe()).result["tasks"] if it["task"] == name]
    return found


def shown_by_top(agent, name):
    (looked,) = RateMeter().update([agent.ask(Describe()).result])
    (found,) = [it for it in looked["tasks"] if it["task"] == name]
    return found["rest"] or found["state"]


def test_a_task_that_waits_is_said_to_wait_by_what_would_change_it(fleet):
    a = fleet.start("a", tasks={"Count": Count}, peers=["tcp://b:7400"], birth_wait_s=60.0)
    fleet.run_for(2.0)
    waits = row(a, "Count")["rest"]
    assert waits.startswith("waits → ")
    for asked in (Configure("Count", {"step": 2}), Reschedule("Count", 2.0)):
        assert a.ask(asked).reason == f"a/client/Count does not run: {waits}"
    assert a.ask(Migrate("Count")).reason == f"a/client/Count does not run: {waits}, so it cannot move"
    assert shown_by_top(a, "Count") == waits


def test_a_task_that_has_moved_is_shown_so_everywhere(fleet):
    a, _ = fleet.start("a", tasks={"Count": Count}), fleet.start("b")
    fleet.connect()
    assert a.ask(Migrate("Count")).ok
    fleet.run_for(2.0)
    assert row(a, "Count")["rest"] == shown_by_top(a, "Count") == "moved → b"
    for asked in (Configure("Count", {"step": 2}), Reschedule("Count", 2.0), Migrate("Count"), Remove("Count")):
        assert a.ask(asked).reason == "a/Count moved to b"


def test_a_task_that_its_file_names_no_more_is_removed_where_it_was_born(fleet):
    a, b = fleet.start("a", tasks={"Old": Count}), fleet.start("b")
    fleet.connect()
    assert a.ask(Migrate("Old")).ok
    fleet.run_for(2.0)
    fleet.stop("a")
    a = fleet.start("a", tasks={"New": Count})
    fleet.connect()
    refused = b.ask(Remove("Old")).reason
    assert "was born from the configuration of a" in refused and "move it to a, and remove it there" in refused
    assert b.ask(Migrate("Old", to="a")).ok
    fleet.run_for(2.0)
    assert a.ask(Remove("Old")).ok
    assert [it["task"] for it in a.ask(Describe()).result["tasks"] if it["service"] == "client"] == ["New"]
