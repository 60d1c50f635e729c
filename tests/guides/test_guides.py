"""The examples of all guides: configurations are sound, commands are ones that exist, and Python runs.

`test_guides_live.py` runs the commands that need agents, and `WHERE` tells of each other block where it is run, or why
it is not.
"""

from __future__ import annotations

import importlib
import re
import shlex
import textwrap
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import pytest
from harness.guide import ROOT, Example, example, examples, guides
from pancakes_ros2.goal_packets import Call, CallAnswer, GoalStatus
from pancakes_ros2.ros_action import RosAction

from pancakes.config import parse
from pancakes.config.checks import check_plugins
from pancakes.config.toml_reader import self_contained
from pancakes.control import Describe, Migrate
from pancakes.devices import Battery, Pose, Twist
from pancakes.devices.driver import Actuator, Sensor
from pancakes.packet import Packet
from pancakes.simulation.fleet import registered
from pancakes.task import Task, Tick, every, on
from pancakes.testing import Fleet
from pancakes.tools.cli.agent_command import agent as pancakes_agent
from pancakes.tools.cli.main import pancakes
from pancakes.tools.launch.fleet_file import load_fleet
from pancakes.util.plugins import Plugins

ALL = [it for guide in guides() for it in examples(guide)]
TOML = [it for it in ALL if it.language == "toml"]
COMMANDS = [it for it in ALL if it.commands]

RUN_WHOLE = {
    "README.md": ".ci/run",
    "docs/cheat-sheet.md": "guides.test_reference_pages_live",
    "docs/client.md": ".ci/run",
    "docs/demos.md": ".ci/run",
    "docs/ros2-users.md": "guides.test_reference_pages_live",
    "docs/tutorial.md": ".ci/run",
    "plugins/pancakes-mqtt/README.md": "tests/mqtt",
    "plugins/pancakes-pi/README.md": "tests/pi",
    "docs/testing.md": "tests/testing/test_testing_guide.py",
    "docs/writing-a-driver.md": "tests/testing/test_testing_guide.py",
    "docs/writing-a-task.md": "tests/testing/test_testing_guide.py",
}
"""Guides of which all blocks `sh` and `python` are run, and by what."""

LIVE = "guides.test_guides_live"
HERE = "guides.test_guides"
WHERE: dict[tuple[str, str], str] = {
    ("docs/behaviour-trees.md", "import py_trees"): f"{HERE}.test_tree_of_the_guide_goes_on_where_it_was",
    ("docs/allocation.md", "pancakes what-if"): "not run: tests/what_if/test_what_if_allocate.py asks two agents",
    ("docs/drive.md", "pancakes drive"): "not run: tests/cli/test_drive_verb.py drives in a terminal of its own",
    ("docs/configuration.md", "pancakes-agent --config"): f"{LIVE}.test_configuration_files_are_checked",
    ("docs/configuration.md", "pancakes task create"): f"{LIVE}.test_configuration_of_created_tasks_is_kept",
    ("docs/configuration.md", "pancakes up"): f"{LIVE}.test_configuration_of_fleets_is_launched",
    ("docs/deployment.md", "pancakes up"): "not run: needs hosts behind ssh; tests/cli/test_launch_on_hosts*.py",
    ("docs/deployment.md", "pancakes deploy"): "not run: needs hosts behind ssh; tests/deploy",
    ("docs/demos.md", "pancakes demo"): "not run: on a terminal, and in a browser; tests/demo and tests/web",
    ("docs/discovery.md", "pip install"): "not run: the environment has it",
    ("docs/discovery.md", "pancakes"): "not run: needs two machines; tests/net/test_dns_sd_live.py",
    ("docs/discovery.md", "from pancakes import Client"): "not run: tests/examples has the whole program",
    ("docs/endless.md", "pip install"): "not run: takes minutes; tests/robotarium/test_endless_*.py run pieces of it",
    ("docs/endless.md", "pancakes demo endless --seeds"): "not run: takes hours; tests/robotarium has twenty minutes",
    ("docs/energy.md", "pancakes demo energy"): "not run: takes minutes; tests/demo/test_energy_demo.py has it",
    ("docs/filters.md", "pancakes param set"): "not run: tests/filters changes settings while wheels run",
    ("docs/filters.md", "from dataclasses"): f"{HERE}.test_filter_of_the_guide_holds",
    ("docs/filters.md", "from pancakes import NEIGHBOURS"): "not run: part of a task; tests/filters hears such packets",
    ("docs/halt.md", "pancakes halt"): "not run: it asks a person; tests/cli/test_halt_verb.py",
    ("docs/halt.md", "from pancakes import SYSCTRL"): "not run: part of a task; tests/services/test_halt.py",
    ("docs/page.md", "pancakes demo"): "not run: a page in a browser, until Ctrl-C; tests/web",
    ("docs/page.md", "pancakes view --host"): "not run: until Ctrl-C; tests/web/test_exposed_page.py",
    ("docs/page.md", "pancakes task info"): "not run: in the demo's 67th second; tests/cli/test_task_state*.py",
    ("docs/traces.md", "pip install"): "not run: the environment has it",
    ("docs/trials.md", "scripts/torture"): "not run: takes minutes to hours",
    ("docs/recordings.md", "pancakes demo"): f"{LIVE}.test_recordings_are_made",
    ("docs/recordings.md", "pancakes view"): "not run: serves Foxglove until Ctrl-C; tests/cli/test_foxglove*.py",
    ("docs/recordings.md", "pancakes record start --task"): f"{LIVE}.test_recordings_are_made",
    ("docs/recordings.md", "pancakes record repair"): f"{LIVE}.test_recordings_are_used",
    (
        "docs/recordings.md",
        "pancakes replay recordings --dry-run",
    ): f"{LIVE}.test_recordings_are_used",
    (
        "docs/recordings.md",
        "pancakes replay recordings --config",
    ): f"{LIVE}.test_recordings_are_used",
    ("docs/recordings.md", "pancakes rerun runs/encirclement-1-virtual/recording ScanTarget\n"): (
        f"{LIVE}.test_recordings_are_used"
    ),
    ("docs/recordings.md", "pancakes rerun runs/encirclement-1-virtual/recording ScanTarget --stay"): (
        f"{LIVE}.test_recordings_are_used"
    ),
    ("docs/recordings.md", "pancakes report"): f"{LIVE}.test_recordings_are_used",
    (
        "docs/recordings.md",
        "pancakes why runs/live/recording\n",
    ): f"{LIVE}.test_recordings_are_used",
    (
        "docs/recordings.md",
        "pancakes why runs/live/recording --agent",
    ): f"{LIVE}.test_recordings_are_used",
    ("docs/recordings.md", "from pathlib import Path"): f"{LIVE}.test_recordings_are_used",
    ("docs/refusals.md", "try:"): "not run: part of a program; tests/client has what it raises",
    ("docs/releases.md", "pip download"): "not run: needs another machine; scripts/release tries an index of its own",
    ("docs/releases.md", "scripts/release"): "not run: .ci/run runs it with other arguments",
    ("docs/releases.md", "pancakes --version"): f"{LIVE}.test_releases_say_their_version",
    ("docs/releases.md", "python3 -m venv"): "not run: installs wheels into /opt; tests/demo tries the wheels",
    ("docs/robotarium.md", "pip install"): "not run: the environment has it; tests/robotarium runs the demo",
    ("docs/robotarium.md", "from pancakes"): "robotarium.test_robotarium_guide.test_script_prints_what_it_must",
    ("docs/ros2.md", "source /opt/ros"): "not run: needs ROS 2; tests/ros2",
    ("docs/ros2.md", "ros2 param"): "not run: needs ROS 2; tests/ros2",
    ("docs/ros2.md", "pip install -e"): "not run: needs ROS 2; tests/ros2",
    ("docs/ros2.md", "pancakes rosbag export"): "not run: tests/ros2/test_bags.py has these commands",
    ("docs/ros2.md", "pancakes rosbag import"): "not run: tests/ros2/test_bags.py has these commands",
    ("docs/ros2.md", "pancakes demo ros2"): "not run: needs ROS 2; tests/ros2",
    ("docs/ros2-goals.md", "from dataclasses"): f"{HERE}.test_tasks_with_goals_and_calls",
    ("docs/ros2-goals.md", "from pancakes.packet"): f"{HERE}.test_tasks_with_goals_and_calls",
    ("docs/ros2-goals.md", "from pancakes import CTRL"): f"{HERE}.test_tasks_with_goals_and_calls",
    ("docs/security.md", "pancakes keys init"): "not run: needs three machines; tests/cli/test_first_hour*.py",
    ("docs/security.md", "pancakes keys join"): "not run: needs three machines; tests/cli/test_first_hour*.py",
    ("docs/security.md", "pancakes agent list"): f"{LIVE}.test_security_of_two_robots",
    ("docs/security.md", "pancakes keys enrol agent3"): f"{LIVE}.test_security_of_two_robots",
    ("docs/security.md", "pancakes task stop"): f"{LIVE}.test_security_of_two_robots",
    ("docs/security.md", "pancakes keys revoke"): f"{LIVE}.test_security_of_two_robots",
    ("docs/runbook.md", "pancakes"): "not run: what an operator does after a fault; tests/cli and tests/services",
    ("docs/simulation.md", "from pancakes import Simulation"): f"{HERE}.test_simulation_prints_what_its_guide_says",
    ("docs/simulation.md", "import gymnasium"): f"{HERE}.test_simulation_makes_a_learning_environment",
    ("docs/simulation.md", "pancakes demo"): "not run: 200 missions; .ci/run has eight of demos.md",
    ("docs/system-service.md", "sudo useradd"): "not run: changes this machine; tests/systemd_vm",
    ("docs/testing.md", "pytest"): "not run: tests/testing/test_pytest_plugin.py has the options",
    ("docs/time.md", '@on("system", Pose)'): f"{HERE}.test_time_of_a_packet_elsewhere",
    ("docs/time.md", "pancakes doctor"): "not run: needs a robot whose clock is a year behind; tests/cli",
    ("docs/tutorial.md", ""): "not run: .ci/run has made the environment already",
    ("docs/upgrading.md", "pip install"): "not run: another version is not there; tests/deploy and tests/kept",
    ("docs/upgrading.md", "pancakes deploy"): "not run: needs hosts behind ssh; tests/deploy",
    ("docs/what-if.md", "pancakes what-if"): f"{LIVE}.test_what_if_is_asked",
    ("docs/writing-a-driver.md", ""): "not run: installs the guide's package; tests/testing runs its files",
    ("docs/writing-a-task.md", ""): "not run: installs the guide's package; tests/testing runs its files",
    ("docs/zenoh.md", "pip install"): f"{LIVE}.test_zenoh_joins_two_agents",
    ("docs/zenoh.md", "pancakes task migrate"): "not run: needs two networks; tests/zenoh_links/test_zenoh_agents.py",
    ("plugins/pancakes-mqtt/README.md", "pip install"): "not run: the environment has it",
    ("plugins/pancakes-mqtt/README.md", "pancakes channel echo"): "not run: until Ctrl-C; tests/mqtt",
    ("plugins/pancakes-pi/README.md", "pip install"): "not run: the environment has it",
    ("plugins/pancakes-pi/README.md", "pancakes task info"): "not run: tests/pi has what it says",
    ("plugins/pancakes-robotarium/README.md", "pip install"): "not run: the environment has it; tests/robotarium",
    ("plugins/pancakes-sensor-field/README.md", "pip install"): "not run: .ci/run has it, in README.md",
    ("plugins/pancakes-sensor-field/README.md", "pancakes up"): "not run: tests/sensor_field has it",
    ("plugins/pancakes-sensor-field/README.md", "python -m"): "not run: tests/sensor_field has it",
    ("plugins/pancakes-sensor-field/README.md", "pancakes-agent"): "not run: tests/sensor_field has it",
    ("plugins/pancakes-zenoh/README.md", "pip install"): f"{LIVE}.test_zenoh_joins_two_agents",
}
"""By guide and by how a block begins: the test that runs it, or why none does."""


def entry_of(block: Example) -> str:
    """Returns what `WHERE` says of a block: its longest entry that fits."""
    first = (block.commands or [block.text])[0] + "\n"
    fitting = [key for key in WHERE if key[0] == block.guide and first.startswith(key[1])]
    return WHERE[max(fitting, key=lambda key: len(key[1]))] if fitting else ""


def is_run_whole(block: Example) -> bool:
    """Returns whether a block is run with its guide; those of how-to pages are examples, which tests/examples runs."""
    return (block.guide in RUN_WHOLE or block.guide.startswith("docs/how-to/")) and block.language in ("sh", "python")


def test_guides_have_no_block_that_is_forgotten():
    """A new block is run by a test, or has a reason in `WHERE`; what is said of a block that has gone goes too."""
    told = [it for it in ALL if (it.commands or it.language == "python") and not is_run_whole(it)]
    assert [str(it) for it in told if not entry_of(it)] == []
    used = {entry for it in told if (entry := entry_of(it))}
    assert [key for key, entry in WHERE.items() if entry not in used] == []


def test_guides_are_run_by_tests_that_exist():
    for entry in WHERE.values():
        if not entry.startswith("not run: "):
            module, _, name = entry.rpartition(".")
            assert hasattr(importlib.import_module(module), name), entry


# Configurations --------------------------------------------------------------------------------------------------


@dataclass
class Said:
    """Settings of the classes that guides make up."""

    colour: str = ""
    path: str = ""
    full: float = 0.0
    busy_above: float = 0.0


class Invented(Task):
    Settings = Said


class InventedSensor(Sensor):
    type = "light"
    rate = "optional"

    class Settings(Said): ...

    def read(self) -> Any:
        return None


class InventedActuator(Actuator):
    type = "lamp"

    class Settings(Said): ...

    def write(self, command: Any, ttl_s: float, source: str) -> None: ...

    def safe_stop(self) -> None: ...


INVENTED: dict[str, type] = {
    "blink.Blink": Invented,
    "gps.serial": InventedSensor,
    "loadwatch.LoadWatch": Invented,
    "nightlight.NightLight": Invented,
    "patrol.Visit": Invented,
    "sysfs.lamp": InventedActuator,
    "sysfs.light": InventedSensor,
    "watch.Watch": Invented,
}
"""What stands for tasks and drivers of the reader's own; the guides' own classes are run elsewhere."""

BODY = """
[device.pose_of_body]
driver = "null.pose"
[device.motors_of_body]
driver = "null.motors"
[device.battery_of_body]
driver = "null.battery"
"""
"""What the tasks of a fragment may need."""


@pytest.mark.parametrize("block", [it for it in TOML if "[project]" not in it.text], ids=str)
def test_guides_have_sound_configurations(block: Example, tmp_path: Path):
    """A whole file (with `schema`) as it stands; a fragment with an agent and a body around it."""
    values = tomllib.loads(block.text)
    if "fleet" in values:
        path = tmp_path / "fleet.toml"
        path.write_text(block.text)
        assert load_fleet(str(path)).agents
        return
    text = block.text
    if "schema" not in values:
        text = merged(block, values)
    if name := named_file(block):
        for other in (it for it in TOML if it.guide == block.guide and named_file(it)):
            (tmp_path / named_file(other)).write_text(other.text)
        if "name" not in values["agent"]:
            return  # it is checked with the file that extends it
        text = self_contained(str(tmp_path / name))
    assert [str(fault) for fault in check_plugins(parse(text, block.guide), registered(INVENTED))] == []


def named_file(block: Example) -> str:
    """Returns the name of the file that a block begins with, as in `# robot1.toml`; empty: none."""
    found = re.match(r"# (\w+\.toml)\n", block.text)
    return found[1] if found else ""


def merged(block: Example, values: dict[str, Any]) -> str:
    """Returns a fragment as a file; the type of a task may have been said earlier in its guide."""
    text = block.text + BODY
    if "agent" not in values:
        text += '[agent]\nname = "a"\n'
    elif "name" not in values["agent"]:
        text = text.replace("[agent]\n", '[agent]\nname = "a"\n')
    for name, task in values.get("task", {}).items():
        if "type" not in task:
            earlier = [it.text for it in TOML if it.guide == block.guide and it.line < block.line]
            (kind,) = {match[1] for it in earlier if (match := re.search(rf'\[task\.{name}\]\ntype = "(.*)"', it))}
            text += f'[task.{name}]\ntype = "{kind}"\n'
    return "schema = 1\n" + text


@pytest.mark.parametrize("block", [it for it in TOML if "[project]" in it.text], ids=str)
def test_guides_have_sound_distributions(block: Example):
    groups = tomllib.loads(block.text)["project"]["entry-points"]
    known = {"pancakes.tasks", "pancakes.drivers", "pancakes.filters", "pancakes.packets", "pancakes.services"}
    assert groups and set(groups) <= known


# Commands --------------------------------------------------------------------------------------------------------

BEFORE = {"sudo", "timeout", "--preserve-status"}
"""What may stand before a program of ours."""
BAD_ON_PURPOSE = ("pancakes task rate desk/load fast || true",)
OURS = {"pancakes": pancakes, "pancakes-agent": pancakes_agent}


def ours(command: str) -> Iterator[tuple[str, list[str]]]:
    """Returns the programs of ours that a line of a shell runs, each with its arguments."""
    lexer = shlex.shlex(command, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    part: list[str] = []
    for word in [*lexer, ";"]:
        if re.fullmatch(r"[|&;<>()]+", word):
            while part and (part[0] in BEFORE or "=" in part[0] or part[0].isdigit()):
                part.pop(0)
            if part and Path(part[0]).name in OURS:
                yield Path(part[0]).name, part[1:]
            part = []
        else:
            part.append(word)


@pytest.mark.parametrize("block", COMMANDS, ids=str)
def test_guides_name_commands_that_exist(block: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With their options and arguments, as far as the command line looks at them before it does anything."""
    monkeypatch.chdir(ROOT)
    for command in block.commands:
        for program, arguments in ours(command):
            if "..." not in arguments and command not in BAD_ON_PURPOSE:
                parsed(OURS[program], program, arguments)


def parsed(command: click.Command, name: str, arguments: list[str]) -> None:
    """Reads a command line.

    Raises:
        click.UsageError: there is no such verb or option, or a value does not fit.
    """
    context: click.Context | None = None
    while isinstance(command, click.Group):
        context = click.Context(command, parent=context, info_name=name)
        if arguments and arguments[0].startswith("--"):
            assert arguments[0] in {option for it in command.params for option in it.opts}, arguments
            return
        name, arguments = arguments[0], arguments[1:]
        found = command.get_command(context, name)
        assert found is not None, f"there is no verb {name}"
        command = found
    if "--help" not in arguments:
        command.make_context(name, list(arguments), parent=context)


SPAN = re.compile(r"`(pancakes(?:-agent)? [^`]+)`")


@pytest.mark.parametrize("guide", guides())
def test_guides_mention_verbs_and_options_that_exist(guide: str):
    """In the text, where a command may be cut short or have AGENT in the place of a name."""
    text = re.sub(r"^```.*?^```", "", (ROOT / guide).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for span in SPAN.findall(text):
        program, _, rest = " ".join(span.split()).partition(" ")
        command: click.Command = OURS[program]
        words = rest.replace("'", "").replace('"', "").split()
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            found = command.get_command(click.Context(command), words[0])
            assert found is not None or words[0] in ("...", "new"), span
            if found is None:
                break
            command, words = found, words[1:]
        known = {name for it in command.params for name in (*it.opts, *it.secondary_opts)}
        options = {word.partition("=")[0].rstrip(",") for word in words if word.startswith("--")} - {"--help"}
        assert options <= known, span


# Python ----------------------------------------------------------------------------------------------------------


def test_simulation_prints_what_its_guide_says(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: Any):
    monkeypatch.chdir(tmp_path)
    code = example("docs/simulation.md", "from pancakes import Simulation")
    blocks = examples("docs/simulation.md")
    exec(compile(code.text, str(code), "exec"), {})
    assert capsys.readouterr().out == blocks[blocks.index(code) + 1].text


def test_simulation_makes_a_learning_environment():
    pytest.importorskip("gymnasium")
    code = example("docs/simulation.md", "import gymnasium")
    names: dict[str, Any] = {}
    exec(compile(code.text, str(code), "exec"), names)
    assert names["seen"].shape == (11,) and not names["cut_off"]
    names["environment"].close()


def test_time_of_a_packet_elsewhere():
    """The handler of the guide, in a task of its own: poses of this agent are on its track at their times."""
    code = example("docs/time.md", "@on")
    names: dict[str, Any] = {"on": on, "Pose": Pose, "Packet": Packet, "Task": Task, "found": []}
    text = "class Track(Task):\n    class track:\n        add = staticmethod(lambda *pair: found.append(pair))\n"
    exec(compile(text + textwrap.indent(code.text, "    "), str(code), "exec"), names)
    with Fleet(classes={"test.Track": names["Track"]}) as fleet:
        agent = fleet.start("a", tasks={"Track": names["Track"]})
        fleet.run_for(1.0)
        agent.publish("system", Pose(1.0, 2.0, 0.0))
        fleet.run_for(0.5)
    ((time_s, pose),) = names["found"]
    assert time_s == pytest.approx(1.0, abs=0.1) and pose == Pose(1.0, 2.0, 0.0)


def test_plugins_of_guides_are_not_installed():
    """Else `INVENTED` would hide them."""
    plugins = Plugins()
    known = {name for group in ("pancakes.tasks", "pancakes.drivers") for name in plugins.names(group)}
    assert not known & set(INVENTED)


class Drive(Task):
    """Drives a little, all the time."""

    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick: Tick) -> None:
        self.publish("ctrl", Twist(0.1, 0.0))


def test_filter_of_the_guide_holds():
    """Its battery is empty; later it is charged."""
    code = example("docs/filters.md", "from dataclasses")
    names: dict[str, Any] = {}
    exec(compile(code.text, str(code), "exec"), names)
    with Fleet(seed=1) as fleet:
        reserve = {"type": names["Reserve"], "device": "motors", "settings": {"least": 0.2}}
        agent = fleet.start(
            "a", devices={"motors": "null.motors"}, filters={"reserve": reserve}, tasks={"Drive": Drive}
        )
        for level, doing in ((0.5, "passes"), (0.1, "holds"), (0.5, "passes")):
            agent.publish("system", Battery(8.0, level))
            fleet.run_for(3.0)
            (found,) = agent.ask(Describe("motors")).result["filters"]
            assert found["doing"] == doing


def test_tree_of_the_guide_goes_on_where_it_was():
    """It looks around on the second robot, and rests once its battery is low."""
    code = example("docs/behaviour-trees.md", "import py_trees")
    names: dict[str, Any] = {}
    exec(compile(code.text, str(code), "exec"), names)
    devices = {"motors": "null.motors", "battery": "null.battery"}
    with Fleet(seed=1) as fleet:
        a = fleet.start("a", devices=devices, tasks={"Patrol": names["Patrol"]})
        b = fleet.start("b", devices=devices, classes={"Patrol": names["Patrol"]})
        fleet.connect()
        fleet.run_to(4.05)
        assert a.ask(Migrate("Patrol", to="b")).ok
        fleet.run_to(6.0)
        assert b.task("Patrol").tree.tip().name == "Look"
        b.publish("system", Battery(8.0, 0.1))
        fleet.run_for(0.3)
        assert b.task("Patrol").tree.tip().name == "Stop"


def test_tasks_with_goals_and_calls():
    """Each server succeeds at once; the devices stand for those of a robot."""

    class Robot(Actuator):
        def write(self, command: Any, ttl_s: float, source: str) -> None:
            number = command.number
            if number not in done:
                done.append(number)
                answer = (
                    CallAnswer(self.context.device, source, number, {"success": True})
                    if isinstance(command, Call)
                    else GoalStatus(self.context.device, source, number, "succeeded")
                )
                self.context.send("system", answer, "")

        def safe_stop(self) -> None:
            pass

    names: dict[str, Any] = {}
    for begin in ("from dataclasses", "from pancakes.packet", "from pancakes import CTRL"):
        code = example("docs/ros2-goals.md", begin)
        exec(compile(code.text, str(code), "exec"), names)
    ended = {"Visit": [1, 2, 3], "Wave": [], "Clear": [1]}
    for task, type_name in {"Visit": "ros2.goal", "Wave": "arm.goal", "Clear": "ros2.call"}.items():
        done: list[int] = []
        with Fleet(seed=1) as fleet:
            robot = fleet.start(
                "a", devices={"d": type("Device", (Robot,), {"type": type_name})}, tasks={task: names[task]}
            )
            fleet.run_for(2.0)
            assert done == ended[task]
            if task == "Wave":
                robot.task("Wave").send_goal({})
                fleet.run_for(0.1)
                assert done == [1]
            if task == "Clear":
                assert any("{'success': True}" in line for line in robot.lines("info"))
            if task == "Visit":
                assert robot.task("Visit").state.visited == 3
    assert issubclass(names["ArmAction"], RosAction)
