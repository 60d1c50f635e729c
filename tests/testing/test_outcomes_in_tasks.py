"""What ends a test (its time-out, `pytest.fail`, `pytest.skip`) inside of a task is no failure of that task."""

from __future__ import annotations

import pytest

pytest_plugins = ["pytester"]

TASKS = """
import pytest

from pancakes.devices import Pose
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, threaded_agent


class Hangs(Task):
    @every(hz=10)
    def tick(self, tick):
        self.hang_here()

    def hang_here(self):
        while True:
            pass


class Judges(Task):
    outcome = staticmethod(pytest.fail)

    @on("system", Pose)
    def pose(self, packet):
        self.outcome("the task says so")


class Skips(Judges):
    outcome = staticmethod(pytest.skip)

"""


@pytest.fixture
def pytest_of(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch):
    """Run pytest in a process of its own on tests that use the tasks above."""
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)

    def run(source: str, *options: str) -> pytest.RunResult:
        pytester.makepyfile(test_inner=TASKS + source)
        return pytester.runpytest_subprocess("-W", "error", "-p", "no:cacheprovider", *options, timeout=300)

    return run


def test_timeout_in_virtual_task_fails_the_test(pytest_of):
    """Its failure is the time-out, with the stack of the task; and the fleet can still be stopped."""
    result = pytest_of(
        """
stopped = []

def test_it():
    with Fleet() as fleet:
        fleet.start("a", tasks={"Hangs": Hangs})
        try:
            fleet.run_for(10.0)
        except Exception:
            pass
        assert False, "the test went on"

def test_fixture(virtual_agent, fleet):
    virtual_agent(tasks={"Hangs": Hangs})
    fleet.run_for(10.0)
""",
        "--timeout=2",
    )
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*def hang_here(self):*", "E*Failed: Timeout (>2.0s)*"])
    result.stdout.no_fnmatch_line("*the test went on*")


@pytest.mark.parametrize("where", ["virtual_agent", "threaded_agent"])
@pytest.mark.parametrize(("cls", "outcome"), [("Judges", "failed"), ("Skips", "skipped")])
def test_outcome_of_a_task_is_that_of_the_test(pytest_of, where, cls, outcome):
    result = pytest_of(
        f"""
def judge(agent):
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    agent.wait_for_event("never")

def test_it():
    with Fleet() as fleet, threaded_agent("t", tasks={{"It": {cls}}}) as threaded:
        judge(fleet.start("v", tasks={{"It": {cls}}}) if "{where}" == "virtual_agent" else threaded)

def test_fixture({where}):
    judge({where}(tasks={{"It": {cls}}}))
""",
        "-rs",
    )
    outcomes = result.parseoutcomes()
    result.stdout.fnmatch_lines(["*the task says so*"])
    if where == "virtual_agent":
        assert outcomes == {outcome: 2}
    else:  # the fixture learns of it in its teardown, when the test has failed because nothing came
        assert outcomes.pop(outcome) >= 1 and "passed" not in outcomes, outcomes


def test_outcome_of_a_task_on_a_thread_is_not_lost(pytest_of):
    """A test that does not wait for the task fails at its end."""
    result = pytest_of(
        """
def judge(agent):
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    agent.wait_until(lambda: agent.events("task_failed"))

def test_it():
    with threaded_agent("t", tasks={"It": Judges}) as agent:
        judge(agent)

def test_fixture(threaded_agent):
    judge(threaded_agent(tasks={"It": Judges}))
"""
    )
    result.assert_outcomes(failed=1, passed=1, errors=1)
    result.stdout.fnmatch_lines(["*ERROR at teardown of test_fixture*", "E*Failed: the task says so*"])
