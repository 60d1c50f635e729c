"""Processes that a launcher starts, by a fork server or as new processes: both have the same interface."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from pancakes.tools.launch.process import AgentProcess, ForkServer, end_all

PATIENCE_S = 30.0
AGENT = f'schema = 1\n[agent]\nname = "a"\nfleet = "started-by-{os.getpid()}"\nstate_dir = ""\n'
"""A fleet name that is unique to this test run."""
Start = Callable[[str], "Started"]


class Started:
    """A started agent, and its output."""

    def __init__(self, process: AgentProcess, output: int, ready: int) -> None:
        self.process, self.output, self.ready = process, output, ready

    def is_ready(self) -> bool:
        return os.read(self.ready, 64).startswith(b"ready")

    def everything(self) -> str:
        with os.fdopen(self.output, "rb", closefd=False) as output:
            return output.read().decode()


def made_anew(arguments: list[str], output: int, ready: int) -> AgentProcess:
    command = [sys.executable, "-m", "pancakes.tools.cli.agent_command", *arguments, f"--ready-fd={ready}"]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True, pass_fds=(ready,)
    )


@pytest.fixture
def server() -> Iterator[ForkServer]:
    server = ForkServer()
    yield server
    server.close()


@pytest.fixture(params=["forked", "made anew"])
def start(request: pytest.FixtureRequest, tmp_path: Path, server: ForkServer) -> Iterator[Start]:
    started: list[Started] = []

    def start_one(text: str) -> Started:
        config = tmp_path / "a.toml"
        config.write_text(text)
        arguments = ["--config", str(config), f"--die-with-parent={os.getpid()}"]
        output, outputs = os.pipe()
        ready, tell_ready = os.pipe()
        fork = made_anew if request.param == "made anew" else server.fork
        started.append(Started(fork(arguments, outputs, tell_ready), output, ready))
        os.close(outputs)
        os.close(tell_ready)
        return started[-1]

    yield start_one
    end_all([it.process for it in started], 0.0)
    for it in started:
        os.close(it.output)
        os.close(it.ready)


def test_agent_is_a_child_with_its_own_session(start: Start) -> None:
    agent = start(AGENT)
    assert agent.is_ready() and agent.process.poll() is None and agent.process.returncode is None
    found = psutil.Process(agent.process.pid)
    assert found.ppid() == os.getpid() and os.getsid(agent.process.pid) == agent.process.pid
    assert found.cmdline()[:4] == [sys.executable, "-m", "pancakes.tools.cli.agent_command", "--config"]
    with pytest.raises(subprocess.TimeoutExpired):
        agent.process.wait(0.01)
    agent.process.terminate()
    assert agent.process.wait(PATIENCE_S) == agent.process.poll() == agent.process.returncode == 0
    agent.process.terminate()
    agent.process.kill()
    assert "stopped" in agent.everything()


def test_exit_code_of_an_agent_is_known(start: Start) -> None:
    bad = start("schema = 1\n[agent]\nnam = 1\n")
    assert bad.process.wait(PATIENCE_S) == 4 and "a.toml" in bad.everything()
    killed = start(AGENT)
    assert killed.is_ready()
    killed.process.kill()
    assert killed.process.wait(PATIENCE_S) == -signal.SIGKILL


def test_agents_outlive_their_fork_server(server: ForkServer, start: Start) -> None:
    first = start(AGENT)
    assert first.is_ready()
    for child in psutil.Process().children():
        if "pancakes.tools.cli.fork_server" in child.cmdline():
            child.kill()
    second = start(AGENT.replace('"a"', '"b"'))
    assert second.is_ready() and first.process.poll() is None
    server.close()
    assert second.process.poll() is None


def test_fork_server_that_ends_at_once_raises_oserror() -> None:
    with pytest.raises(OSError, match="fork server"):
        ForkServer(program="no.such.program").fork([], 1, None)


def test_hanging_fork_server_is_given_up(server: ForkServer, monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull, "wb") as nothing:
        server.fork(["--version"], nothing.fileno(), None).wait(PATIENCE_S)
        (child,) = [it for it in psutil.Process().children() if "pancakes.tools.cli.fork_server" in it.cmdline()]
        child.suspend()
        with monkeypatch.context() as patch, pytest.raises(TimeoutError):
            patch.setattr("pancakes.tools.launch.process.ANSWER_S", 0.5)
            server.fork(["--version"], nothing.fileno(), None)
        assert not child.is_running()
        assert server.fork(["--version"], nothing.fileno(), None).wait(PATIENCE_S) == 0
