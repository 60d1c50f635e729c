"""Completion in the shell: the names come from the agents that run, at that moment, and never an error."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from cli.processes import PATIENCE_S, Rig, Running

TASKS = """
[device.load]
driver = "host.load"

[device.pose]
driver = "null.pose"

[channel.map]
"""


def completed(rig: Rig, *words: str, shell: str = "bash") -> list[str]:
    """What a shell is told that may stand in place of the last word."""
    rig.environment |= {
        "_PANCAKES_COMPLETE": f"{shell}_complete",
        # As the shells' scripts give them: bash and zsh one word a line, fish the word in question apart.
        "COMP_WORDS": "\n".join(["pancakes", *words]),
        "COMP_CWORD": words[-1] if shell == "fish" else str(len(words)),
    }
    result = rig.pancakes()
    for name in ("_PANCAKES_COMPLETE", "COMP_WORDS", "COMP_CWORD"):
        del rig.environment[name]
    assert result.stderr == ""
    lines = [line for line in result.stdout.splitlines() if line]
    if shell == "zsh":
        return lines[1::3]
    return [line.partition(",")[2].partition("\t")[0] for line in lines]


@pytest.fixture
def pair(rig: Rig) -> tuple[Running, Running]:
    return rig.ready("ant", TASKS), rig.ready("bee")


def test_a_warning_does_not_come_between_the_words(rig: Rig, pair: tuple[Running, Running]):
    (rig.runtime / "x.json").mkdir()

    assert completed(rig, "task", "stop", "") == ["ant/", "bee/"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_task_is_completed_agent_first(rig: Rig, pair: tuple[Running, Running], shell: str):
    assert completed(rig, "task", "stop", "", shell=shell) == ["ant/", "bee/"]
    assert completed(rig, "task", "stop", "ant/l", shell=shell) == ["ant/load"]
    assert {"ant/load", "ant/pose", "ant/Discovery"} <= set(completed(rig, "task", "stop", "ant/", shell=shell))


def test_where_there_is_one_agent_its_tasks_follow_at_once(rig: Rig, pair: tuple[Running, Running]):
    # A shell ends the word after its only completion, and "ant/" is not the end of one.
    assert "ant/load" in completed(rig, "task", "info", "a")
    assert completed(rig, "task", "info", "c") == []


def test_a_task_is_completed_by_its_service_too(rig: Rig, pair: tuple[Running, Running]):
    assert completed(rig, "task", "rate", "ant/device/") == ["ant/device/load", "ant/device/pose"]
    assert completed(rig, "task", "rate", "ant/dev") == ["ant/device/load", "ant/device/pose"]


def test_names_are_completed_behind_their_fleet(rig: Rig):
    rig.ready("ant", TASKS, fleet="north")
    rig.ready("ant", fleet="south")

    assert completed(rig, "agent", "info", "north/") == ["north/ant"]
    assert completed(rig, "task", "stop", "north/ant/l") == ["north/ant/load"]
    assert completed(rig, "task", "stop", "south/ant/loa") == []
    assert completed(rig, "channel", "info", "--fleet", "north", "ant/m") == ["ant/map"]


def test_a_task_that_is_in_two_services_is_completed_with_each(rig: Rig):
    rig.install(
        "twice",
        "[pancakes.services]\ntwice.Twice = plugin_twice:Twice\n",
        "from pancakes.service import Service\n"
        "from pancakes.task import Task, TaskSpec\n\n"
        "class Twice(Service):\n"
        "    def own_tasks(self):\n"
        "        return [TaskSpec('load', Task)]\n",
    )
    rig.ready("ant", '[device.load]\ndriver = "host.load"\n\n[service.more]\ntype = "twice.Twice"\n')

    assert completed(rig, "task", "stop", "ant/") != []
    assert completed(rig, "task", "stop", "ant/load") == []
    assert completed(rig, "task", "stop", "ant/more/") == ["ant/more/load"]
    assert {"ant/device/load", "ant/more/load"} <= set(completed(rig, "task", "stop", "ant/"))


def test_services_and_agents_are_completed(rig: Rig, pair: tuple[Running, Running]):
    assert completed(rig, "service", "stop", "bee/") == ["bee/log", "bee/device", "bee/network", "bee/client"]
    assert completed(rig, "service", "stop", "bee/cl") == ["bee/client"]
    assert completed(rig, "agent", "info", "") == ["ant", "bee"]
    assert completed(rig, "agent", "list", "ant", "") == ["bee"]
    assert completed(rig, "task", "migrate", "ant/load", "--to", "b") == ["bee"]


def test_channels_are_completed(rig: Rig, pair: tuple[Running, Running]):
    from click import Argument, Command, Context

    from pancakes.tools.cli.name_types import CHANNEL_NAME

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PANCAKES_RUNTIME_DIR", str(rig.runtime))
        items = CHANNEL_NAME.shell_complete(Context(Command("echo")), Argument(["name"]), "ant/m")
    assert [item.value for item in items] == ["ant/map"]


def test_what_belongs_to_a_task_on_the_line_is_completed(rig: Rig, pair: tuple[Running, Running]):
    assert completed(rig, "task", "rate", "ant/pose", "--timer", "") == ["sample"]
    assert "pose" in completed(rig, "task", "migrate", "ant/load", "--then", "")
    assert completed(rig, "task", "migrate", "ant/load", "--cost", "ba") == ["battery"]
    assert completed(rig, "task", "create", "ant/New", "--type", "energy.g") == ["energy.governor"]


def test_verbs_and_options_are_completed_without_any_agent(rig: Rig):
    assert completed(rig, "ta") == ["task"]
    assert completed(rig, "task", "st") == ["start", "stop"]
    assert "--dry-run" in completed(rig, "task", "stop", "--")
    assert completed(rig, "task", "list", "--format", "j") == ["json"]
    assert completed(rig, "task", "stop", "") == []


def test_agents_at_an_address_on_the_line_are_asked(rig: Rig, pair: tuple[Running, Running]):
    address = rig.address(pair[1])
    rig.environment["PANCAKES_RUNTIME_DIR"] = str(rig.directory / "elsewhere")

    there = ("--fleet", "test", "--at", address)
    assert completed(rig, "agent", "info", "") == []
    assert completed(rig, "agent", "info", *there, "") == ["bee"]
    assert completed(rig, "service", "stop", *there, "bee/n") == ["bee/network"]
    # Bash breaks words at colons and equal signs, and the words it hands over with them.
    broken = [piece for part in address.split(":") for piece in (part, ":")][:-1]
    assert completed(rig, "agent", "info", *there[:2], "--at", *broken, "") == ["bee"]
    assert completed(rig, "agent", "info", *there[:2], "--at", "=", *broken, "") == ["bee"]
    assert completed(rig, "agent", "info", "--format", "=", "js") == ["json"]


def test_who_is_silent_is_not_waited_for_and_not_named(
    rig: Rig, pair: tuple[Running, Running], freeze: Callable[[Running], None]
):
    freeze(pair[0])
    assert "bee/Discovery" in completed(rig, "task", "stop", "")
    assert completed(rig, "task", "stop", "ant/") == []


def test_nothing_that_fails_comes_between_a_person_and_the_line(rig: Rig):
    rig.runtime.write_text("no directory")
    assert completed(rig, "task", "stop", "") == []
    assert completed(rig, "task", "stop", "--at", "nowhere", "") == []


# The script -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_has_its_script(rig: Rig, shell: str):
    script = rig.pancakes("completion", shell)
    assert (script.returncode, script.stderr) == (0, "")
    assert f"_PANCAKES_COMPLETE={shell}_complete" in script.stdout
    help_ = rig.pancakes("completion", "--help").stdout
    assert f"pancakes completion {shell}" in help_


def test_another_shell_has_none(rig: Rig):
    assert rig.pancakes("completion", "tcsh").returncode == 2


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_with_it(rig: Rig, pair: tuple[Running, Running]):
    commands = rig.directory / "bin"
    commands.mkdir()
    command = commands / "pancakes"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m pancakes.tools.cli.main "$@"\n')
    command.chmod(0o755)
    environment = {**rig.environment, "PATH": f"{commands}:{rig.environment['PATH']}"}

    def bash(*words: str) -> list[str]:
        listed = " ".join(f"'{word}'" for word in ("pancakes", *words))
        result = subprocess.run(
            [
                "bash",
                "--norc",
                "-c",
                f'eval "$(pancakes completion bash)"\n'
                f"COMP_WORDS=({listed}) COMP_CWORD={len(words)}\n_pancakes_completion pancakes\n"
                'printf "%s\\n" "${COMPREPLY[@]}"',
            ],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            env=environment,
            cwd=Path(rig.directory),
        )
        assert (result.returncode, result.stderr) == (0, "")
        return result.stdout.split()

    assert bash("task", "stop", "ant/device/") == ["ant/device/load", "ant/device/pose"]
    assert bash("service", "stop", "--for", "3s", "bee/d") == ["bee/device"]
    assert bash("agen") == ["agent"]
