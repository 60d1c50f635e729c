"""`pancakes down`: agents end in order, and it is waited for; who does not end is named."""

import json
from collections.abc import Callable

import pytest
from cli.processes import Rig, Running

QUICK = ("--timeout", "1")


@pytest.fixture
def pair(rig: Rig) -> tuple[Running, Running]:
    return rig.ready("a"), rig.ready("b", agent='role = "environment"')


def rows(text: str) -> list[tuple[str, str]]:
    return [(row["agent"], row["done"]) for row in json.loads(text)]


def test_all_agents_of_this_machine_end_in_order_worlds_last(rig: Rig, pair: tuple[Running, Running]):
    result = rig.pancakes("down", "--format", "json")

    assert (result.returncode, rows(result.stdout)) == (0, [("a", "ended"), ("b", "ended")])
    assert [agent.process.poll() for agent in pair] == [0, 0]  # it has waited for both
    assert "service_stopped service=device" in pair[0].everything()
    assert list(rig.runtime.glob("*.json")) == []


def test_only_those_that_are_named_end(rig: Rig, pair: tuple[Running, Running]):
    result = rig.pancakes("down", "b", "--format", "json")

    assert (result.returncode, rows(result.stdout)) == (0, [("b", "ended")])
    assert pair[1].ended() == 0
    assert pair[0].process.poll() is None


def test_a_dry_run_ends_nobody(rig: Rig, pair: tuple[Running, Running]):
    result = rig.pancakes("down", "--dry-run", "--format", "json")

    assert rows(result.stdout) == [("a", "dry run"), ("b", "dry run")]
    assert [agent.process.poll() for agent in pair] == [None, None]
    assert len(json.loads(rig.pancakes("agent", "list", "--format", "json").stdout)) == 2


def test_who_does_not_answer_is_named_and_the_others_end(
    rig: Rig, pair: tuple[Running, Running], freeze: Callable[[Running], None]
):
    freeze(pair[1])

    result = rig.pancakes("down", *QUICK, "--format", "json")

    assert (result.returncode, rows(result.stdout)) == (3, [("a", "ended")])
    pid = pair[1].pid
    assert result.stderr.splitlines() == [
        f"b ({rig.addresses(pair[1])[0]}) did not answer: nothing came within 1 s",
        f"b is told to end by a signal to its process {pid}",
        f"b (process {pid}) has not ended within 1 s",
    ]
    assert pair[1].process.poll() is None


def test_an_agent_whose_network_sleeps_ends_by_its_process(rig: Rig, pair: tuple[Running, Running]):
    assert rig.pancakes("service", "stop", "b/network", "--for", "10min").returncode == 0

    dry = rig.pancakes("down", *QUICK, "--dry-run", "--format", "json")
    assert (dry.returncode, rows(dry.stdout)) == (0, [("b", "dry run"), ("a", "dry run")])
    result = rig.pancakes("down", "--timeout", "10", "--format", "json")

    assert (result.returncode, sorted(rows(result.stdout))) == (0, [("a", "ended"), ("b", "ended")])
    assert f"b is told to end by a signal to its process {pair[1].pid}" in result.stderr
    assert pair[1].ended() == 0


STUCK = """
import threading
from pancakes.task import Task

class Stuck(Task):
    blocking = True

    def on_start(self):
        self.log("info", "stuck from now on")
        threading.Event().wait()
"""


def test_who_has_not_ended_in_time_is_named_with_its_process(rig: Rig):
    rig.install("stuck", "[pancakes.tasks]\nstuck.Stuck = plugin_stuck:Stuck\n", STUCK)
    agent = rig.agent(rig.config("a", '[task.Stuck]\ntype = "stuck.Stuck"\n'))
    agent.hear("stuck from now on")
    rig.entry(agent.pid)

    result = rig.pancakes("down", "a", "--timeout", "0.5")

    assert result.returncode == 3
    assert result.stderr == f"a (process {agent.pid}) has not ended within 0.5 s\n"


def test_agents_at_an_address_have_to_be_named_or_all_of_them_meant(rig: Rig, pair: tuple[Running, Running]):
    address = rig.address(pair[0]).removeprefix("tcp://")

    assert rig.pancakes("down", "--at", address).returncode == 2
    assert rig.pancakes("down", "--all").returncode == 2
    result = rig.pancakes("down", "--at", address, "--all", "--format", "json")
    assert rows(result.stdout) == [("a", "ended")]  # b was not found from there
    assert pair[1].process.poll() is None


def test_an_agent_without_a_port_is_found_and_ended(rig: Rig):
    path = rig.directory / "quiet.toml"
    path.write_text('schema = 1\n[agent]\nname = "quiet"\n')
    agent = rig.agent(path)
    assert rig.addresses(agent) == ["local://quiet"]

    result = rig.pancakes("down")

    assert result.returncode == 0, result.stderr
    assert agent.process.wait(10.0) == 0


def test_agents_of_two_fleets_may_have_the_same_name(rig: Rig):
    rig.ready("a", fleet="north")
    rig.ready("a", fleet="south")

    result = rig.pancakes("down", "--format", "json")

    assert result.returncode == 0
    assert [(row["fleet"], row["done"]) for row in json.loads(result.stdout)] == [
        ("north", "ended"),
        ("south", "ended"),
    ]


def test_where_nobody_runs_nothing_is_to_be_done(rig: Rig):
    result = rig.pancakes("down")

    assert (result.returncode, result.stdout, result.stderr) == (0, "", "no agent runs on this machine\n")
    assert rig.pancakes("down", "a").returncode == 3


def test_its_help_has_an_example(rig: Rig):
    assert "pancakes down" in rig.pancakes("down", "--help").stdout.partition("Example:")[2]
