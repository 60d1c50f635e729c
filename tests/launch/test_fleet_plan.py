"""Reading files and folders into the agents of a fleet, or into all of their faults."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from pancakes.config import parse
from pancakes.errors import ConfigError, PancakesError
from pancakes.tools.cli.verbs.up import host_start
from pancakes.tools.launch.fleet_file import Member, ProcessRestart, check_free, fleet_schema, make_fleet
from pancakes.util.runtime_dir import VARIABLE, Registration, RunningAgent


def write(path: Path, name: str = "", rest: str = "") -> Path:
    path.write_text(f'schema = 1\n[agent]\nname = "{name or path.stem}"\n{rest}\n')
    return path


def fleet(folder: Path, text: str) -> list[Member]:
    """Read a folder with this fleet file."""
    (folder / "fleet.toml").write_text(f"schema = 1\n{text}")
    return make_fleet([folder], (), None, None)


def faults(folder: Path, text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        fleet(folder, text)
    return [str(fault).removeprefix(f"{folder}/") for fault in caught.value.faults]


def test_files_become_agents_in_the_given_order(tmp_path: Path) -> None:
    paths = [write(tmp_path / "b.toml"), write(tmp_path / "a.toml", "other")]

    members = make_fleet(paths, (), None, None)

    assert [(it.name, it.path) for it in members] == [("b", paths[0]), ("other", paths[1])]
    assert all(it.restart == ProcessRestart("on-failure", 3, 60.0) and it.after == () for it in members)


def test_folder_files_are_sorted_with_worlds_first(tmp_path: Path) -> None:
    write(tmp_path / "b.toml")
    write(tmp_path / "a.toml")
    write(tmp_path / "world.toml", rest='role = "environment"')

    members = make_fleet([tmp_path], (), None, None)

    assert [(it.name, it.after) for it in members] == [("world", ()), ("a", ("world",)), ("b", ("world",))]


def test_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"folder: contains no configuration"):
        make_fleet([tmp_path], (), None, None)


def test_fleet_file_defines_its_agents(tmp_path: Path) -> None:
    write(tmp_path / "gate.toml", rest='fleet = "other"')
    write(tmp_path / "node.toml", rest="[clock]\nspeed = 2.0")

    members = fleet(
        tmp_path,
        """
        [fleet]
        name = "field"
        set = { clock.hold = true }
        restart = { policy = "always", at_most = 9 }
        [agent.gate]
        [agent.node1]
        config = "node.toml"
        after = ["gate"]
        set = { agent.seed = 1 }
        [agent.node2]
        config = "node.toml"
        restart = { policy = "no" }
        """,
    )

    gate, first, second = members
    assert [it.name for it in members] == ["gate", "node1", "node2"]
    assert [it.config.agent.name for it in members] == ["gate", "node1", "node2"]
    assert {it.config.agent.fleet for it in members} == {"field"}
    assert all(it.config.clock.hold for it in members)
    assert (first.config.clock.speed, first.config.agent.seed, second.config.agent.seed) == (2.0, 1, None)
    assert gate.restart == ProcessRestart("always", 9, 60.0)
    assert second.restart == ProcessRestart("no", 3, 60.0)
    assert (first.after, second.after) == (("gate",), ())
    assert first.path == tmp_path / "node.toml"


def test_command_line_overrides_the_fleet_file(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a.toml", rest="[clock]\nspeed = 2.0"), write(tmp_path / "b.toml")]

    first, second = make_fleet(paths, ("a:clock.speed=3", "agent.seed=7"), "always", None)

    assert (first.config.clock.speed, second.config.clock.speed) == (3.0, 1.0)
    assert (first.config.agent.seed, second.config.agent.seed) == (7, 7)
    assert first.restart.policy == "always"
    assert first.sets == ("clock.speed=3", "agent.seed=7")
    with pytest.raises(ConfigError, match=r"--set c:clock.speed=3: c: is not one of the agents a, b"):
        make_fleet(paths, ("c:clock.speed=3",), None, None)


def test_faults_of_all_files_are_reported_together(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a.toml", rest="lisen = 1"), write(tmp_path / "b.toml", rest="[clock]\nspeed = 0")]

    with pytest.raises(ConfigError) as caught:
        make_fleet([*paths, tmp_path / "c.toml"], (), None, None)

    assert [fault.key for fault in caught.value.faults] == ["file", "[agent] lisen", "[clock] speed"]


@pytest.mark.parametrize(
    ("first", "second", "problem"),
    [
        ('listen = "tcp://127.0.0.1:7401"', 'listen = "tcp://127.0.0.1:7401"', "already listens at this port"),
        ('state_dir = "s"', 'state_dir = "s"', "is the state directory of a"),
    ],
)
def test_two_agents_cannot_share_a_port_or_directory(tmp_path: Path, first: str, second: str, problem: str) -> None:
    paths = [write(tmp_path / "a.toml", rest=first), write(tmp_path / "b.toml", rest=second)]

    with pytest.raises(ConfigError) as caught:
        make_fleet(paths, (), None, None)

    (fault,) = caught.value.faults
    assert problem in fault.problem
    assert fault.where == f"{paths[1]}:4"


def test_ports_chosen_by_the_system_do_not_clash(tmp_path: Path) -> None:
    rest = 'listen = "tcp://127.0.0.1:0"'
    make_fleet([write(tmp_path / "a.toml", rest=rest), write(tmp_path / "b.toml", rest=rest)], (), None, None)


def test_two_agents_of_one_name_are_a_fault(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a.toml"), write(tmp_path / "b.toml", "a")]

    with pytest.raises(ConfigError, match=r"b.toml: \[agent\] name: .*a.toml already defines an agent 'a'"):
        make_fleet(paths, (), None, None)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[agent.a]\n", ["fleet.toml: [fleet]: is missing: a fleet file has a table [fleet], which may be empty"]),
        ("[fleet]\n", ["fleet.toml: [agent]: expected a table for each agent, such as [agent.NAME]"]),
        (
            "[fleet]\nnam = 1\n[agent.a]\nafter = 5\n[agents.b]\n",
            [
                "fleet.toml:3: [fleet] nam: unknown key, did you mean 'name'?",
                "fleet.toml:5: [agent.a] after: expected a list, got an integer",
                "fleet.toml:6: [agents]: unknown key in a fleet file, did you mean 'agent'?",
            ],
        ),
        (
            "[fleet]\n[agent.a]\nafter = ['bb']\n[agent.b]\nafter = ['b']\n",
            [
                "fleet.toml:4: [agent.a] after[0]: this fleet has no agent 'bb', did you mean 'b'?",
                "fleet.toml:6: [agent.b] after[0]: an agent cannot wait for itself",
            ],
        ),
        (
            "[fleet]\n[agent.a]\nafter = ['b']\n[agent.b]\nafter = ['a']\n[agent.c]\n",
            ["fleet.toml:4: [agent.a] after: a and b would wait for each other for ever"],
        ),
        (
            "[fleet]\nrestart = { policy = 'often', at_most = -1 }\n[agent.a]\n",
            [
                "fleet.toml:3: [fleet] restart.policy: expected one of 'no', 'on-failure', 'always', not 'often'",
                "fleet.toml:3: [fleet] restart.at_most: expected an integer >= 0, not -1",
            ],
        ),
        (
            "[fleet]\n[agent.a]\nset = { clock.sped = 1 }\n",
            ["fleet.toml:4: [clock] sped: unknown key, did you mean 'speed'?"],
        ),
        ("[fleet]\n[agent.x]\n", ["fleet.toml:3: [agent.x] config: the file {}/x.toml does not exist"]),
    ],
)
def test_faults_of_a_fleet_file(tmp_path: Path, text: str, expected: list[str]) -> None:
    write(tmp_path / "a.toml")
    write(tmp_path / "b.toml")

    assert faults(tmp_path, text) == [line.format(tmp_path) for line in expected]


def test_fleet_file_of_the_documentation(tmp_path: Path) -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "configuration.md").read_text()
    block = next(part for part in text.split("```") if part.startswith("toml") and "[fleet]" in part)
    write(tmp_path / "gateway.toml")
    write(tmp_path / "node.toml", rest='[task.Report]\ntype = "any.Report"')

    members = fleet(tmp_path, block.removeprefix("toml").replace("schema = 1", ""))

    assert [(it.name, it.after, it.restart.policy) for it in members] == [
        ("gateway", (), "on-failure"),
        ("north", ("gateway",), "on-failure"),
        ("south", ("gateway",), "always"),
    ]
    assert members[1].config.tasks["Report"].rate_hz == 2.0


def test_schema_of_a_fleet_file() -> None:
    schema = fleet_schema()

    assert set(schema["properties"]) == {"schema", "extends", "vars", "fleet", "agent"}
    assert set(schema["properties"]["agent"]["additionalProperties"]["properties"]) == {
        "config",
        "set",
        "restart",
        "after",
        "host",
    }
    assert schema["properties"]["fleet"]["additionalProperties"] is False


@pytest.fixture
def entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registration]:
    """An agent `a` of the fleet `default` that runs on this machine."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "runtime"))
    registration = Registration(RunningAgent("a", "default", "agent", ("tcp://127.0.0.1:1",), 4711))
    yield registration
    registration.remove()


def test_name_of_a_running_agent_is_refused(tmp_path: Path, entry: Registration) -> None:
    members = make_fleet([write(tmp_path / "a.toml")], (), None, None)

    with pytest.raises(PancakesError, match="the agent a of the fleet default runs already \\(process 4711\\)"):
        check_free(members)
    check_free(make_fleet([write(tmp_path / "a.toml")], ('agent.fleet="other"',), None, None)).release()


def test_used_or_claimed_port_is_refused(tmp_path: Path, entry: Registration) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        members = make_fleet([write(tmp_path / "b.toml", rest=f'listen = "{listen}"')], (), None, None)
        with pytest.raises(PancakesError, match=f"b cannot listen at {listen}: address already in use"):
            check_free(members)
        mine = Registration(RunningAgent("first", "lab", "agent", (listen,), os.getpid()))
        with pytest.raises(PancakesError, match=r"in use, by first of the fleet lab \(process \d+\)"):
            check_free(members)
        mine.remove()
    claim = check_free(members)
    with pytest.raises(PancakesError, match="another launcher is about to use the ports of this fleet"):
        check_free(members)
    claim.release()
    check_free(members).release()


def test_fault_of_one_agent_hides_no_other(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('schema = 1\n[agent\nname = "a"\n')
    write(tmp_path / "b.toml", rest="seed = 1 x\n[clock]\nspeed = 0")
    write(tmp_path / "d.toml", rest="[clock]\nspede = 1")
    text = "[fleet]\n[agent.a]\n[agent.b]\n[agent.c]\n[agent.d]\n"

    assert sorted(faults(tmp_path, text)) == [
        "a.toml:2: TOML: expected ']' at the end of a table declaration",
        "b.toml:4: [agent] seed: expected newline or end of document after a statement",
        "b.toml:6: [clock] speed: expected a number > 0, not 0",
        "d.toml:5: [clock] spede: unknown key, did you mean 'speed'?",
        f"fleet.toml:5: [agent.c] config: the file {tmp_path}/c.toml does not exist",
    ]


def test_fleet_file_is_read_past_an_invalid_value(tmp_path: Path) -> None:
    write(tmp_path / "a.toml")
    text = "[fleet]\nset = { x = }\n[agent.a]\naftr = 1\nrestart.at_most = 1s\n"

    assert faults(tmp_path, text) == [
        "fleet.toml:3: [fleet] set: invalid value",
        "fleet.toml:5: [agent.a] aftr: unknown key, did you mean 'after'?",
        "fleet.toml:6: [agent.a] restart.at_most: expected newline or end of document after a statement",
    ]


def test_variables_of_a_fleet_hold_in_its_files(tmp_path: Path) -> None:
    write(tmp_path / "a.toml", rest='peers = ["tcp://${gateway}:7401"]\n[vars]\ngateway = "10.0.0.9"')
    text = '[vars]\ngateway = "10.0.0.5"\nspeed = 2\n[fleet]\nset = { clock.speed = "${speed}" }\n[agent.a]\n'

    (member,) = fleet(tmp_path, text)

    assert (member.config.agent.peers, member.config.clock.speed) == (("tcp://10.0.0.5:7401",), 2.0)
    write(tmp_path / "a.toml", rest='role = "${gateway}"')
    (found,) = faults(tmp_path, text)
    assert found.startswith(f"a.toml:4 (gateway: {tmp_path}/fleet.toml:3): [agent] role: expected one of 'agent'")


def test_fleet_file_extends_another(tmp_path: Path) -> None:
    base = tmp_path / "base"
    base.mkdir()
    write(base / "node.toml", "x", 'peers = ["tcp://${gateway}:7401"]')
    text = 'schema = 1\n[vars]\ngateway = "10.0.0.5"\n[fleet]\nname = "field"\n[agent.a]\nconfig = "node.toml"\n'
    (base / "fleet.toml").write_text(text)

    (member,) = fleet(tmp_path, 'extends = "base/fleet.toml"\n[vars]\ngateway = "10.0.0.9"\n[fleet]\nname = "yard"\n')

    assert member.path == base / "node.toml"
    assert (member.config.agent.fleet, member.config.agent.peers) == ("yard", ("tcp://10.0.0.9:7401",))


def test_file_that_others_extend_is_no_agent_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "common.toml").write_text('schema = 1\n[agent]\nfleet = "field"\n')
    (tmp_path / "a.toml").write_text('schema = 1\nextends = "common.toml"\n[agent]\nname = "a"\n')
    (tmp_path / "b.toml").write_text('schema = 1\nextends = "a.toml"\n[agent]\nname = "b"\n')

    members = make_fleet([tmp_path], (), None, None)

    assert [(it.name, it.config.agent.fleet) for it in members] == [("a", "field"), ("b", "field")]


def test_ports_within_a_machine_are_those_of_variables(tmp_path: Path) -> None:
    write(tmp_path / "a.toml", rest='listen = "tcp://127.0.0.1:${port}"\n[vars]\nport = 7401')
    write(tmp_path / "b.toml", rest='peers = ["tcp://127.0.0.1:${port}"]\n[vars]\nport = 7401')

    members = make_fleet([tmp_path], (), None, None, local=True)

    assert [it.config.agent.peers for it in members] == [(), ("local://a",)]


def test_agent_on_another_host_gets_what_its_file_extends(tmp_path: Path) -> None:
    (tmp_path / "common.toml").write_text('schema = 1\n[agent]\nfleet = "field"\n')
    (tmp_path / "a.toml").write_text('schema = 1\nextends = "common.toml"\n[agent]\nname = "a"\n')

    (member,) = fleet(tmp_path, '[fleet]\n[agent.a]\nhost = "pi@robot1"\n')

    assert parse(host_start(member, None, False).config, "agent.toml").agent.fleet == "field"
