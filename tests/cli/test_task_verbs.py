"""`pancakes task start|stop|restart|rate` and `pancakes service start|stop|restart`, on a running agent."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from cli.processes import Rig, Running

SOURCE = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class Settings:
        step: int = 1
        label: str = ""

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += self.settings.step
        self.event(self.name + " counted" + self.settings.label, n=self.state.n)

    @every(hz=2)
    def look(self, tick):
        pass
"""
ENTRY_POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\n"
TASKS = (
    '[task.One]\ntype = "count.Count"\n[task.Two]\ntype = "count.Count"\n[task.Three]\ntype = "count.Count"\n'
    '[task.Idle]\ntype = "count.Count"\nstart = false\n[device.load]\ndriver = "host.load"\nrate_hz = 2\n'
)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running]]:
    """An agent with a separate task for each test."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        rig.install("count", ENTRY_POINTS, SOURCE)
        yield rig, rig.ready("a", TASKS)


def done(rig: Rig, *arguments: str) -> dict[str, Any]:
    """Run a command that must succeed and prints one row as JSON."""
    (row,) = rig.listed(*arguments)
    return row


def refused(rig: Rig, *arguments: str) -> str:
    """Run a command that must be refused, and return the sentence."""
    result = rig.pancakes(*arguments)
    assert (result.returncode, result.stdout) == (1, "")
    return result.stderr.rstrip("\n")


def listed(rig: Rig, task: str) -> tuple[str, float | None]:
    """Return the row of a task in `task list`."""
    return next((row["state"], row["rate_hz"]) for row in rig.listed("task", "list", "a") if row["task"] == task)


def counted(line: str) -> int:
    """Return the count of a task from a log line."""
    return int(line.rpartition("n=")[2])


def test_task_stop_and_start_with_other_settings(shared: tuple[Rig, Running]):
    rig, agent = shared
    agent.hear("One counted n=")
    row = done(rig, "task", "stop", "a/One")
    number = row.pop("number")
    assert row == {"agent": "a", "service": "client", "task": "One", "done": "stopped"}
    assert agent.hear("asked what=stop").endswith(f" number={number}")
    assert listed(rig, "One")[0] == "stopped"
    assert "stopped already" in refused(rig, "task", "stop", "a/One")

    row = done(rig, "task", "start", "a/client/One", "--set", "step=1000", "--set", "label=-by-hand")
    assert row["done"] == "started"
    assert counted(agent.hear("One counted-by-hand")) > 1000
    assert "step" in refused(rig, "task", "start", "a/Idle", "--set", "step=fast")
    assert listed(rig, "Idle")[0] == "stopped"


def test_task_restart_keeps_the_state_or_drops_it(shared: tuple[Rig, Running]):
    rig, agent = shared
    agent.hear("Two counted n=")
    assert done(rig, "task", "restart", "a/Two")["done"] == "restarted"
    agent.hear("task_started task=Two")
    assert counted(agent.hear("Two counted")) > 1

    assert done(rig, "task", "restart", "a/Two", "--drop-state", "--yes")["done"] == "restarted"
    agent.hear("task_started task=Two")
    assert counted(agent.hear("Two counted")) == 1


def test_task_rate_changes_a_timer(shared: tuple[Rig, Running]):
    rig, agent = shared
    assert done(rig, "task", "rate", "a/load", "8")["rate_hz"] == 8.0
    assert listed(rig, "load") == ("running", 8.0)
    assert done(rig, "task", "rate", "a/Three", "4", "--timer", "look")["rate_hz"] == 4.0
    assert listed(rig, "Three") == ("running", 20.0)
    assert "nothing" in refused(rig, "task", "rate", "a/Three", "4", "--timer", "nothing")

    result = rig.pancakes("task", "rate", "a/Three", "5", "--at", rig.address(agent))
    head, _, row = (line.split() for line in result.stdout.splitlines() if line.strip())
    assert head == ["agent", "service", "task", "done", "number", "timer", "rate_hz", "before_hz"]
    assert row[:5] + row[6:] == ["a", "client", "Three", "rate", "changed", "tick", "5", "20"]
    assert "rate_changed" in agent.hear(f" number={row[5]} ")


def test_task_and_service_verbs_are_not_confused(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    agent = rig.ready("a", '[task.device]\ntype = "count.Count"\n')
    said = refused(rig, "task", "stop", "a/client")
    assert said == "a/client is a service, not a task: see pancakes service --help"
    assert done(rig, "service", "restart", "a/device")["service"] == "device"
    agent.hear("service_stopped service=device")
    assert listed(rig, "device")[0] == "running"


def test_service_stop_for_a_time_and_start(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    agent = rig.ready("a", TASKS)
    row = done(rig, "service", "stop", "a/client")
    number = row.pop("number")
    assert row == {"agent": "a", "service": "client", "done": "stopped", "for_s": None}
    assert agent.hear("asked what=stop").endswith(f" number={number}")
    refused(rig, "service", "stop", "a/client")
    refused(rig, "task", "start", "a/One")
    assert done(rig, "service", "start", "a/client")["done"] == "started"
    assert listed(rig, "One")[0] == "running"

    assert done(rig, "service", "stop", "a/client", "--for", "100ms")["for_s"] == 0.1
    agent.hear("asked what=wake service=client")
    agent.hear("service_started service=client")
    refused(rig, "service", "stop", "a/network")
    assert done(rig, "service", "stop", "a/network", "--for", "0.2s")["done"] == "stopped"
    agent.hear("service_started service=network")
    assert listed(rig, "One")[0] == "running"


def test_service_restart_keeps_the_state_of_its_tasks_or_drops_it(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    agent = rig.ready("a", TASKS)
    done(rig, "task", "rate", "a/One", "40")
    agent.hear("One counted n=10")
    assert done(rig, "service", "restart", "a/client")["done"] == "restarted"
    agent.hear("service_started service=client")
    assert counted(agent.hear("One counted")) > 10
    assert listed(rig, "One") == ("running", 40.0)

    assert done(rig, "service", "restart", "a/client", "--drop-state", "--yes")["done"] == "restarted"
    agent.hear("service_started service=client")
    assert counted(agent.hear("One counted")) < 10
    assert listed(rig, "One") == ("running", 20.0)
