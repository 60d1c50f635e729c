"""Completion in the shell: names come from the running agents, and errors are never printed."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from cli.invoked import invoked
from cli.processes import PATIENCE_S, Rig, Running

TASKS = """
[device.load]
driver = "host.load"
rate_hz = 1

[device.pose]
driver = "null.pose"

[channel.map]
"""


def completed(rig: Rig, *words: str, shell: str = "bash", runtime: str = "") -> list[str]:
    """Return the completions of the last word."""
    result = rig.pancakes(
        _PANCAKES_COMPLETE=f"{shell}_complete",
        # As the shells' scripts give them: bash and zsh one word a line, fish the word in question apart.
        COMP_WORDS="\n".join(["pancakes", *words]),
        COMP_CWORD=words[-1] if shell == "fish" else str(len(words)),
        PANCAKES_RUNTIME_DIR=runtime or str(rig.runtime),
    )
    assert result.stderr == ""
    lines = [line for line in result.stdout.splitlines() if line]
    if shell == "zsh":
        return lines[1::3]
    return [line.partition(",")[2].partition("\t")[0] for line in lines]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running, Running]]:
    """Two agents that no test changes."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        ant, bee = rig.ready("ant", TASKS), rig.ready("bee")
        (rig.runtime / "x.json").mkdir()  # of which a command would warn
        yield rig, ant, bee


def test_completion_of_tasks_completes_the_agent_first(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    for shell in ("bash", "zsh", "fish"):
        assert completed(rig, "task", "stop", "", shell=shell) == ["ant/", "bee/"], shell
    assert completed(rig, "task", "stop", "ant/l") == ["ant/load"]
    assert {"ant/load", "ant/pose", "ant/Discovery"} <= set(completed(rig, "task", "stop", "ant/"))
    assert completed(rig, "task", "rate", "ant/dev") == ["ant/device/load", "ant/device/pose"]
    # A shell ends the word after its only completion, and "ant/" is not the end of one.
    assert "ant/load" in completed(rig, "task", "info", "a")
    assert completed(rig, "task", "info", "c") == []


def test_completion_completes_all_kinds_of_names(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    assert completed(rig, "service", "stop", "bee/") == ["bee/log", "bee/device", "bee/network", "bee/client"]
    assert completed(rig, "agent", "info", "") == ["ant", "bee"]
    assert completed(rig, "agent", "list", "ant", "") == ["bee"]
    assert completed(rig, "channel", "echo", "ant/m") == ["ant/map"]
    assert completed(rig, "task", "rate", "ant/pose", "--timer", "") == ["read"]
    assert completed(rig, "task", "migrate", "ant/load", "--to", "b") == ["bee"]
    assert "pose" in completed(rig, "task", "migrate", "ant/load", "--then", "")
    assert completed(rig, "task", "migrate", "ant/load", "--cost", "ba") == ["battery"]
    assert completed(rig, "task", "create", "ant/New", "--type", "energy.g") == ["energy.governor"]


def test_completion_asks_agents_at_an_address_on_the_line(shared: tuple[Rig, Running, Running]):
    rig, _, bee = shared
    address = rig.address(bee)
    nobody = str(rig.directory / "elsewhere")

    def there(*words: str) -> list[str]:
        return completed(rig, *words, runtime=nobody)

    assert there("agent", "info", "") == []
    assert there("service", "stop", "--fleet", "test", "--at", address, "bee/n") == ["bee/network"]
    # Bash breaks words at colons and equal signs, and the words it hands over with them.
    broken = [piece for part in address.split(":") for piece in (part, ":")][:-1]
    assert there("agent", "info", "--fleet", "test", "--at", *broken, "") == ["bee"]
    assert there("agent", "info", "--fleet", "test", "--at", "=", *broken, "") == ["bee"]
    assert there("agent", "info", "--format", "=", "js") == ["json"]


def test_completion_without_agents_has_verbs_and_no_error(rig: Rig):
    assert completed(rig, "ta") == ["task"]
    assert completed(rig, "task", "st") == ["start", "stop"]
    assert "--dry-run" in completed(rig, "task", "stop", "--")
    assert completed(rig, "task", "stop", "") == []
    rig.runtime.write_text("no directory")
    assert completed(rig, "task", "stop", "") == []
    assert completed(rig, "task", "stop", "--at", "nowhere", "") == []


def test_completion_tells_equal_names_apart(rig: Rig):
    """Two fleets have an agent of one name, and one agent has a task twice."""
    rig.install(
        "twice",
        "[pancakes.services]\ntwice.Twice = plugin_twice:Twice\n",
        "from pancakes.service import Service\n"
        "from pancakes.task import Task, TaskSpec\n\n"
        "class Twice(Service):\n"
        "    def own_tasks(self):\n"
        "        return [TaskSpec('load', Task)]\n",
    )
    rig.ready("ant", TASKS + '[service.more]\ntype = "twice.Twice"\n', fleet="north")
    rig.ready("ant", fleet="south")
    assert completed(rig, "agent", "info", "north/") == ["north/ant"]
    assert completed(rig, "task", "stop", "north/ant/p") == ["north/ant/pose"]
    assert completed(rig, "task", "stop", "south/ant/pos") == []
    assert completed(rig, "channel", "info", "--fleet", "north", "ant/m") == ["ant/map"]

    north = ("task", "stop", "--fleet", "north")
    assert completed(rig, *north, "ant/load") == []
    assert completed(rig, *north, "ant/more/") == ["ant/more/load"]
    assert {"ant/device/load", "ant/more/load"} <= set(completed(rig, *north, "ant/"))


def test_completion_does_not_wait_for_a_silent_agent(rig: Rig, freeze: Callable[[Running], None]):
    ant, _ = rig.ready("ant", TASKS), rig.ready("bee")
    freeze(ant)
    assert "bee/Discovery" in completed(rig, "task", "stop", "")
    assert completed(rig, "task", "stop", "ant/") == []


# The script -------------------------------------------------------------------------------------------------------


def test_completion_has_a_script_for_each_shell():
    help_ = invoked("completion", "--help").stdout
    for shell in ("bash", "zsh", "fish"):
        script = invoked("completion", shell)
        assert (script.exit_code, script.stderr) == (0, "")
        assert f"_PANCAKES_COMPLETE={shell}_complete" in script.stdout
        assert f"pancakes completion {shell}" in help_


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_completion_script_completes_in_bash(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    command = rig.directory / "bin" / "pancakes"
    command.parent.mkdir(exist_ok=True)
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m pancakes.tools.cli.main "$@"\n')
    command.chmod(0o755)
    asked = (("task", "stop", "ant/device/"), ("service", "stop", "--for", "3s", "bee/d"), ("agen",))
    script = 'eval "$(pancakes completion bash)"\n'
    for words in asked:
        listed = " ".join(f"'{word}'" for word in ("pancakes", *words))
        script += f"COMPREPLY=() COMP_WORDS=({listed}) COMP_CWORD={len(words)}\n_pancakes_completion pancakes\n"
        script += 'echo "${COMPREPLY[@]}"\n'
    result = subprocess.run(
        ["bash", "--norc", "-c", script],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env={**rig.environment, "PATH": f"{command.parent}:{rig.environment['PATH']}"},
        cwd=rig.directory,
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines() == ["ant/device/load ant/device/pose", "bee/device", "agent"]
