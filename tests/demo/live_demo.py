"""A demo as a person runs it, with real agents, watched from outside: what it prints, and its processes."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from types import TracebackType

import psutil
from harness.programs import Program, pancakes

PATIENCE_S = 60.0
AGENTS = ("world", "agent1", "agent2", "sensor")


class LiveDemo:
    """`pancakes demo NAME --headless` in a process of its own; used in a `with` statement.

    Args:
        out: where its results go.
        arguments: what else to say on its command line.

    Attributes:
        name: the demo.
        agents: those of them that were found, and what else `name_of` knows.
    """

    name = "encirclement"

    def __init__(self, out: Path, *arguments: str) -> None:
        self.out = out
        self.lines: list[str] = []
        self.process = Program(
            pancakes("demo", self.name, "--headless", "--out", str(out), *arguments),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        self.agents: dict[str, psutil.Process] = {}
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()

    def wait_for(self, text: str) -> None:
        """Waits until it has printed a line with `text`, and for its agents."""
        with self._news:
            seen = self._news.wait_for(lambda: any(text in line for line in self.lines), PATIENCE_S)
        assert seen, f"it never said {text!r}, only:\n{self.said}"
        self.wait_for_agents()

    def wait_for_agents(self) -> None:
        """Waits until all of its agents run, whatever they are doing.

        A process that was just forked has its launcher's command line for a moment: it is not known as an agent yet.
        """
        deadline_s = time.monotonic() + PATIENCE_S
        self._find_agents()
        while not self.is_whole:
            assert self.process.poll() is None and time.monotonic() < deadline_s, self.said
            time.sleep(0.01)
            self._find_agents()

    def _find_agents(self) -> None:
        for child in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):  # it may have ended, or not have become an agent yet
                name = self.name_of(child.cmdline())
                if name:
                    self.agents[name] = child

    @property
    def is_whole(self) -> bool:
        """Whether all of its agents were found, and run."""
        return sorted(self.agents) == sorted(AGENTS) and all(_runs(agent) for agent in self.agents.values())

    def name_of(self, words: list[str]) -> str:
        """Returns the name of a process by its command line; an empty string: it is none of ours."""
        if "pancakes.tools.cli.agent_command" in words and "--config" in words:
            return Path(words[words.index("--config") + 1]).stem
        return ""

    def ends(self, within_s: float = PATIENCE_S) -> int:
        """Waits until the launcher has ended; returns its exit code."""
        code = self.process.wait(within_s)
        self._reader.join(PATIENCE_S)
        return code

    def left_after(self, within_s: float) -> list[str]:
        """Returns which of its processes still run after some seconds."""
        deadline_s = time.monotonic() + within_s
        left = [name for name, process in self.agents.items() if _runs(process)]
        while left and time.monotonic() < deadline_s:
            psutil.wait_procs([self.agents[name] for name in left], 0.05)
            left = [name for name in left if _runs(self.agents[name])]
        return left

    @property
    def said(self) -> str:
        """All that it has printed."""
        with self._news:
            return "\n".join(self.lines)

    def __enter__(self) -> LiveDemo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves nothing behind, also where a test failed."""
        for agent in self.agents.values():
            if _runs(agent):
                agent.kill()
        if self.process.poll() is None:
            for child in psutil.Process(self.process.pid).children(recursive=True):
                child.kill()
            self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self._reader.join(PATIENCE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


def _runs(process: psutil.Process) -> bool:
    """Whether a process runs: one that has ended may wait a while until the system's first process buries it."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
