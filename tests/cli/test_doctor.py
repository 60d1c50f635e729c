"""`pancakes doctor`: what is wrong is named with what to do about it, and what is in order is not."""

import json
import os
import resource
import signal
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig, Running

from pancakes import __version__
from pancakes.mesh.way_facts import Reach, WayFacts
from pancakes.runtime.journal import FileJournal, JournalEntry
from pancakes.runtime.plugins import Plugins
from pancakes.runtime.runtime_dir import VARIABLE, RunningAgent
from pancakes.tools.cli.verbs.agent_checks import check_entries, check_fleet
from pancakes.tools.cli.verbs.finding import Finding
from pancakes.tools.cli.verbs.machine_checks import (
    check_files,
    check_plugins,
    check_python,
    check_runtime_dir,
    check_sockets,
    check_state_dirs,
)


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


# The machine -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "bounds", "good"),
    [
        ("4.5.0", ">=4.5,<5", True),
        ("4.10", ">=4.5", True),
        ("5.0.1", ">=4.5,<5", False),
        ("4.4.9", ">=4.5,<5", False),
        ("5.0rc1", ">=4.5", True),
        ("9", "", True),
    ],
)
def test_versions(version: str, bounds: str, good: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.metadata.requires", lambda name: [f"pykka{bounds}"])
    monkeypatch.setattr("importlib.metadata.version", lambda name: version)

    assert all(it.level == "ok" for it in check_python()) is good


def test_a_library_that_is_missing_or_too_old_is_named(monkeypatch: pytest.MonkeyPatch):
    needs = ["msgpack>=99", "no-such-library>=1", "pytest>=999 ; extra == 'test'"]
    monkeypatch.setattr("importlib.metadata.requires", lambda name: needs)

    found = list(check_python())

    assert [(it.level, it.text.partition(" ")[0]) for it in found] == [
        ("error", "msgpack"),
        ("error", "no-such-library"),
        ("ok", "Python"),
    ]
    assert found[0].advice == "pip install 'msgpack>=99'"


def test_a_plugin_that_cannot_be_imported_is_named():
    class Broken(Plugins):
        def get(self, group: str, name: str) -> Any:
            from pancakes.errors import PluginError

            if name == "host.load":
                raise PluginError("the driver 'host.load' cannot be loaded")
            return super().get(group, name)

    found = list(check_plugins(Broken()))

    assert (found[0].level, found[0].text) == ("error", "the driver 'host.load' cannot be loaded")
    assert "pancakes-agents" in found[0].advice


def test_a_runtime_directory_that_is_open_to_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    directory = tmp_path / "runtime"
    monkeypatch.setenv(VARIABLE, str(directory))
    assert levels(check_runtime_dir()) == [("ok", "runtime directory")]  # it is not there
    directory.mkdir(mode=0o755)
    (finding,) = check_runtime_dir()
    assert finding.level == "error"
    assert f"chmod 700 {directory}" in finding.advice
    directory.chmod(0o700)
    assert levels(check_runtime_dir()) == [("ok", "runtime directory")]


def test_directories_of_sockets_that_others_can_reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "runtime"))
    assert levels(check_sockets()) == [], "no agent has listened yet"
    fleet = tmp_path / "runtime" / "local" / "garage"
    fleet.mkdir(parents=True, mode=0o700)
    fleet.parent.chmod(0o750)
    assert levels(check_sockets()) == [("ok", "local sockets")]
    (fleet / "a.sock").write_text("")
    (finding,) = check_sockets()
    assert (finding.level, finding.text) == (
        "warning",
        f"{fleet / 'a.sock'} is no socket, so no agent can listen there",
    )
    fleet.chmod(0o755)
    (finding,) = check_sockets()
    assert finding.level == "error" and f"{fleet} is open to other users" in finding.text
    assert finding.advice.endswith(f"chmod 700 {fleet}")
    fleet.parent.chmod(0o755)
    assert levels(check_sockets()) == [("error", "local sockets")] * 2


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[FileJournal]:
    journal = FileJournal(tmp_path / "state" / "fleet" / "a")
    journal.write([JournalEntry("task", "a/Scan", b"state")])
    yield journal
    journal.close()


def test_a_state_directory_says_who_uses_it(tmp_path: Path, journal: FileJournal):
    first, second = check_state_dirs(tmp_path / "state")
    assert first.text.endswith(f"MiB are free at {tmp_path / 'state'}")
    assert second.text == f"{journal.directory} is in use by process {os.getpid()}"
    journal.close()
    assert list(check_state_dirs(tmp_path / "state"))[1].text == f"{journal.directory} is not in use"


def test_a_torn_entry_is_found_and_left_alone(tmp_path: Path, journal: FileJournal):
    (torn,) = journal.directory.glob("task.*")
    torn.write_bytes(torn.read_bytes()[:-3])

    _, finding = check_state_dirs(tmp_path / "state")

    assert finding.level == "error"
    assert f"{torn.name} is torn or damaged" in finding.text
    assert torn.exists()


def test_what_was_set_aside_is_named(tmp_path: Path, journal: FileJournal):
    (torn,) = journal.directory.glob("task.*")
    torn.rename(torn.with_name(torn.name + ".bad"))

    _, finding = check_state_dirs(tmp_path / "state")

    assert (finding.level, torn.name + ".bad" in finding.text) == ("warning", True)


def test_a_record_that_was_lost_is_to_be_decided_about_until_there_is_another(tmp_path: Path, journal: FileJournal):
    journal.write([JournalEntry("record", "a/Scan", b"")])
    (record,) = journal.directory.glob("record.*")
    record.rename(record.with_name(record.name + ".2.bad"))

    _, finding = check_state_dirs(tmp_path / "state")

    assert finding.level == "warning" and "pancakes task forget" in finding.advice
    journal.write([JournalEntry("record", "a/Scan", b"")])
    _, finding = check_state_dirs(tmp_path / "state")
    assert finding.advice == "none is needed any more: remove them"


def test_a_state_directory_that_others_can_write(tmp_path: Path, journal: FileJournal):
    journal.directory.chmod(0o770)
    _, finding = check_state_dirs(tmp_path / "state")
    assert finding.level == "error" and f"chmod go-w {journal.directory}" in finding.text


@pytest.mark.parametrize(("free_mib", "level"), [(10, "error"), (100, "warning"), (10_000, "ok")])
def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mib: int, level: str):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage(0, 0, free_mib * 2**20))

    assert levels(check_state_dirs(tmp_path)) == [(level, "state")]


def test_too_few_files():
    assert check_files(64, 4096).level == "warning"
    assert check_files(64, 4096).advice == "ulimit -n 1024"
    assert check_files(1024, 4096).level == "ok"
    assert check_files(resource.RLIM_INFINITY, resource.RLIM_INFINITY).level == "ok"


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
        "mesh": {"peers": [{**PEER, "dropped": {}}], "asleep": [], "addresses": []},
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
    (found,) = found_in(agent(mesh={"peers": [ROUTED], "asleep": [], "addresses": []}))
    assert found.text == "is ready, with 1 task running and 1 neighbour; 1 link through routers"


STATIC = {"address": "tcp://x:1", "static": True, "name": "c", "failures": 3, "refused": ""}


@pytest.mark.parametrize(
    ("changed", "level", "about", "text"),
    [
        ({"ready": False}, "warning", "a", "is not ready"),
        ({"held": True}, "warning", "a", "waits at 0"),
        (
            {"mesh": {"peers": [{**ROUTED, "encrypted": False}], "asleep": [], "addresses": []}},
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
            {"mesh": {"peers": [], "asleep": [], "addresses": [STATIC]}},
            "warning",
            "a",
            "is not connected to its peer c at tcp://x:1",
        ),
        (
            {"mesh": {"peers": [], "asleep": [], "addresses": [{**STATIC, "refused": "it is not of the fleet 'x'"}]}},
            "warning",
            "a",
            "is not connected to its peer c at tcp://x:1: it is not of the fleet 'x'",
        ),
        (
            {"mesh": {"peers": [{**PEER, "dropped": {}, "refused": 2}], "asleep": [], "addresses": []}},
            "warning",
            "a",
            "refused 2 packets of b, which may not send them",
        ),
        (
            {"mesh": {"peers": [{**PEER, "dropped": {"log": 3}}], "asleep": [], "addresses": []}},
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
    mesh = {"peers": [], "asleep": [{"name": "c", "for_s": 3.0}], "addresses": [STATIC]}
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
