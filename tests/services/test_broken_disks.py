"""What an agent does while its journal cannot write: each asker hears what it waits for, and all goes on afterwards."""

import os
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from pancakes.control import Configure, Describe, Start, Stop
from pancakes.devices import Pose
from pancakes.devices.driver import Sensor
from pancakes.journal.file_journal import WRITE_AHEAD
from pancakes.packet import SYSCTRL
from pancakes.task import Task, every
from pancakes.testing import Fleet, threaded_agent


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += self.settings.step


class Spoiler(Sensor):
    """A device that is opened before tasks are born, and then has the journal write nothing."""

    type = "pose"

    @dataclass
    class Settings:
        state: str = ""

    def open(self):
        (Path(self.settings.state) / WRITE_AHEAD).mkdir()

    def read(self):
        return Pose(0.0, 0.0, 0.0)


def is_said(agent, line):
    return line in agent.lines()


@contextmanager
def obstacle(state, kind="directory"):
    """Lies where the journal writes first. What was there the journal has in memory, and writes again."""
    place, pipe = state / WRITE_AHEAD, state / "pipe"
    if kind == "directory":
        while not place.is_dir():
            place.unlink(missing_ok=True)
            with suppress(FileExistsError):  # one is being written
                place.mkdir()
        yield
        place.rmdir()
        return
    os.mkfifo(pipe)  # who opens it to write waits until somebody reads
    os.replace(pipe, place)
    try:
        yield
    finally:
        reader = os.open(place, os.O_RDONLY | os.O_NONBLOCK)
        place.unlink()
        os.close(reader)


@pytest.mark.parametrize(
    ("kind", "what"),
    [("directory", "cannot write: Is a directory"), ("pipe", "has been waiting for the disk for")],
    ids=["it fails", "it hangs"],
)
def test_each_asker_is_answered_while_the_journal_cannot_write_and_all_is_done_in_order_afterwards(
    tmp_path, kind, what
):
    state = tmp_path / "a"
    with threaded_agent("a", tasks={"Count": {"type": Count, "start": False}}, state_dir=state) as agent:
        with obstacle(state, kind):
            bodies = (Start("Count"), Configure("Count", {"step": 2}), Stop("Count"))
            asked = [agent.publish(SYSCTRL, body) for body in bodies]
            for packet in asked:
                reply = agent.reply_to(packet, timeout_s=3.0)
                assert not reply.ok
                assert reply.reason.startswith("a/client/Count is starting; what was asked for waits: the journal ")
                assert what in reply.reason and f"({state})" in reply.reason
            assert agent.running() == []
            assert agent.ask(Describe("Count"), timeout_s=3.0).result["state"] == "starting"

        agent.wait_for_event("task_started", task="Count")
        agent.wait_for_event("task_stopped", task="Count")
        for number in (1, 2, 3):
            agent.wait_until(partial(is_said, agent, f"what a/test/Probe asked for (#{number}) is done"))
        assert agent.ask(Start("Count")).ok
        assert agent.ask(Stop("Count")).ok


def test_a_stop_and_a_start_that_could_not_be_written_leave_what_was_asked_for_last(tmp_path):
    state = tmp_path / "a"
    with threaded_agent("a", tasks={"Count": Count}, state_dir=state) as agent:
        with obstacle(state):
            assert "is stopped; what was asked for waits" in agent.ask(Stop("Count")).reason
            assert agent.running() == []
            assert "is stopped; what was asked for waits" in agent.ask(Start("Count")).reason
        agent.wait_until(lambda: agent.running() == ["Count"])
        assert agent.ask(Configure("Count", {"step": 3})).ok
    with threaded_agent("a", tasks={"Count": Count}, state_dir=state) as agent:
        assert agent.running() == ["Count"]


def test_an_agent_whose_task_cannot_be_written_down_at_its_start_gets_ready_all_the_same(tmp_path):
    state = tmp_path / "a"
    devices = {"spoiler": {"type": Spoiler, "settings": {"state": str(state)}}}
    with threaded_agent("a", tasks={"Count": Count}, devices=devices, state_dir=state) as agent:
        assert agent.running() == []
        assert "cannot write: Is a directory" in agent.ask(Describe("Count")).result["reason"]
        (state / WRITE_AHEAD).rmdir()
        agent.wait_for_event("task_started", task="Count")


def test_a_task_that_is_written_down_each_time_neither_keeps_the_machine_busy_nor_fills_the_log(tmp_path):
    state = tmp_path / "a"
    tasks = {"Count": {"type": Count, "durability": "each"}}
    with threaded_agent("a", tasks=tasks, state_dir=state) as agent:

        def lines():
            return [line for line in agent.lines() if "the journal can" in line]

        with obstacle(state):
            agent.wait_until(lambda: len(lines()) == 2, what="a second line about the journal")
        first, second = lines()
        reason = f"the journal cannot write: Is a directory ({state})"
        assert first == f"{reason}: it is retried, first soon, then every 5 s"
        tries, words, *_ = second.partition("): ")[2].split()
        assert words == "tries" and 3 <= int(tries) <= 9
        agent.wait_until(lambda: len(lines()) == 3)
        assert lines()[-1].startswith("the journal can write again (")
        assert agent.ask(Stop("Count")).ok


def test_a_symbolic_link_is_followed_and_told(tmp_path):
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "elsewhere")
    with threaded_agent("a", tasks={"Count": Count}, state_dir=link) as agent:
        (told,) = [line for line in agent.lines("warning") if "symbolic link" in line]
        assert told.endswith(f"{link} is a symbolic link: {tmp_path / 'elsewhere'} is used")
    assert (tmp_path / "elsewhere" / "record.a%2FCount.rec").exists()


def test_agent_says_that_its_journal_cannot_write():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Count": Count})
        fleet.faults.fill_disk("a")
        fleet.run_for(3.0)
        assert agent.ask(Describe()).result["journal_fault"] == "no space left on device"
        fleet.faults.calm()
        fleet.run_for(10.0)
        assert agent.ask(Describe()).result["journal_fault"] == ""
