"""`pancakes doctor`: faults are reported with advice, and healthy parts are not."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

from cli.processes import READY, Rig, Running

from pancakes import __version__
from pancakes.mesh.address import Reach, TransportFacts
from pancakes.tools.cli.verbs import agent_checks
from pancakes.tools.cli.verbs.agent_checks import check_agents, check_entries
from pancakes.tools.cli.verbs.checks import Facts, Finding
from pancakes.util.runtime_dir import RunningAgent


def diagnosis(rig: Rig, *arguments: str) -> tuple[int, list[tuple[str, str, str]]]:
    """Return the exit code, and level, subject and text of all findings."""
    result = rig.pancakes("doctor", *arguments, "--format", "json")
    assert result.stderr == ""
    return result.returncode, [(row["level"], row["about"], row["text"]) for row in json.loads(result.stdout)]


def levels(findings: Iterator[Finding] | list[Finding]) -> list[tuple[str, str]]:
    return [(finding.level, finding.about) for finding in findings]


# As a command ----------------------------------------------------------------------------------------------------


def test_doctor_of_a_healthy_machine(rig: Rig):
    rig.ready("a")
    code, found = diagnosis(rig)
    assert code == 0
    assert {about for _, about, _ in found} >= {"libraries", "plug-ins", "runtime directory", "open files", "loopback"}
    assert {("ok", "a"), ("ok", "local sockets")} <= {(level, about) for level, about, _ in found}
    assert [level for level, _, _ in found if level == "error"] == []

    lines = rig.pancakes("doctor").stdout.splitlines()
    assert any(line.startswith("ok       loopback: ") for line in lines)
    assert lines[-1].startswith("errors: 0, ")


def test_doctor_names_a_changed_file_that_another_extends(rig: Rig):
    common = rig.directory / "common.toml"
    common.write_text("schema = 1\n[vars]\nspeed = 1.0\n")
    config = rig.config("a", '[clock]\nspeed = "${speed}"\n')
    config.write_text(config.read_text().replace("schema = 1", 'schema = 1\nextends = "common.toml"', 1))
    agent = rig.agent(config)
    agent.hear(READY)
    common.write_text("schema = 1\n[vars]\nspeed = 2.0\n")
    _, found = diagnosis(rig)
    assert ("warning", "a", f"runs with an old configuration: {common} was changed or removed") in [
        (level, about, text.partition(" since")[0]) for level, about, text in found
    ]


RAISES = """
from pancakes.task import Task, every

class Boom(Task):
    @every(hz=100)
    def tick(self, tick):
        raise ValueError("the wheel came off")
"""


def test_doctor_finds_faults_of_agents(rig: Rig, freeze: Callable[[Running], None]):
    rig.install("boom", "[pancakes.tasks]\nboom.Boom = plugin_boom:Boom\n", RAISES)
    task = '[task.Boom]\ntype = "boom.Boom"\nrestart = { policy = "no" }\n'
    away = rig.ready("away", task, agent='peers = ["tcp://127.0.0.1:1"]')
    if not any("Boom is given up" in line for line in away.said):
        away.hear("Boom is given up")
    rig.ready("asleep")
    assert rig.pancakes("service", "stop", "asleep/network", "--for", "1min").returncode == 0
    suspended = rig.ready("still")
    freeze(suspended)
    dead = rig.ready("dead")
    dead.signalled(signal.SIGKILL)

    code, found = diagnosis(rig, "--timeout", "1")

    assert code == 1
    texts = {(level, about): text for level, about, text in found}
    gave_up = "was given up: ValueError: the wheel came off at plugin_boom.py:7 in tick"
    assert texts["error", "away/Boom"].partition(" (")[0] == gave_up
    assert texts["warning", "away"] == "is not connected to its peer at tcp://127.0.0.1:1"
    assert "sleeps" in texts["ok", "agents"]  # also about a link that ends only now
    still = f"its process {suspended.pid} is suspended: it neither answers nor drives anything"
    assert texts["error", "still"] == still
    assert "did not answer" in texts["error", "agents"]
    assert f"dead.{dead.pid}" in texts["warning", "runtime directory"]
    again = [text for _, about, text in diagnosis(rig, "--timeout", "1")[1] if about == "runtime directory"]
    assert again and not any("dead." in text for text in again)


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
    "clock": None,
    **TransportFacts(Reach.NETWORK, encrypted=True).plain(),
}
ROUTED = {**PEER, "remote": "zenoh://1f:0", "dropped": {}, **TransportFacts(Reach.ROUTERS, encrypted=True).plain()}


def service(**other: Any) -> dict[str, Any]:
    return {"service": "camera", "state": "running", "reason": "", **other}


def agent(name: str = "a", **other: Any) -> dict[str, Any]:
    """Return the description of a healthy agent."""
    return {
        "agent": name,
        "fleet": "test",
        "ready": True,
        "held": False,
        "insecure": "",
        "roster": None,
        "utc_s": 0.0,
        "plugins": {"pancakes-x": "1.0"},
        "services": [{"service": "client", "state": "running", "reason": ""}],
        "tasks": [task()],
        "dead_letters": 0,
        "neighbours": ["b"],
        "process": {"version": __version__},
        "mesh": {"peers": [{**PEER, "dropped": {}}], "few": None, "asleep": [], "addresses": []},
        **other,
    }


def found_in(*agents: dict[str, Any], reads: tuple[dict[str, Any], ...] = ()) -> list[Finding]:
    return list(check_agents(Facts(agents, describe=lambda name, target: {"reads": reads})))


def test_doctor_reports_agents_that_are_not_linked():
    networks = [{"service": "network", "state": "running", "reason": ""}]
    found = found_in(agent("a", neighbours=[], services=networks), agent("b", neighbours=["c"]), agent("c"))
    assert levels(found) == [("warning", "a"), ("ok", "b"), ("ok", "c")]
    assert "has no link to another agent of its fleet (b, c)" in found[0].text
    asleep = [{"service": "network", "state": "stopped", "reason": ""}]
    for lone in ([agent("a", neighbours=[], services=asleep), agent("b")], [agent("a", neighbours=[])]):
        assert not any("has no link" in it.text for it in found_in(*lone))


def test_doctor_reports_an_agent_with_an_old_roster():
    found = found_in(agent("a", roster=3), agent("b", roster=5), agent("c"))
    assert levels(found) == [("warning", "a"), ("ok", "b"), ("ok", "c")]
    assert found[0].text == "has the roster 3 of its fleet, and others have the roster 5"


def test_doctor_accepts_a_healthy_agent():
    assert levels(found_in(agent())) == [("ok", "a")]
    (found,) = found_in(agent(mesh={"peers": [ROUTED], "few": None, "asleep": [], "addresses": []}))
    assert found.text == "is ready, with 1 task running and 1 neighbour; 1 link through routers"
    assert levels(found_in(agent(tasks=[task(missed=5)]))) == [("ok", "a")], "a few missed ticks are nothing"
    mesh = {"peers": [], "few": None, "asleep": [{"name": "c", "for_s": 3.0}], "addresses": [STATIC]}
    assert levels(found_in(agent(mesh=mesh))) == [("ok", "a")], "a peer that sleeps is not away"
    mesh = {"peers": [{**PEER, "dropped": {}}], "asleep": [], "addresses": [{**STATIC, "rests": True}]}
    (found,) = found_in(agent(mesh={**mesh, "few": {"links": 8, "known": 300}}))
    assert found.level == "ok" and found.text.endswith("of 300 known agents")


def test_doctor_reports_different_builds():
    def built(build: str) -> dict[str, str]:
        return {"version": __version__, "build": build}

    same = (agent("a", process=built("0.1.0-aa")), agent("b", process=built("0.1.0-aa")))
    assert "different versions" not in str(found_in(*same, agent("w", process=None)))
    (found, *_) = found_in(*same, agent("c", process=built("0.1.0-bb")), agent("d"))
    assert (found.level, found.about) == ("warning", "agents")
    assert found.text.endswith(f"different versions: {__version__} on d; 0.1.0-aa on a, b; 0.1.0-bb on c")
    assert "pancakes deploy" in found.advice


STATIC = {"address": "tcp://x:1", "static": True, "name": "c", "failures": 3, "refused": "", "rests": False}


def test_doctor_reports_an_agent_without_a_plugin():
    bare = agent("bare", plugins={})
    found = found_in(agent("a"), bare, agent("stranger", fleet="other", plugins={}))
    assert [(finding.level, finding.about) for finding in found if "pancakes-x" in finding.text] == [
        ("warning", "bare")
    ]


WRONG: list[tuple[dict[str, Any], str, str, str]] = [
    ({"ready": False}, "warning", "a", "is not ready"),
    ({"held": True}, "warning", "a", "is held at 0"),
    (
        {"warnings": [{"source": "a/log", "level": "error", "text": "no disk", "count": 2, "ago_s": 3.2}]},
        "warning",
        "a/log",
        "warned 2 times, last 3 s ago: no disk",
    ),
    (
        {"config_file": {"path": "a.toml", "changed": True}},
        "warning",
        "a",
        "runs with an old configuration: a.toml was changed",
    ),
    ({"journal_fault": "No space left"}, "error", "a", "cannot save the state of its tasks: No space left"),
    (
        {"tasks": [task(state="stopped", waits=True, reason="motors is held by a/client/B")]},
        "warning",
        "a/Scan",
        "does not run: motors is held by a/client/B",
    ),
    (
        {"mesh": {"peers": [{**ROUTED, "encrypted": False}], "few": None, "asleep": [], "addresses": []}},
        "warning",
        "a",
        "has a link to b over zenoh://, which does not encrypt",
    ),
    ({"insecure": "tcp://"}, "warning", "a", "uses tcp:// without keys"),
    (
        {"services": [service(state="failed", reason="no light")]},
        "error",
        "a/camera",
        "was given up: no light",
    ),
    ({"dead_letters": 2}, "warning", "a", "has 2 dead letters"),
    (
        {"process": {"version": "0.0.1"}},
        "warning",
        "agents",
        f"the versions 0.0.1, and this command is {__version__}",
    ),
    ({"tasks": [task(state="failed", reason="ValueError")]}, "error", "a/Scan", "was given up: ValueError"),
    (
        {"tasks": [task(state="stopped", rest="failed")]},
        "error",
        "a/Scan",
        "does not run: it was given up before its agent was last started",
    ),
    ({"tasks": [task(state="stuck")]}, "error", "a/Scan", "its handler does not return"),
    (
        {"tasks": [task(rest="disputed", reason="why")]},
        "error",
        "a/Scan",
        "is paused, because another agent owns it too",
    ),
    ({"tasks": [task(rest="waits → b, tcp://c:7400", reason="why")]}, "warning", "a/Scan", "is not born yet: why"),
    ({"tasks": [task(rest="disk lost", reason="why")]}, "error", "a/Scan", "is not born: why"),
    ({"tasks": [task(rest="old copy", reason="why")]}, "error", "a/Scan", "is paused: why"),
    ({"tasks": [task(guarding={"copied": True})]}, "error", "a/Scan", "is paused: the disk of a is a copy"),
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
]


def test_doctor_reports_faults_of_an_agent():
    for changed, level, about, text in WRONG:
        (found,) = (finding for finding in found_in(agent(**changed)) if finding.level != "ok")
        assert (found.level, found.about) == (level, about), changed
        assert text in found.text and found.advice, changed


def test_doctor_reports_readers_that_lose_packets():
    newest = {"channel": "system", "limit": 1, "dropped": 0}
    every = {"channel": "ctrl", "limit": 64, "dropped": 7}

    (finding,) = found_in(agent(tasks=[task(dropped=7)]), reads=(newest, every))

    assert (finding.level, finding.about) == ("warning", "a/Scan")
    assert finding.text.startswith("lost 7 packets on ctrl")


def test_doctor_reports_silent_agents_unless_asleep():
    sentences = ["b did not answer: its network sleeps for 8.0 s", "c did not answer"]
    found = list(check_agents(Facts(silent=sentences, asleep=sentences[:1])))
    assert [(finding.level, finding.text) for finding in found] == [("ok", sentences[0]), ("error", sentences[1])]


def test_doctor_reports_duplicate_names():
    own = os.getpid()
    twins = [RunningAgent("a", "north", "agent", (), own), RunningAgent("a", "north", "agent", (), own)]
    assert levels(check_entries(Facts(entries=twins)))[0] == ("error", "a")
    namesakes = [RunningAgent("a", "north", "agent", (), own), RunningAgent("a", "south", "agent", (), own)]
    assert levels(check_entries(Facts(entries=namesakes))) == [("warning", "a")]
    assert levels(check_entries(Facts(entries=namesakes[:1]))) == []


def test_doctor_runs_each_registered_check(monkeypatch):
    def said_of(about: str) -> Iterator[Finding]:
        yield Finding("error", about, "is found")

    for name, check in (
        ("FLEET_CHECKS", lambda facts: said_of("fleet")),
        ("AGENT_CHECKS", lambda agent, facts: said_of(agent["agent"])),
        ("TASK_CHECKS", lambda agent, task, facts: said_of(f"{agent}/{task['task']}")),
    ):
        monkeypatch.setattr(agent_checks, name, [check])

    assert [about for _, about in levels(found_in(agent("a"), agent("b")))] == ["fleet", "a", "a/Scan", "b", "b/Scan"]
