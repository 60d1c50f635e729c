"""The processes of launched agents: their output becomes lines, and their end is reported after all output."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pancakes.tools.remote_host.agent_processes import LONGEST, AgentProcesses, Lines


class Heard:
    """Records all events."""

    def __init__(self) -> None:
        self.events: list[tuple[object, ...]] = []

    def printed(self, name: str, text: str) -> None:
        self.events.append((name, "printed", text))

    def said(self, name: str, line: str) -> None:
        self.events.append((name, "said", line))

    def ended(self, name: str, code: int, how: str = "") -> None:
        self.events.append((name, "ended", code))


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def closed() -> list[int]:
    return []


@pytest.fixture
def processes(heard: Heard, closed: list[int]) -> Iterator[AgentProcesses]:
    made = AgentProcesses(heard, closed.append)
    yield made
    for process in made.processes():
        process.kill()
        process.wait()
    made.look()


def start(processes: AgentProcesses, name: str, script: str) -> None:
    def make(output: int, said: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-S", "-c", f"import os, sys\n{script.replace('SAID', str(said))}"]
        return subprocess.Popen(command, stdout=output, stderr=output, pass_fds=(said,))

    processes.start(name, make)


def open_files() -> int:
    return len(list(Path(f"/proc/{os.getpid()}/fd").iterdir()))


def test_agent_output_is_read_to_the_end(processes: AgentProcesses, heard: Heard, closed: list[int]) -> None:
    before = open_files()
    start(processes, "a", "os.write(1, b'one\\n'); os.write(SAID, b'ready\\n'); os.write(1, b'two'); sys.exit(7)")
    pipes = set(processes.pipes())
    while reads := processes.pipes():
        for pipe in select.select(list(reads), [], [])[0]:
            reads[pipe]()
    processes.processes()[0].wait()
    processes.look()

    assert sorted(heard.events[:-1]) == [("a", "printed", "one"), ("a", "printed", "two"), ("a", "said", "ready")]
    assert heard.events[-1] == ("a", "ended", 7) and not processes
    assert set(closed) == pipes and open_files() == before


def test_last_output_is_reported_before_the_end(processes: AgentProcesses, heard: Heard) -> None:
    start(processes, "a", "os.write(1, b'last'); os.system('sleep 5 &')")  # its child keeps the pipe open
    child = processes.processes()[0]
    child.wait()
    processes.look()

    assert heard.events == [("a", "printed", "last"), ("a", "ended", 0)]


def test_failed_start_leaves_no_pipe_open(processes: AgentProcesses) -> None:
    def fail(output: int, said: int) -> subprocess.Popen[bytes]:
        raise OSError("no room")

    before = open_files()
    with pytest.raises(OSError, match="no room"):
        processes.start("a", fail)

    assert open_files() == before and not processes


def test_lines_are_joined_from_pieces() -> None:
    lines = Lines()

    assert list(lines.feed(b"one\ntw")) == ["one"]
    assert list(lines.feed(b"o\r\n\nthr")) == ["two", ""]
    assert list(lines.rest()) == ["thr"]
    assert list(lines.rest()) == []


def test_split_and_invalid_utf8_are_decoded() -> None:
    lines = Lines()
    first, second = "ä".encode()[:1], "ä".encode()[1:]

    assert list(lines.feed(first)) == []
    assert list(lines.feed(second + b"\n\xff\n")) == ["ä", "�"]


def test_endless_line_is_cut() -> None:
    found = list(Lines().feed(b"x" * (LONGEST + 5)))

    assert [len(line) for line in found] == [LONGEST]
