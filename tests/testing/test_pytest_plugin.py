"""The pytest plug-in: what its fixtures give to a test, and what they find when it is over."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest_plugins = ["pytester"]

BLINK = """
import pytest

from pancakes.control import Stop
from pancakes.devices import Load
from pancakes.task import Task, every
from pancakes.testing import assert_published


class Blink(Task):
    @every(hz=2)
    def blink(self, tick):
        self.publish("system", Load(tick.time_s))

"""

FIXTURES = """
def test_a_fleet_in_virtual_time(fleet):
    a = fleet.start("a", tasks={"Blink": Blink})
    fleet.start("b")
    fleet.connect()
    assert_published(a, Load, lambda load: load.cpu == 9.0)
    assert fleet.now() == pytest.approx(9.0, abs=0.5)

def test_an_agent_in_virtual_time(virtual_agent, fleet):
    agent = virtual_agent(tasks={"Blink": Blink})
    assert agent is fleet.agents["a"]
    assert agent.kernel.virtual is not None
    assert_published(agent, Load, times=20, within_s=10.0)

def test_an_agent_on_threads(threaded_agent):
    agent = threaded_agent("t", tasks={"Blink": Blink}, speed=50.0)
    assert agent.kernel.virtual is None
    assert_published(agent, Load, lambda load: load.cpu >= 2.0)

def test_either(any_agent):
    agent = any_agent(tasks={"Blink": Blink}, speed=20.0)
    assert_published(agent, Load)
    assert agent.ask(Stop("Blink")).ok

def test_another_probe(any_agent, probe):
    agent = any_agent(tasks={"Blink": Blink}, speed=20.0)
    ctrl, system = probe(agent, "ctrl"), probe(agent, "system")
    assert_published(system, Load)
    assert ctrl.packets() == []

def test_a_clock(virtual_clock):
    virtual_clock.advance_to(3.0)
    assert virtual_clock.now() == 3.0

@pytest.mark.pancakes(seed=7, latency_s=0.5)
def test_its_network(fleet, pancakes_seed):
    assert fleet.seed == pancakes_seed == 7
    assert fleet.network.quality("a", "b").latency_s == 0.5
"""

LEAKS = """
import gc
import socket
import threading

gate = threading.Event()
kept = []

def test_a_thread(no_leaks):
    threading.Thread(target=gate.wait, name="forgotten", daemon=True).start()

def test_a_file(virtual_agent):
    kept.append(open(__file__))

def test_a_socket(virtual_agent):
    kept.append(socket.socket())

def test_an_agent(threaded_agent):
    agent = threaded_agent("stays").agent
    kept.append(agent.stop)
    agent.stop = lambda: None

class Stuck(Task):
    blocking = True

    @every(hz=10)
    def wait(self, tick):
        gate.wait()

def test_a_stuck_task(threaded_agent):
    agent = threaded_agent("stuck", tasks={"Stuck": Stuck})
    agent.wait_until(lambda: agent.component("client/Stuck").timers["wait"].ticks > 0)

def test_what_nobody_refers_to_any_more(virtual_agent):
    class Owner:
        def __init__(self):
            self.itself = self
            self.socket = socket.socket()

        def __del__(self):
            self.socket.close()

    gc.collect()
    gc.disable()
    Owner()
    gc.enable()

@pytest.mark.pancakes(leaks=False)
def test_on_purpose(virtual_agent):
    kept.append(socket.socket())

def test_that_breaks_off(virtual_agent):
    kept.append(socket.socket())
    assert False, "broken off"

def test_that_ends_what_was_left():
    kept[2]()
    gate.set()
"""


@pytest.fixture
def pytest_of(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch):
    """Run pytest in a process of its own, with every warning an error."""
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)

    def run(source: str, *options: str) -> pytest.RunResult:
        pytester.makepyfile(test_inner=source)
        return pytester.runpytest_subprocess("-W", "error", "--strict-markers", "-p", "no:cacheprovider", *options)

    return run


@pytest.mark.parametrize("options", [(), ("-n", "2")], ids=["in one process", "with xdist"])
def test_the_fixtures(pytest_of, options):
    pytest_of(BLINK + FIXTURES, *options).assert_outcomes(passed=9)


def test_what_a_test_leaves_behind_is_an_error_of_that_test(pytest_of):
    result = pytest_of(BLINK + LEAKS, "-v")
    result.assert_outcomes(passed=8, failed=1, errors=5)
    result.stdout.fnmatch_lines(
        [
            "*ERROR at teardown of test_a_thread*",
            "*when the test was over, threads are left: forgotten*",
            "*ERROR at teardown of test_a_file*",
            "*when the test was over, sockets and files are left: *test_inner.py (descriptor *)*",
            "*ERROR at teardown of test_a_socket*",
            "*when the test was over, sockets and files are left: socket:*",
            "*ERROR at teardown of test_an_agent*",
            "*when the test was over, threads are left: stays-*; actors are left: stays (the whole agent)*",
            "*ERROR at teardown of test_a_stuck_task*",
            "*when the test was over, threads are left: stuck-*; actors are left: *stuck/client/Stuck*",
        ]
    )
    result.stdout.no_fnmatch_line("*ERROR at teardown of test_on_purpose*")
    result.stdout.no_fnmatch_line("*ERROR at teardown of test_that_breaks_off*")


def test_a_test_that_fails_shows_the_log_of_its_agents(pytest_of):
    result = pytest_of(
        BLINK
        + """
class Loud(Task):
    def on_start(self):
        self.log("warning", f"this is {self.agent}")

def test_it(fleet):
    fleet.start("a", tasks={"Loud": Loud})
    fleet.start("b", tasks={"Loud": Loud})
    fleet.stop("b")
    assert False
"""
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*log of the agent a*", "*this is a*", "*log of the agent b*", "*this is b*"])


SEEDS = """
def test_drawn(fleet, pancakes_seed):
    print("drawn", pancakes_seed)

@pytest.mark.pancakes(seed=40)
def test_fixed(virtual_agent, pancakes_seed):
    print("fixed", pancakes_seed)

def test_other(virtual_clock):
    pass
"""


def test_a_test_may_run_under_many_seeds(pytest_of):
    result = pytest_of(BLINK + SEEDS, "--pancakes-seeds", "2", "--pancakes-seed", "5", "-v", "-s")
    result.assert_outcomes(passed=5)
    result.stdout.fnmatch_lines(["*test_drawn?seed5*drawn 5*", "*test_drawn?seed6*drawn 6*", "*test_fixed?seed40*"])
    result.stdout.fnmatch_lines(["*fixed 41*"])

    pytest_of(BLINK + SEEDS).assert_outcomes(passed=3)


def test_a_marker_or_an_option_that_makes_no_sense_is_named(pytest_of):
    result = pytest_of(BLINK + "@pytest.mark.pancakes(sed=7)\ndef test_it(fleet): pass\n")
    result.stdout.fnmatch_lines(
        ["*test_it: the marker pancakes knows no sed, only seed, leaks, latency_s, *, by name*"]
    )

    result = pytest_of(BLINK + SEEDS, "--pancakes-seeds", "0")
    result.stderr.fnmatch_lines(["*--pancakes-seeds: 0 is less than one seed*"])


def test_pytest_starts_without_the_agents_where_no_test_asks_for_them(pytest_of):
    pytest_of(
        """
import sys

def test_it():
    ours = [name for name in sys.modules if name.partition(".")[0] == "pancakes"]
    assert sorted(ours) == ["pancakes", "pancakes.pytest_plugin"]
    assert "numpy" not in sys.modules and "pykka" not in sys.modules
"""
    ).assert_outcomes(passed=1)


def test_nothing_that_an_agent_imports_imports_pytest():
    code = "import sys, pancakes.agent.agent, pancakes.tools.cli.agent_command, pancakes.tools.cli.main; "
    code += "import pancakes.testing; "
    code += "from pancakes.testing import Fleet, threaded_agent; print('pytest' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "False\n"
