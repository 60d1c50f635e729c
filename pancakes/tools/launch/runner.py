"""The rim around a `Course`: processes, signals, and what the agents say."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import threading
from collections import deque
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, Final, Protocol

from pancakes.runtime.clock import MonotonicClock
from pancakes.tools.launch.course import Action, BeginMission, Course, Kill, SpawnProcess, TellPerson, Terminate
from pancakes.tools.launch.host_agents import HostAgents
from pancakes.tools.launch.lines import Lines
from pancakes.tools.launch.member import Member
from pancakes.tools.launch.process import Starter, end_all

_ENDS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_CHUNK: Final = 65_536


class Voice(Protocol):
    """Takes what a fleet says; in the thread that runs it."""

    def line(self, agent: str, text: str) -> None:
        """An agent has printed a line."""

    def told(self, agent: str, event: str, text: str) -> None:
        """Something has become of an agent; of the fleet where `agent` is empty. See `TellPerson`."""


LetBegin = Callable[[dict[str, int]], list[str]]
"""Lets the mission of agents begin, given their processes by name; returns sentences about what went wrong.

It may wait, in a thread of its own."""

Elsewhere = Callable[[selectors.BaseSelector, Callable[[], float]], HostAgents]
"""Returns what starts and ends the agents that run on other hosts."""


class _Process:
    """One agent's process, and the pipes that lead to it."""

    def __init__(self, member: Member, starter: Starter) -> None:
        self.output, output = os.pipe()
        self.ready, ready = os.pipe()
        try:
            self.process = starter.start(member.path, member.sets, output, ready)
        except BaseException:
            os.close(self.output)
            os.close(self.ready)
            raise
        finally:
            os.close(output)
            os.close(ready)
        os.set_blocking(self.output, False)
        self.lines = Lines()
        self.said = Lines()


class Runner:
    """Runs a fleet until it has ended, in the main thread.

    SIGINT, SIGTERM and SIGHUP end it in order, for the second time at once.

    Args:
        members: its agents.
        course: what decides.
        voice: what is told to the person.
        let_begin: see `LetBegin`.
        elsewhere: see `Elsewhere`; it is asked for where a member has a host.
    """

    def __init__(
        self,
        members: Sequence[Member],
        course: Course,
        voice: Voice,
        let_begin: LetBegin,
        elsewhere: Elsewhere | None = None,
    ) -> None:
        self._members = {member.name: member for member in members}
        self._course = course
        self._voice = voice
        self._let_begin = let_begin
        self._now = MonotonicClock().now
        self._starter = Starter()
        self._processes: dict[str, _Process] = {}
        self._selector = selectors.DefaultSelector()
        self._pids: dict[str, int] = {}
        self._rests: dict[str, dict[str, str]] = {}
        self._elsewhere = elsewhere(self._selector, self._now) if elsewhere is not None else None
        self._posted: deque[Callable[[], None]] = deque()
        self._mute = False

    def run(self) -> int:
        """Runs the fleet; returns the exit code."""
        self._wake_reader, self._wake_writer = os.pipe()
        os.set_blocking(self._wake_writer, False)
        os.set_blocking(self._wake_reader, False)
        # The kernel may hand a signal to any thread: this wakes the one that waits here.
        signal.set_wakeup_fd(self._wake_writer, warn_on_full_buffer=False)
        for number in (*_ENDS, signal.SIGCHLD):
            if number == signal.SIGCHLD or signal.getsignal(number) is not signal.SIG_IGN:  # as `nohup` asks for
                signal.signal(number, self._heard)
        self._selector.register(self._wake_reader, selectors.EVENT_READ, self._woken)
        if self._elsewhere is not None:
            self._elsewhere.attend(self)
        try:
            self._do(self._course.start(self._now()))
            while not self._course.over:
                self._wait()
        finally:
            if self._elsewhere is not None:
                self._elsewhere.close()
            end_all([it.process for it in self._processes.values()], 0.0)
            self._starter.close()
        return self._course.exit_code

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if number != signal.SIGCHLD:
            self._posted.append(lambda: self._do(self._course.stop(self._now())))

    def _wait(self) -> None:
        times = [self._course.deadline_s, self._elsewhere.due_s if self._elsewhere is not None else None]
        deadline_s = min((it for it in times if it is not None), default=None)
        timeout_s = None if deadline_s is None else max(0.0, deadline_s - self._now())
        for key, _ in self._selector.select(timeout_s):
            if self._selector.get_map().get(key.fd) is key:  # the end of a process closes its pipes
                key.data()
        while self._posted:
            self._posted.popleft()()
        if self._elsewhere is not None:
            self._elsewhere.tick()
        self._do(self._course.tick(self._now()))

    def _woken(self) -> None:
        os.read(self._wake_reader, _CHUNK)
        for name, place in list(self._processes.items()):
            code = place.process.poll()
            if code is not None:
                self._ended(name, place, code)

    def _post(self, function: Callable[[], None]) -> None:
        """Has a function called in the main thread. Any thread."""
        self._posted.append(function)
        with contextlib.suppress(BlockingIOError):  # it is full of reasons to wake up
            os.write(self._wake_writer, b"\0")

    # What the course wants -------------------------------------------------------------------------------------

    def _do(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case SpawnProcess(name):
                    self._spawn(name)
                case Terminate(name):
                    if self._elsewhere is not None and self._members[name].host:
                        self._elsewhere.end(name)
                    else:
                        self._processes[name].process.terminate()
                case Kill(name):
                    if self._elsewhere is not None and self._members[name].host:
                        self._elsewhere.kill(name)
                    else:
                        self._processes[name].process.kill()
                case BeginMission(names):
                    self._begin(names)
                case TellPerson(name, event, text):
                    self._say(self._voice.told, name, event, text)

    def _spawn(self, name: str) -> None:
        self._rests[name] = {}
        if self._elsewhere is not None and self._members[name].host:
            self._elsewhere.start(name)
            return
        try:
            place = _Process(self._members[name], self._starter)
        except OSError as error:
            self._do(self._course.unstartable(name, (error.strerror or str(error)).lower(), self._now()))
            return
        self._processes[name] = place
        self._pids[name] = place.process.pid
        self._selector.register(place.output, selectors.EVENT_READ, lambda: self._read(name, place))
        self._selector.register(place.ready, selectors.EVENT_READ, lambda: self._read_ready(name, place))
        self._say(self._voice.told, name, "started", f"runs as process {place.process.pid}")

    def _begin(self, names: Sequence[str]) -> None:
        pids = {name: self._pids[name] for name in names}

        def let_begin() -> None:
            problems = self._let_begin(pids)
            self._post(lambda: told(problems))

        def told(problems: list[str]) -> None:
            for problem in problems:
                self._say(self._voice.told, "", "held", problem)
            if not problems:
                self._say(self._voice.told, "", "begun", f"the mission of {', '.join(names)} begins")

        threading.Thread(target=let_begin, name="begin", daemon=True).start()

    # What the processes say -----------------------------------------------------------------------------------

    def _read(self, name: str, place: _Process) -> bool:
        """Reads what an agent has printed; returns whether there was something."""
        try:
            data = os.read(place.output, _CHUNK)
        except BlockingIOError:
            return False
        for text in place.lines.feed(data) if data else place.lines.rest():
            self._say(self._voice.line, name, text)
        if not data:
            self._selector.unregister(place.output)
        return bool(data)

    def _read_ready(self, name: str, place: _Process) -> None:
        """Reads how far an agent says that it is (see `pancakes-agent --ready-fd`)."""
        data = os.read(place.ready, _CHUNK)
        if not data:
            self._selector.unregister(place.ready)
        for line in place.said.feed(data):
            self._said(name, line)

    def _said(self, name: str, line: str) -> None:
        word, _, rest = line.partition(" ")
        if word == "ready":
            self._do(self._course.ready(name, self._now(), self._rests[name]))
        elif word == "rests":
            task, _, why = rest.partition(" ")
            self._rests[name][task] = why

    def _ended(self, name: str, place: _Process, code: int) -> None:
        """A process has ended. What it printed last is read; a child that it left may keep the pipe open for ever."""
        del self._processes[name]
        registered = self._selector.get_map()
        if place.ready in registered:
            self._selector.unregister(place.ready)
        if place.output in registered:
            while self._read(name, place):
                pass
        if place.output in registered:
            self._selector.unregister(place.output)
            for text in place.lines.rest():
                self._say(self._voice.line, name, text)
        os.close(place.output)
        os.close(place.ready)
        self._do(self._course.ended(name, code, self._now()))

    # What agents on other hosts do (`HostListener`) -----------------------------------------------------------------

    def started_there(self, name: str, host: str, pid: int) -> None:
        """See `HostListener`."""
        self._pids[name] = pid
        self._say(self._voice.told, name, "started", f"runs as process {pid} on {host}")

    def printed_there(self, name: str, text: str) -> None:
        """See `HostListener`."""
        self._say(self._voice.line, name, text)

    def said_there(self, name: str, line: str) -> None:
        """See `HostListener`."""
        self._said(name, line)

    def ended_there(self, name: str, code: int, how: str) -> None:
        """See `HostListener`."""
        self._do(self._course.ended(name, code, self._now(), how))

    def failed_there(self, name: str, reason: str) -> None:
        """See `HostListener`."""
        self._do(self._course.unstartable(name, reason, self._now()))

    def _say(self, say: Callable[..., None], *what: Any) -> None:
        """Says something. Where the reader of the output has ended (`| head`), the fleet ends, in silence."""
        if self._mute:
            return
        try:
            say(*what)
        except OSError:
            self._mute = True
            self._posted.append(lambda: self._do(self._course.stop(self._now())))
