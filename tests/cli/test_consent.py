"""A verb that loses data asks on a terminal, and needs --yes elsewhere: one rule for all verbs."""

import os
import pty
from collections.abc import Callable

import pytest
from cli.processes import Rig
from harness.programs import Program, pancakes

SOURCE = "from pancakes.task import Task\n\nclass Count(Task):\n    pass\n"
POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\n"


def answered(rig: Rig, answer: str, *arguments: str, meanwhile: Callable[[], None] | None = None) -> tuple[int, str]:
    """Run a command on a terminal, and answer its question; return its exit code and output.

    Args:
        rig: the rig.
        answer: the answer.
        arguments: the command.
        meanwhile: what happens while the question waits for it.
    """
    ours, theirs = pty.openpty()
    with Program(
        pancakes(*arguments),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=rig.environment,
        cwd=rig.directory,
        start_new_session=True,
    ) as process:
        os.close(theirs)
        shown = b""
        while meanwhile is not None and b"Do it?" not in shown:
            shown += os.read(ours, 65_536)
        if meanwhile is not None:
            meanwhile()
        os.write(ours, f"{answer}\n".encode())
        try:
            while data := os.read(ours, 65_536):
                shown += data
        except OSError:  # the command's side is closed
            pass
        os.close(ours)
        return process.wait(), " ".join(shown.decode().split())


@pytest.mark.parametrize("verb", ["remove"])
def test_verb_that_loses_data_asks_on_a_terminal(rig: Rig, verb: str) -> None:
    rig.install("count", POINTS, SOURCE)
    rig.ready("a")
    assert rig.pancakes("task", "create", "a/Count", "--type", "count.Count").returncode == 0
    code, shown = answered(rig, "n", "task", verb, "a/Count")
    assert code == 1 and "its state is lost. Do it? [y/N]" in shown and shown.endswith("nothing was done")
    code, shown = answered(rig, "y", "task", verb, "a/Count")
    assert code == 0 and "removed" in shown


STATED = """
from dataclasses import dataclass
from pancakes.task import Task

class Count(Task):
    @dataclass
    class State:
        n: int = 0
"""


@pytest.mark.parametrize("words", ["task restart a/Count --drop-state", "service restart a/client --drop-state"])
def test_dropping_a_state_asks_first(rig: Rig, words: str) -> None:
    rig.install("count", POINTS, STATED)
    rig.ready("a", '[task.Count]\ntype = "count.Count"\n')
    refused = rig.pancakes(*words.split())
    assert refused.returncode == 1 and "state is lost. Pass --yes to do it" in refused.stderr
    assert rig.pancakes(*words.split(), "--dry-run").returncode == 0
    assert {row["incarnation"] for row in rig.listed("task", "list", "--long") if row["task"] == "Count"} == {1}
    code, shown = answered(rig, "n", *words.split())
    assert code == 1 and "state is lost. Do it? [y/N]" in shown
    code, shown = answered(rig, "y", *words.split())
    assert code == 0 and "restarted" in shown
    assert rig.pancakes(*words.split(), "--yes").returncode == 0
    assert rig.pancakes(*words.replace("--drop-state", "--keep-state").split()).returncode == 0


def test_revoke_asks_first(rig: Rig) -> None:
    rig.keys.authority("test").enrol_with_key("operator", "bob")
    words = ("keys", "revoke", "bob", "laptop stolen")
    refused = rig.pancakes(*words)
    assert refused.returncode == 1 and "for good. Pass --yes" in refused.stderr
    code, shown = answered(rig, "n", *words)
    assert code == 1 and shown.endswith("nothing was done")
    assert rig.pancakes("keys", "can", "bob", "look", "a").returncode == 0
    assert "no agent has the roster" in rig.pancakes(*words, "--yes").stderr
    assert rig.pancakes("keys", "can", "bob", "look", "a").returncode == 1


def test_down_of_several_fleets_asks_first(rig: Rig) -> None:
    agents = [rig.ready("a"), rig.ready("b"), rig.ready("c", fleet="other")]
    what = "this stops c of the fleet other; a, b of the fleet test. To choose one fleet, pass --fleet"
    refused = rig.pancakes("down")
    said = f"{what}. Pass --yes to do it, or --dry-run to check it first. Nothing was done\n"
    assert (refused.returncode, refused.stderr) == (1, said)
    code, shown = answered(rig, "n", "down")
    assert code == 1 and f"{what}. Do it? [y/N]" in shown
    assert rig.pancakes("down", "--dry-run").returncode == 0
    assert [agent.process.poll() for agent in agents] == [None, None, None]
    assert rig.pancakes("down", "--fleet", "other").returncode == 0
    ended = rig.pancakes("down")
    assert ended.returncode == 0 and ended.stderr == "stopping a, b of the fleet test\n"
    assert [agent.ended() for agent in agents] == [0, 0, 0]


def test_down_of_several_fleets_accepts_force(rig: Rig) -> None:
    agents = [rig.ready("a"), rig.ready("c", fleet="other")]
    code, shown = answered(rig, "y", "down")
    assert code == 0 and "ended" in shown and [agent.ended() for agent in agents] == [0, 0]
    agents = [rig.ready("a"), rig.ready("c", fleet="other")]
    assert rig.pancakes("down", "--yes").returncode == 0 and [agent.ended() for agent in agents] == [0, 0]
