"""A task that has left its agent leaves its name to another one, also across a crash."""

from services.created import Count

from pancakes.control import Create, Migrate
from pancakes.testing import Fleet


def test_an_agent_that_guards_a_task_that_left_it_runs_another_one_of_its_name_after_a_crash() -> None:
    with Fleet(3, classes={"test.Count": Count}) as fleet:
        agents = {name: fleet.start(name) for name in "abc"}
        fleet.connect()
        keys = {"guard": {"copies": 3, "lease_s": 2.0}}
        for birthplace, to in (("c", "b"), ("a", "c")):
            assert agents[birthplace].ask(Create("X", "test.Count", keys=keys)).ok
            fleet.run_for(3.0)
            assert agents[birthplace].ask(Migrate("X", to=to), timeout_s=30.0).ok
            fleet.run_for(3.0)
        fleet.crash("c")
        fleet.run_for(0.1)
        fleet.restart("c")
        fleet.run_for(30.0)
        fence = fleet.agents["b"].slot("X").fence
        assert fence is not None and fence.task_id == "c/X"
        running = {name: agent.running() for name, agent in fleet.agents.items()}
        assert sorted(running.values()) == [[], ["X"], ["X"]] and running["b"] == ["X"]
