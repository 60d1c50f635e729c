"""`pancakes task start|stop|restart|rate` and `pancakes service start|stop|restart`, on an agent that runs."""

import json
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
        self.event("counted" + self.settings.label, n=self.state.n)

    @every(hz=2)
    def look(self, tick):
        pass
"""
TASKS = '[task.Count]\ntype = "count.Count"\n\n[task.Idle]\ntype = "count.Count"\nstart = false\n'
LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'


def done(rig: Rig, *arguments: str) -> dict[str, Any]:
    """Runs a command that prints one row as JSON and succeeds."""
    result = rig.pancakes(*arguments, "--format", "json")
    assert result.returncode == 0, result.stderr
    (row,) = json.loads(result.stdout)
    return row


def refused(rig: Rig, *arguments: str) -> str:
    """Runs a command that is refused, and returns the sentence."""
    result = rig.pancakes(*arguments)
    assert (result.returncode, result.stdout) == (1, "")
    return result.stderr.rstrip("\n")


def listed(rig: Rig, task: str) -> tuple[str, float | None]:
    """What `task list` says of a task."""
    rows = json.loads(rig.pancakes("task", "list", "a", "--format", "json").stdout)
    return next((row["state"], row["rate_hz"]) for row in rows if row["task"] == task)


def counted(line: str) -> int:
    """What a line says that a task has counted."""
    return int(line.rpartition("n=")[2])


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
    return rig.ready("a", TASKS + LOAD)


def test_a_task_is_stopped_and_started_with_other_settings(rig: Rig, agent: Running):
    row = done(rig, "task", "stop", "a/Count")
    number = row.pop("number")
    assert row == {"agent": "a", "service": "client", "task": "Count", "done": "stopped"}
    assert agent.hear("asked what=stop").endswith(f" number={number}")
    assert listed(rig, "Count")[0] == "stopped"
    assert refused(rig, "task", "stop", "a/Count") == "a/client/Count is stopped already"

    row = done(rig, "task", "start", "a/client/Count", "--set", "step=1000", "--set", "label=-by-hand")

    assert row["done"] == "started"
    assert counted(agent.hear("counted-by-hand")) > 1000
    assert refused(rig, "task", "start", "a/Count") == "a/client/Count is running already"


def test_a_setting_that_is_none_starts_nothing(rig: Rig, agent: Running):
    assert "step" in refused(rig, "task", "start", "a/Idle", "--set", "step=fast")
    assert "stepp: unknown key, did you mean 'step'?" in refused(rig, "task", "start", "a/Idle", "--set", "stepp=2")
    assert rig.pancakes("task", "start", "a/Idle", "--set", "step").returncode == 2
    assert listed(rig, "Idle")[0] == "stopped"


def test_a_restart_keeps_the_state_or_drops_it(rig: Rig, agent: Running):
    agent.hear("counted n=10")
    assert done(rig, "task", "restart", "a/Count")["done"] == "restarted"
    agent.hear("task_started task=Count")
    assert counted(agent.hear("counted")) > 10

    assert done(rig, "task", "restart", "a/Count", "--drop-state")["done"] == "restarted"
    agent.hear("task_started task=Count")
    assert counted(agent.hear("counted")) == 1


def test_a_rate_is_changed(rig: Rig, agent: Running):
    assert done(rig, "task", "rate", "a/load", "8")["rate_hz"] == 8.0
    assert listed(rig, "load") == ("running", 8.0)
    assert done(rig, "task", "rate", "a/Count", "4", "--timer", "look")["rate_hz"] == 4.0
    assert listed(rig, "Count") == ("running", 20.0)
    assert "nothing" in refused(rig, "task", "rate", "a/Count", "4", "--timer", "nothing")


def test_a_table_says_what_was_done(rig: Rig, agent: Running):
    result = rig.pancakes("task", "rate", "a/Count", "5", "--at", rig.address(agent))

    head, _, row = (line.split() for line in result.stdout.splitlines() if line.strip())
    assert head == ["agent", "service", "task", "done", "number", "timer", "rate_hz", "before_hz"]
    assert row[:5] + row[6:] == ["a", "client", "Count", "rate", "changed", "tick", "5", "20"]
    assert f" number={row[5]} " in agent.hear("rate_changed")


def test_a_service_is_stopped_for_a_time_and_started(rig: Rig, agent: Running):
    row = done(rig, "service", "stop", "a/client")
    number = row.pop("number")
    assert row == {"agent": "a", "service": "client", "done": "stopped", "for_s": None}
    assert agent.hear("asked what=stop").endswith(f" number={number}")
    assert refused(rig, "service", "stop", "a/client") == "a/client is stopped, not running"
    assert refused(rig, "task", "start", "a/Count") == "a/client is stopped, and Count with it"
    assert refused(rig, "task", "start", "a/Nothing").startswith("a has no task")
    assert done(rig, "service", "start", "a/client")["done"] == "started"
    assert listed(rig, "Count")[0] == "running"

    assert done(rig, "service", "stop", "a/client", "--for", "100ms")["for_s"] == 0.1
    agent.hear("asked what=wake service=client")
    agent.hear("service_started service=client")

    assert done(rig, "service", "restart", "a/device")["done"] == "restarted"
    agent.hear("service_stopped service=device")


def test_a_restart_of_a_service_keeps_the_state_of_its_tasks_or_drops_it(rig: Rig, agent: Running):
    done(rig, "task", "rate", "a/Count", "40")
    agent.hear("counted n=10")
    assert done(rig, "service", "restart", "a/client")["done"] == "restarted"
    agent.hear("service_started service=client")
    assert counted(agent.hear("counted")) > 10
    assert listed(rig, "Count") == ("running", 40.0)

    assert done(rig, "service", "restart", "a/client", "--drop-state")["done"] == "restarted"
    agent.hear("service_started service=client")
    assert counted(agent.hear("counted")) < 10
    assert listed(rig, "Count") == ("running", 20.0)


def test_the_network_can_be_stopped_for_a_time_only(rig: Rig, agent: Running):
    assert "only for a time" in refused(rig, "service", "stop", "a/network")
    assert done(rig, "service", "stop", "a/network", "--for", "0.2s")["done"] == "stopped"
    agent.hear("service_started service=network")
    assert listed(rig, "Count")[0] == "running"


def test_a_task_verb_never_means_a_service(rig: Rig, agent: Running):
    expected = "a/client is a service, not a task: see pancakes service --help"
    assert refused(rig, "task", "stop", "a/client") == expected
    assert listed(rig, "Count")[0] == "running"


def test_a_service_verb_never_means_a_task(rig: Rig):
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
    agent = rig.ready("a", '[task.device]\ntype = "count.Count"\n')

    done(rig, "service", "restart", "a/device")

    agent.hear("service_stopped service=device")
    assert listed(rig, "device")[0] == "running"
    assert refused(rig, "service", "stop", "a/devise").startswith("a has no service 'devise', only ")


def test_who_is_not_there_is_told(rig: Rig, agent: Running):
    assert refused(rig, "task", "stop", "a/Cuont") == "a has no task 'Cuont', did you mean 'Count'?"
    result = rig.pancakes("task", "stop", "b/Count")
    assert (result.returncode, result.stderr) == (3, "there is no agent 'b', only a\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ("task", "stop", "Count"),
        ("task", "stop", "a/b/c/d/e"),
        ("task", "stop", "a/"),
        ("task", "rate", "a/Count", "fast"),
        ("task", "rate", "a/Count", "-1"),
        ("task", "rate", "a/Count", "nan"),
        ("task", "list", "--timeout", "nan"),
        ("service", "stop", "a"),
        ("service", "stop", "test/a/client/Count"),
        ("service", "stop", "a/client", "--for", "soon"),
        ("service", "stop", "a/client", "--for", "0s"),
        ("task", "migrate", "Count"),
        ("task", "adopt", "Count"),
    ],
)
def test_what_cannot_be_read_is_exit_code_2(rig: Rig, arguments: tuple[str, ...]):
    result = rig.pancakes(*arguments)
    assert result.returncode == 2
    assert "Usage: " in result.stderr


@pytest.mark.parametrize("verb", ["start", "stop", "restart", "rate", "migrate", "migrations", "adopt"])
def test_each_verb_of_a_task_has_help_with_an_example(rig: Rig, verb: str):
    assert f"pancakes task {verb}" in rig.pancakes("task", verb, "--help").stdout.partition("Example:")[2]


@pytest.mark.parametrize("verb", ["start", "stop", "restart"])
def test_each_verb_of_a_service_has_help_with_an_example(rig: Rig, verb: str):
    assert f"pancakes service {verb}" in rig.pancakes("service", verb, "--help").stdout.partition("Example:")[2]
