"""The state directory of an agent: who must own it, and what happens if it is removed."""

import resource
import shutil
import signal
from pathlib import Path

import pytest
from cli.processes import Rig, recovered, troubles

COUNT = '[task.Count]\ntype = "count.Count"\ndurability = "each"\n'
ENTRY_POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\n"
SOURCE = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1
        if self.state.n == 3:
            self.log("info", "counted")
"""


def replaced(state: Path) -> None:
    state.rename(state.with_name("old"))
    state.mkdir(mode=0o700)


def removed(directory: Path) -> None:
    while directory.exists():
        shutil.rmtree(directory, ignore_errors=True)  # the agent writes there meanwhile


GONE = {
    "removed": removed,
    "replaced": replaced,
    "given another name": lambda state: state.rename(state.with_name("old")),
    "its parent is removed": lambda state: removed(state.parent),
    "emptied": lambda state: [path.unlink(missing_ok=True) for path in state.iterdir()],
}


@pytest.fixture
def state(rig: Rig) -> Path:
    rig.install("count", ENTRY_POINTS, SOURCE)
    return rig.directory / "state" / "pancakes" / "test" / "a"


@pytest.mark.parametrize("how", GONE)
def test_agent_ends_without_its_state_directory(rig: Rig, state: Path, how: str):
    agent = rig.ready("a", COUNT)
    agent.hear("counted")

    GONE[how](state)

    agent.hear("task_stopped task=Count")
    assert agent.ended() == 1
    last = agent.said[-1]
    assert last.startswith("a cannot run: the ") and f"the state directory {state} was re" in last
    assert "while the agent ran; its tasks are ended" in last
    assert "Traceback" not in agent.everything()


def test_idle_agent_ends_without_its_state_directory(rig: Rig, state: Path):
    agent = rig.ready("a")
    removed(state)
    assert agent.ended() == 1


def test_agent_refuses_a_state_directory_that_others_can_write(rig: Rig, state: Path):
    state.mkdir(parents=True)
    state.chmod(0o702)
    agent = rig.agent(rig.config("a"))
    assert agent.ended() == 1
    (line,) = agent.everything().splitlines()
    assert line.startswith(f"the state directory {state} can be written by other users (mode 0702)")
    state.chmod(0o700)
    rig.ready("a")


def test_agent_with_a_full_disk_answers_and_recovers(rig: Rig, state: Path):
    agent = rig.ready("a", COUNT)
    agent.hear("counted")
    _, hard = resource.prlimit(agent.pid, resource.RLIMIT_FSIZE)

    resource.prlimit(agent.pid, resource.RLIMIT_FSIZE, (0, hard))  # as a full disk: no file may become longer
    agent.hear(f"the journal cannot write: File too large ({state}): it is retried")
    stopped = rig.pancakes("task", "stop", "a/Count")
    assert stopped.returncode == 1
    assert "the journal cannot write" in stopped.stderr
    started = rig.pancakes("task", "start", "a/Count")
    assert started.returncode == 1 and "the journal cannot write" in started.stderr

    resource.prlimit(agent.pid, resource.RLIMIT_FSIZE, (hard, hard))
    agent.hear("the journal can write again")
    agent.hear("task_started task=Count")
    assert rig.pancakes("task", "stop", "a/Count").returncode == 0
    agent.signalled(signal.SIGTERM)


def test_task_recover_decides_about_a_damaged_record(rig: Rig, state: Path):
    rig.ready("a", COUNT).signalled(signal.SIGTERM)
    record = state / "record.a%2FCount.rec"
    record.write_bytes(record.read_bytes()[:-1] + b"?")
    agent = rig.agent(rig.config("a", COUNT))
    agent.hear("/kernel: ready")
    agent.hear("a/Count is not started: it may run elsewhere")
    rig.entry(agent.pid)
    asked = rig.pancakes("task", "start", "a/Count")
    assert asked.returncode == 1 and "`pancakes task recover a/Count --not-here` leaves it there" in asked.stderr
    assert troubles(rig) == {"a/Count": "damaged record"}

    assert recovered(rig, "a/Count", "--not-here", "--dry-run")[1]["done"] == "dry run"
    code, _, said = recovered(rig, "a/Count", "--not-here")
    assert code == 1 and "if it runs nowhere else, it is gone" in said
    code, row, _ = recovered(rig, "a/Count", "--not-here", "--yes")
    assert (code, row["done"]) == (0, "left")
    assert troubles(rig) == {} and recovered(rig, "a/Count")[0] == 0, "a person has decided"
    assert recovered(rig, "a/Count", "--here")[0] == 1
    code, row, _ = recovered(rig, "a/Count", "--here", "--yes")
    assert (code, row["runs_on"]) == (0, "a")
    agent.signalled(signal.SIGTERM)
    assert record.exists()
