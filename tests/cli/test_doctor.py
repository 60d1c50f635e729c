"""`pancakes doctor`: what is wrong is named with what to do about it, and what is in order is not."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from cli.processes import Rig, Running

from pancakes import __version__
from pancakes.mesh.way_facts import Reach, WayFacts
from pancakes.runtime.runtime_dir import RunningAgent
from pancakes.tools.cli.verbs.agent_checks import check_entries, check_fleet
from pancakes.tools.cli.verbs.finding import Finding


def diagnosis(rig: Rig, *arguments: str) -> tuple[int, list[tuple[str, str, str]]]:
    """The exit code, and level, subject and text of all that was found."""
    result = rig.pancakes("doctor", *arguments, "--format", "json")
    assert result.stderr == ""
    return result.returncode, [(row["level"], row["about"], row["text"]) for row in json.loads(result.stdout)]


def levels(findings: Iterator[Finding] | list[Finding]) -> list[tuple[str, str]]:
    return [(finding.level, finding.about) for finding in findings]


# As a person runs it ---------------------------------------------------------------------------------------------


def test_on_a_machine_where_all_is_well(rig: Rig):
    rig.ready("a")

    code, found = diagnosis(rig)

    assert code == 0
    assert {about for _, about, _ in found} >= {"libraries", "plug-ins", "runtime directory", "open files", "loopback"}
    assert ("ok", "local sockets") in [(level, about) for level, about, _ in found]
    assert [level for level, _, _ in found if level == "error"] == []
    assert ("ok", "a") in [(level, about) for level, about, _ in found]


def test_what_it_prints_for_people(rig: Rig):
    result = rig.pancakes("doctor")

    lines = result.stdout.splitlines()
    assert any(line.startswith("ok       loopback: ") for line in lines)
    assert lines[-1].startswith("errors: 0, ")


def test_a_suspended_agent_is_found(rig: Rig, freeze: Callable[[Running], None]):
    agent = rig.ready("a")
    freeze(agent)

    code, found = diagnosis(rig, "--no-machine", "--timeout", "1")

    assert code == 1
    assert found[0] == ("error", "a", f"its process {agent.pid} is suspended: it neither answers nor drives anything")
    assert found[1][:2] == ("error", "agents")
    assert "did not answer" in found[1][2]


def test_a_peer_that_is_away_is_found(rig: Rig):
    rig.ready("a", agent='peers = ["tcp://127.0.0.1:1"]')

    code, found = diagnosis(rig, "--no-machine")

    assert code == 0
    assert found == [("warning", "a", "is not connected to its peer at tcp://127.0.0.1:1")]


RAISES = """
from pancakes.task import Task, every

class Boom(Task):
    @every(hz=100)
    def tick(self, tick):
        raise ValueError("the wheel came off")
"""


def test_a_task_that_was_given_up_is_found(rig: Rig):
    rig.install("boom", "[pancakes.tasks]\nboom.Boom = plugin_boom:Boom\n", RAISES)
    agent = rig.agent(rig.config("a", '[task.Boom]\ntype = "boom.Boom"\nrestart = { policy = "temporary" }\n'))
    agent.hear("a/client/Boom is given up")  # which may come before the agent is ready
    rig.entry(agent.pid)

    code, found = diagnosis(rig, "--no-machine")

    assert code == 1
    assert ("error", "a/Boom", "was given up: ValueError: the wheel came off at plugin_boom.py:7 in tick") in [
        (level, about, text.partition(" (")[0]) for level, about, text in found
    ]


def test_an_agent_that_was_killed_is_noticed(rig: Rig):
    agent = rig.ready("a")
    agent.signalled(signal.SIGKILL)

    _, found = diagnosis(rig)

    assert any(
        level == "warning" and about == "runtime directory" and f"a.{agent.pid}" in text for level, about, text in found
    )
    assert not any("a." in text for _, about, text in diagnosis(rig)[1] if about == "runtime directory")


def test_its_help_has_an_example(rig: Rig):
    assert "pancakes doctor" in rig.pancakes("doctor", "--help").stdout.partition("Example:")[2]


# Agents ----------------------------------------------------------------------------------------------------------


def task(name: str = "Scan", **other: Any) -> dict[str, Any]:
    plain = {
        "task": name,
        "service": "client",
        "state": "running",
        "rest": "",
        "reason": "",
        "ticks": 1000,
        "missed": 0,
    }
    return {**plain, "lateness_max_s": 0.0, "dropped": 0, **other}


PEER = {
    "name": "b",
    "role": "agent",
    "remote": "tcp://192.0.2.7:40000",
    "refused": 0,
    **WayFacts(Reach.NETWORK, encrypted=True).plain(),
}
ROUTED = {**PEER, "remote": "zenoh://1f:0", "dropped": {}, **WayFacts(Reach.ROUTERS, encrypted=True).plain()}


def service(**other: Any) -> dict[str, Any]:
    return {"service": "camera", "state": "running", "reason": "", **other}


def agent(name: str = "a", **other: Any) -> dict[str, Any]:
    """What a healthy agent says of itself."""
    return {
        "agent": name,
        "ready": True,
        "held": False,
        "insecure": "",
        "roster": None,
        "services": [{"service": "client", "state": "running", "reason": ""}],
        "tasks": [task()],
        "dead_letters": 0,
        "neighbours": ["b"],
        "process": {"version": __version__},
        "mesh": {"peers": [{**PEER, "dropped": {}}], "few": None, "asleep": [], "addresses": []},
        **other,
    }


def found_in(*agents: dict[str, Any], reads: tuple[dict[str, Any], ...] = ()) -> list[Finding]:
    return list(check_fleet(agents, (), lambda name, target: {"reads": reads}))


def test_an_agent_that_has_not_heard_of_the_last_roster_is_named():
    found = found_in(agent("a", roster=3), agent("b", roster=5), agent("c"))
    assert levels(found) == [("warning", "a"), ("ok", "a"), ("ok", "b"), ("ok", "c")]
    assert found[0].text == "goes by the roster 3 of its fleet, and others know the roster 5"


def test_a_healthy_agent_is_in_order():
    assert levels(found_in(agent())) == [("ok", "a")]


def test_links_through_routers_are_told():
    (found,) = found_in(agent(mesh={"peers": [ROUTED], "few": None, "asleep": [], "addresses": []}))
    assert found.text == "is ready, with 1 task running and 1 neighbour; 1 link through routers"


def test_builds_that_differ_over_the_fleet_are_named_with_their_agents():
    def built(build: str) -> dict[str, str]:
        return {"version": __version__, "build": build}

    same = (agent("a", process=built("0.1.0-aa")), agent("b", process=built("0.1.0-aa")))
    assert "different versions" not in str(found_in(*same, agent("w", process=None)))
    (found, *_) = found_in(*same, agent("c", process=built("0.1.0-bb")), agent("d"))
    assert (found.level, found.about) == ("warning", "agents")
    assert found.text.endswith(f"different versions: {__version__} on d; 0.1.0-aa on a, b; 0.1.0-bb on c")
    assert "pancakes deploy" in found.advice


STATIC = {"address": "tcp://x:1", "static": True, "name": "c", "failures": 3, "refused": "", "rests": False}


@pytest.mark.parametrize(
    ("changed", "level", "about", "text"),
    [
        ({"ready": False}, "warning", "a", "is not ready"),
        ({"held": True}, "warning", "a", "waits at 0"),
        (
            {"mesh": {"peers": [{**ROUTED, "encrypted": False}], "few": None, "asleep": [], "addresses": []}},
            "warning",
            "a",
            "has a link to b over zenoh://, which does not encrypt",
        ),
        ({"insecure": "tcp://"}, "warning", "a", "speaks over tcp:// without keys"),
        (
            {"services": [service(state="failed", reason="no light")]},
            "error",
            "a/camera",
            "was given up: no light",
        ),
        ({"dead_letters": 2}, "warning", "a", "readers failed at 2 packets"),
        (
            {"process": {"version": "0.0.1"}},
            "warning",
            "agents",
            f"the versions 0.0.1, and this command is {__version__}",
        ),
        ({"tasks": [task(state="failed", reason="ValueError")]}, "error", "a/Scan", "was given up: ValueError"),
        ({"tasks": [task(state="stuck")]}, "error", "a/Scan", "does not come back"),
        (
            {"tasks": [task(state="failed", reason="ValueError", failures=9, next_try_s=42.0)]},
            "error",
            "a/Scan",
            "was given up: ValueError (failed 9 times, next try in 42.0 s)",
        ),
        (
            {"tasks": [task(state="restarting", reason="x", failures=3, next_try_s=3.21)]},
            "warning",
            "a/Scan",
            "failed 3 times, next try in 3.2 s: x",
        ),
        (
            {"services": [service(state="restarting", reason="no light", failures=1, next_try_s=0.1)]},
            "warning",
            "a/camera",
            "failed once, next try in 0.1 s: no light",
        ),
        ({"tasks": [task(missed=50, lateness_max_s=0.2)]}, "warning", "a/Scan", "missed 50 of 1050 ticks"),
        (
            {"mesh": {"peers": [], "few": None, "asleep": [], "addresses": [STATIC]}},
            "warning",
            "a",
            "is not connected to its peer c at tcp://x:1",
        ),
        (
            {
                "mesh": {
                    "peers": [],
                    "few": None,
                    "asleep": [],
                    "addresses": [{**STATIC, "refused": "it is not of the fleet 'x'"}],
                }
            },
            "warning",
            "a",
            "is not connected to its peer c at tcp://x:1: it is not of the fleet 'x'",
        ),
        (
            {"mesh": {"peers": [{**PEER, "dropped": {}, "refused": 2}], "few": None, "asleep": [], "addresses": []}},
            "warning",
            "a",
            "refused 2 packets of b, which may not send them",
        ),
        (
            {"mesh": {"peers": [{**PEER, "dropped": {"log": 3}}], "few": None, "asleep": [], "addresses": []}},
            "warning",
            "a",
            "dropped 3 packets to b, which is too slow for them: 3 of log",
        ),
    ],
)
def test_what_is_wrong_with_an_agent(changed: dict[str, Any], level: str, about: str, text: str):
    found = [finding for finding in found_in(agent(**changed)) if finding.level != "ok"]

    assert levels(found) == [(level, about)]
    assert text in found[0].text
    assert found[0].advice


def test_a_few_missed_ticks_are_nothing():
    assert levels(found_in(agent(tasks=[task(missed=5)]))) == [("ok", "a")]


def test_a_peer_that_sleeps_is_not_away():
    mesh = {"peers": [], "few": None, "asleep": [{"name": "c", "for_s": 3.0}], "addresses": [STATIC]}
    assert levels(found_in(agent(mesh=mesh))) == [("ok", "a")]


def test_packets_are_lost_only_by_those_that_want_all_of_them():
    newest = {"channel": "system", "limit": 1, "dropped": 0}
    every = {"channel": "ctrl", "limit": 64, "dropped": 7}

    (finding,) = found_in(agent(tasks=[task(dropped=7)]), reads=(newest, every))

    assert (finding.level, finding.about) == ("warning", "a/Scan")
    assert finding.text.startswith("lost 7 packets on ctrl")


def test_who_says_nothing_is_an_error():
    assert levels(check_fleet([], ["b did not answer"], lambda name, target: None)) == [("error", "agents")]


def test_who_has_said_that_its_network_sleeps_is_no_error():
    sentences = ["b did not answer: its network sleeps for 8.0 s", "c did not answer"]

    found = list(check_fleet([], sentences, lambda name, target: None, asleep=sentences[:1]))

    assert [(finding.level, finding.text) for finding in found] == [("ok", sentences[0]), ("error", sentences[1])]


def test_a_network_that_sleeps_is_told_and_no_error(rig: Rig):
    rig.ready("a")
    rig.ready("b")
    assert rig.pancakes("service", "stop", "a/network", "--for", "1min").returncode == 0

    code, found = diagnosis(rig, "--no-machine")

    assert code == 0
    assert [(level, about) for level, about, *_ in found] == [("ok", "agents"), ("ok", "b")]
    assert "its network sleeps" in found[0][2]


def test_names_that_are_borne_twice():
    own = os.getpid()
    twins = [RunningAgent("a", "north", "agent", (), own), RunningAgent("a", "north", "agent", (), own)]
    assert levels(check_entries([*twins]))[0] == ("error", "a")
    namesakes = [RunningAgent("a", "north", "agent", (), own), RunningAgent("a", "south", "agent", (), own)]
    assert levels(check_entries(namesakes)) == [("warning", "a")]
    assert levels(check_entries(namesakes[:1])) == []


@pytest.mark.parametrize(
    ("rest", "level", "begins"),
    [
        ("waits → b, tcp://c:7400", "warning", "is not born yet: why"),
        ("disk lost", "error", "is not born: why"),
        ("old copy", "error", "stands still: why"),
    ],
)
def test_a_task_of_which_its_agent_does_not_know_whether_it_is_elsewhere(rest: str, level: str, begins: str) -> None:
    (finding,) = found_in(agent(tasks=[task(state="stopped", rest=rest, reason="why")]))
    assert (finding.level, finding.about) == (level, "a/Scan") and finding.text.startswith(begins) and finding.advice


def test_an_agent_that_keeps_a_few_links_says_of_how_many_and_misses_no_peer_whose_link_rests():
    mesh = {"peers": [{**PEER, "dropped": {}}], "asleep": [], "addresses": [{**STATIC, "rests": True}]}
    (found,) = found_in(agent(mesh={**mesh, "few": {"links": 8, "known": 300}}))
    assert found.level == "ok" and found.text.endswith("of 300 agents that it knows")
