"""Start, read and end the processes of launched agents: used by the launcher itself, and sent to other hosts.

Each agent has two pipes: one for its output, and one for its progress (`pancakes-agent --ready-fd`).
"""

from __future__ import annotations

import os
from codecs import getincrementaldecoder
from collections.abc import Callable, Iterator
from typing import Final, Protocol

LONGEST: Final = 65_536
"""A line without an end is cut after this many characters."""
_CHUNK: Final = 65_536


class AgentProcess(Protocol):
    """The process of one agent, with the interface of `subprocess.Popen`."""

    @property
    def pid(self) -> int:
        """The process number."""

    @property
    def returncode(self) -> int | None:
        """The exit code, or minus the number of the signal; None: the process runs, or `poll` was not called."""

    def poll(self) -> int | None:
        """Return the exit code; None: the process runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the process has ended, and return its exit code.

        Raises:
            subprocess.TimeoutExpired: it still runs after `timeout` seconds.
        """

    def terminate(self) -> None:
        """Send SIGTERM."""

    def kill(self) -> None:
        """Send SIGKILL."""


class AgentListener(Protocol):
    """Receive the events of agents, in the thread that runs them."""

    def printed(self, name: str, text: str) -> None:
        """Handle a line that an agent has printed."""

    def said(self, name: str, line: str) -> None:
        """Handle a line about the progress of an agent, as `pancakes-agent --ready-fd` writes it."""

    def ended(self, name: str, code: int, how: str = "") -> None:
        """Handle the exit code of an agent's process; `how` says how it ended if the code does not."""


class Lines:
    """Split the output of a process into lines. Bytes that are not UTF-8 become replacement characters."""

    def __init__(self) -> None:
        self._decoder = getincrementaldecoder("utf-8")("replace")
        self._begun = ""

    def feed(self, data: bytes) -> Iterator[str]:
        """Take some output, and yield the lines that are complete now."""
        *whole, self._begun = (self._begun + self._decoder.decode(data)).split("\n")
        for line in whole:
            yield line.removesuffix("\r")
        while len(self._begun) > LONGEST:
            yield self._begun[:LONGEST]
            self._begun = self._begun[LONGEST:]

    def rest(self) -> Iterator[str]:
        """Yield the last line if it has no newline."""
        begun, self._begun = self._begun + self._decoder.decode(b"", final=True), ""
        if begun:
            yield begun


class _Pipe:
    """One pipe of an agent, and the lines from it."""

    def __init__(self, number: int, take: Callable[[str], None], closing: Callable[[int], None]) -> None:
        os.set_blocking(number, False)
        self.number = number
        self.open = True
        self._take = take
        self._closing = closing
        self._lines = Lines()

    def read(self) -> bool:
        """Read the pipe once, and close it at its end; return whether there was any data."""
        try:
            data = os.read(self.number, _CHUNK)
        except BlockingIOError:
            return False
        for line in self._lines.feed(data):
            self._take(line)
        if not data:
            self.close()
        return bool(data)

    def close(self) -> None:
        if self.open:
            self.open = False
            for line in self._lines.rest():
                self._take(line)
            self._closing(self.number)
            os.close(self.number)


class _Agent:
    """The process of one agent, and its pipes."""

    def __init__(self, process: AgentProcess, output: _Pipe, progress: _Pipe) -> None:
        self.process = process
        self.output = output
        self.progress = progress


class AgentProcesses:
    """Hold the processes of agents by their names, in one thread.

    Args:
        listener: receives the output, progress and end of each agent.
        closing: called with the file descriptor of each pipe before it is closed.
    """

    def __init__(self, listener: AgentListener, closing: Callable[[int], None] = lambda pipe: None) -> None:
        self._listener = listener
        self._closing = closing
        self._agents: dict[str, _Agent] = {}

    def __bool__(self) -> bool:
        return bool(self._agents)

    def start(self, name: str, make: Callable[[int, int], AgentProcess]) -> AgentProcess:
        """Start an agent.

        Args:
            name: the agent.
            make: creates its process, given the write ends of the pipes for its output and its progress.

        Raises:
            OSError: the process cannot be created.
        """
        output, output_end = os.pipe()
        progress, progress_end = os.pipe()
        try:
            process = make(output_end, progress_end)
        except BaseException:
            os.close(output)
            os.close(progress)
            raise
        finally:
            os.close(output_end)
            os.close(progress_end)
        listener = self._listener
        self._agents[name] = _Agent(
            process,
            _Pipe(output, lambda line: listener.printed(name, line), self._closing),
            _Pipe(progress, lambda line: listener.said(name, line), self._closing),
        )
        return process

    def terminate(self, name: str) -> None:
        """Tell an agent to end."""
        if name in self._agents:
            self._agents[name].process.terminate()

    def kill(self, name: str) -> None:
        """End an agent by force."""
        if name in self._agents:
            self._agents[name].process.kill()

    def processes(self) -> list[AgentProcess]:
        """Return the processes whose end has not been reported yet."""
        return [agent.process for agent in self._agents.values()]

    def pipes(self, name: str = "") -> dict[int, Callable[[], bool]]:
        """Return the open pipes of one agent, or of all, each with the function that reads it when it is ready."""
        agents = [self._agents[name]] if name else self._agents.values()
        return {pipe.number: pipe.read for agent in agents for pipe in (agent.output, agent.progress) if pipe.open}

    def look(self) -> None:
        """Report the agents that have ended, after all of their output."""
        for name, agent in list(self._agents.items()):
            code = agent.process.poll()
            if code is None:
                continue
            del self._agents[name]
            while agent.output.open and agent.output.read():
                pass
            agent.output.close()  # a child process of the agent may keep the other end open for ever
            agent.progress.close()
            self._listener.ended(name, code)
