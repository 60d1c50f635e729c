"""`pancakes down`: it stops agents in order and waits for them, and reports those that do not end."""

import json
from collections.abc import Callable

from cli.processes import Rig, Running

STUCK = """
import os, signal
from pancakes.task import Task

class Stuck(Task):
    def on_stop(self):
        os.kill(os.getpid(), signal.SIGSTOP)
"""


def pair(rig: Rig) -> tuple[Running, Running]:
    return rig.ready("a"), rig.ready("b", agent='role = "environment"')


def rows(text: str) -> list[tuple[str, str]]:
    return [(row["agent"], row["done"]) for row in json.loads(text)]


def test_down_stops_worlds_last(rig: Rig):
    agents = pair(rig)
    result = rig.pancakes("down", "--dry-run", "--format", "json")
    assert rows(result.stdout) == [("a", "dry run"), ("b", "dry run")]
    assert [agent.process.poll() for agent in agents] == [None, None]

    result = rig.pancakes("down", "--format", "json")
    assert (result.returncode, rows(result.stdout)) == (0, [("a", "ended"), ("b", "ended")])
    assert [agent.process.poll() for agent in agents] == [0, 0], "it has waited for both"
    assert "service_stopped service=device" in agents[0].everything()
    assert list(rig.runtime.glob("*.json")) == []
    result = rig.pancakes("down")
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "no agent runs on this machine\n")


def test_down_stops_only_selected_agents(rig: Rig):
    """At an address, agents must be named, or --all given."""
    a, b = pair(rig)
    path = rig.directory / "quiet.toml"
    path.write_text('schema = 1\n[agent]\nname = "quiet"\n')  # without a port
    quiet = rig.agent(path)
    rig.entry(quiet.pid)
    result = rig.pancakes("down", "--at", rig.address(a).removeprefix("tcp://"), "--all", "--format", "json")
    assert rows(result.stdout) == [("a", "ended")], "the others are not found from there"
    result = rig.pancakes("down", "quiet", "--format", "json")
    assert (result.returncode, rows(result.stdout)) == (0, [("quiet", "ended")])
    assert (a.ended(), quiet.ended(), b.process.poll()) == (0, 0, None)


def test_down_reports_a_missing_agent(rig: Rig):
    rig.ready("lamp")
    result = rig.pancakes("down", "lamp", "lmp", "--format", "json")
    assert (result.returncode, rows(result.stdout)) == (3, [("lamp", "ended")])
    assert "there is no agent 'lmp', did you mean 'lamp'?" in result.stderr


def test_down_reports_a_silent_agent(rig: Rig, freeze: Callable[[Running], None]):
    _, b = pair(rig)
    freeze(b)
    result = rig.pancakes("down", "--timeout", "2", "--format", "json")
    assert (result.returncode, rows(result.stdout)) == (3, [("a", "ended")])
    assert result.stderr.splitlines() == [
        "stopping a, b of the fleet test",
        f"b ({rig.addresses(b)[0]}) did not answer: nothing came within 2 s",
        f"b does not answer: sent a signal to its process {b.pid}",
        f"b (process {b.pid}) has not ended within 2 s",
    ]
    assert b.process.poll() is None


def test_down_signals_an_agent_whose_network_sleeps(rig: Rig):
    _, b = pair(rig)
    assert rig.pancakes("service", "stop", "b/network", "--for", "10min").returncode == 0
    dry = rig.pancakes("down", "--timeout", "1", "--dry-run", "--format", "json")
    assert (dry.returncode, rows(dry.stdout)) == (0, [("b", "dry run"), ("a", "dry run")])

    result = rig.pancakes("down", "--timeout", "10", "--format", "json")
    assert (result.returncode, sorted(rows(result.stdout))) == (0, [("a", "ended"), ("b", "ended")])
    assert f"b does not answer: sent a signal to its process {b.pid}" in result.stderr
    assert b.ended() == 0


def test_down_reports_an_agent_that_does_not_end(rig: Rig):
    rig.install("stuck", "[pancakes.tasks]\nstuck.Stuck = plugin_stuck:Stuck\n", STUCK)
    agent = rig.ready("a", '[task.Stuck]\ntype = "stuck.Stuck"\n')
    result = rig.pancakes("down", "a", "--timeout", "1")
    assert result.returncode == 3
    assert result.stderr.splitlines()[-1] == f"a (process {agent.pid}) has not ended within 1 s"
