"""Supervise a launched fleet: when each agent starts, restarts and ends, and the processes that do it.

`LaunchPlan` decides and is pure: events in, actions out. An agent starts once the agents in its `after` are ready. If
its process ends by itself, the plan restarts it as its policy says, or gives it up. At the end, the plan stops an agent
once the agents that come after it have ended. `Runner` executes the actions in the main thread: processes, pipes,
signals, other hosts.
"""

from __future__ import annotations

import contextlib
import os
import random
import selectors
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from signal import Signals
from types import FrameType, MappingProxyType
from typing import Any, Final, Protocol, assert_never

from pancakes.supervision.lifecycle import (
    Admitted,
    Answer,
    AskLeave,
    Began,
    Event,
    Finished,
    LeaveRefused,
    LetGo,
    Life,
    LookAgain,
    News,
    Overdue,
    Revoke,
    Settle,
    Spawn,
    StartAsked,
    State,
    StopAsked,
    Tell,
    TellToEnd,
    TryAt,
    TryDue,
    WriteRest,
)
from pancakes.supervision.lifecycle_table import handle
from pancakes.supervision.restart import Restarts, RestartSpec
from pancakes.tools.launch.fleet_file import Member, ProcessRestart
from pancakes.tools.launch.process import Starter, end_all
from pancakes.tools.launch.remote_hosts import HostAgents, LaunchListener
from pancakes.tools.remote_host.agent_processes import AgentProcesses
from pancakes.util.clock import MonotonicClock

READY_S: Final = 30.0
"""An agent that is not ready after this time is reported, in seconds."""
END_S: Final = 2.5
"""How long an agent may take to stop before it is killed, in seconds; it stops sooner even if a task is stuck."""
ALL_END_S: Final = 5.0
"""How long the whole fleet may take to stop before all of it is killed, in seconds."""
BAD_CONFIGURATION: Final = 4
"""The exit code for a bad configuration: a restart would end in the same way."""


@dataclass(frozen=True, slots=True)
class SpawnProcess:
    """Start the agent's process."""

    name: str


@dataclass(frozen=True, slots=True)
class Terminate:
    """Tell the agent's process to end."""

    name: str


@dataclass(frozen=True, slots=True)
class Kill:
    """End the agent's process by force."""

    name: str


@dataclass(frozen=True, slots=True)
class BeginMission:
    """Begin the mission of these agents, whose mission clock is held at 0."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TellPerson:
    """Tell the person what happened to an agent.

    Attributes:
        name: the agent; empty: the whole fleet.
        event: what happened, as one word for programs.
        text: the same as a phrase for people, to be read after the agent's name.
    """

    name: str
    event: str
    text: str


Action = SpawnProcess | Terminate | Kill | BeginMission | TellPerson


class _PlannedAgent:
    """The state of one agent in the plan.

    Attributes:
        life: the state of its process.
        how: how its process has ended, as a phrase; empty: it has not ended, or this was already reported.
        kill_s: when it is killed if it still runs, in host time; None: it was not told to end.
    """

    def __init__(self, member: Member) -> None:
        self.member = member
        self.life = Life(member.name, Restarts(_spec(member.restart)))
        self.started_s = 0.0
        self.late = False
        self.how = ""
        self.kill_s: float | None = None

    @property
    def waits(self) -> bool:
        return self.life.state is State.ASKED

    @property
    def ready(self) -> bool:
        return self.life.state is State.RUNNING

    @property
    def runs(self) -> bool:
        return self.life.state in (State.STARTING, State.RUNNING, State.STOPPING, State.STUCK)

    @property
    def killed(self) -> bool:
        return self.life.state is State.STUCK

    @property
    def over(self) -> bool:
        return self.life.state in (State.STOPPED, State.FAILED)


class LaunchPlan:
    """The plan of one fleet.

    Args:
        members: its agents, in the order in which they start.
        begin: whether missions that are held at 0 begin once all agents are ready.
        source: the random numbers for the pauses before restarts; None: a new source.
    """

    def __init__(self, members: Sequence[Member], begin: bool = True, source: random.Random | None = None) -> None:
        self._places = {member.name: _PlannedAgent(member) for member in members}
        self._begin = begin
        self._source = source or random.Random()
        self._begun = False
        self._stopping_s: float | None = None
        self._failed = False
        self._actions: list[Action] = []

    @property
    def over(self) -> bool:
        """Whether no agent runs, and none will start."""
        return all(place.over for place in self._places.values())

    @property
    def exit_code(self) -> int:
        """0; 1 if an agent was given up, or never started."""
        return int(self._failed)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` is due, in host time; None if nothing is due."""
        times = [it.kill_s for it in self._places.values() if it.runs and not it.killed and it.kill_s is not None]
        for place in self._places.values():
            if place.life.state is State.STARTING and not place.late:
                times.append(place.started_s + READY_S)
            if place.life.restarts.due_s is not None:
                times.append(place.life.restarts.due_s)
        if self._stopping_s is not None and any(it.runs and not it.killed for it in self._places.values()):
            times.append(self._stopping_s + ALL_END_S)
        return min(times, default=None)

    def start(self, now_s: float) -> list[Action]:
        """Start the agents that come after no other."""
        for place in self._places.values():
            self._feed(place, StartAsked(), now_s)
        self._admit(now_s)
        return self._done()

    def unstartable(self, name: str, reason: str, now_s: float) -> list[Action]:
        """Handle that a process could not be started; `reason` is a phrase."""
        self._failed = True
        self._feed(self._places[name], Finished(f"cannot be started: {reason}", True, hopeless=True), now_s)
        self._give_up_followers(now_s)
        return self._done()

    def ready(self, name: str, now_s: float, rests: Mapping[str, str] = MappingProxyType({})) -> list[Action]:
        """Handle that an agent is ready: all of its tasks that start with it run.

        Args:
            name: the agent.
            now_s: host time.
            rests: the tasks that do not start because of what happened in an earlier run, and why.
        """
        place = self._places[name]
        if place.life.state is not State.STARTING:
            return []
        self._feed(place, Began(), now_s)
        if self._stopping_s is None:
            for task, why in rests.items():
                self._tell(name, "rests", f"does not start {task}: {why}")
            if self._begun and place.member.config.clock.hold:
                # A restarted agent holds its mission clock again, while the mission of the others continues.
                self._actions.append(BeginMission((name,)))
            self._admit(now_s)
            self._begin_if_all_are_ready()
        return self._done()

    def ended(self, name: str, code: int, now_s: float, how: str = "") -> list[Action]:
        """Handle that a process has ended.

        Args:
            name: the agent.
            code: its exit code, or minus the number of the signal that ended it.
            now_s: host time.
            how: how it ended, as a phrase; empty: as the exit code says.
        """
        place = self._places[name]
        stopping = self._stopping_s is not None
        place.how = (how or _how(code)) + (", killed because it took too long" if place.killed else "")
        failed = code != 0 and not stopping
        text = f"has ended ({place.how})"
        self._feed(place, Finished(text, failed, code == BAD_CONFIGURATION, closing=stopping), now_s)
        if stopping:
            self._stop_next(now_s)
        elif place.over:
            self._give_up_followers(now_s)
        return self._done()

    def stop(self, now_s: float) -> list[Action]:
        """Stop the fleet gracefully; the second call kills what still runs."""
        if self._stopping_s is not None:
            self._kill((place for place in self._places.values() if place.runs), now_s)
            return self._done()
        self._stopping_s = now_s
        for place in self._places.values():
            if not place.runs:
                place.how = ""
                self._feed(place, StopAsked(), now_s)
        self._admit(now_s)
        self._stop_next(now_s)
        return self._done()

    def tick(self, now_s: float) -> list[Action]:
        """Do what is due: restarts, warnings about late agents, and kills."""
        for place in self._places.values():
            due_s = place.life.restarts.due_s
            if due_s is not None and now_s >= due_s:
                self._feed(place, TryDue(due_s), now_s)
                self._feed(place, Admitted(), now_s)
            if place.life.state is State.STARTING and not place.late and now_s >= place.started_s + READY_S:
                place.late = True
                self._tell(place.member.name, "late", f"is not ready after {READY_S:g} s")
        too_late = self._stopping_s is not None and now_s >= self._stopping_s + ALL_END_S
        overdue = [
            place
            for place in self._places.values()
            if place.runs and (too_late or (place.kill_s is not None and now_s >= place.kill_s))
        ]
        self._kill(overdue, now_s)
        return self._done()

    def _done(self) -> list[Action]:
        actions, self._actions = self._actions, []
        return actions

    # Starting --------------------------------------------------------------------------------------------------

    def _admit(self, now_s: float) -> None:
        """Start the waiting agents whose predecessors (`after`) are all ready."""
        for place in self._places.values():
            if place.life.state is State.CALLED_OFF:
                self._feed(place, LeaveRefused("the fleet ends"), now_s)
            elif place.waits and all(self._places[other].ready for other in place.member.after):
                self._feed(place, Admitted(), now_s)

    def _give_up_followers(self, now_s: float) -> None:
        """Give up the waiting agents that come after an agent which has ended for good."""
        lost = True
        while lost:
            lost = False
            for place in self._places.values():
                gone = [other for other in place.member.after if self._places[other].over]
                if place.waits and gone:
                    self._failed = lost = True
                    self._feed(place, LeaveRefused(f"{gone[0]}, which it comes after, has ended", for_good=True), now_s)
                    text = f"is not started: {gone[0]}, which it comes after, has ended"
                    self._tell(place.member.name, "given_up", text)
        if self._begin and not self._begun and any(place.runs for place in self._places.values()) and self._held():
            self._begin = False
            self._tell("", "held", "the mission does not begin: not all agents of the fleet run")

    def _held(self) -> list[str]:
        return [name for name, place in self._places.items() if place.member.config.clock.hold]

    def _begin_if_all_are_ready(self) -> None:
        if not self._begin or self._begun or not all(place.ready for place in self._places.values()):
            return
        self._begun = True
        held = tuple(self._held())
        if held:
            self._actions.append(BeginMission(held))

    # Stopping --------------------------------------------------------------------------------------------------

    def _stop_next(self, now_s: float) -> None:
        """Stop the agents that no running agent comes after, in reverse order of start."""
        for name, place in reversed(self._places.items()):
            later = any(other.runs and name in other.member.after for other in self._places.values())
            if place.life.state in (State.STARTING, State.RUNNING) and not later:
                place.kill_s = now_s + END_S
                self._actions.append(Terminate(name))
                self._feed(place, StopAsked(), now_s)

    def _kill(self, places: Iterable[_PlannedAgent], now_s: float) -> None:
        for place in places:
            if not place.killed:
                self._feed(place, StopAsked(), now_s)
                self._feed(place, Overdue(place.life.incarnation), now_s)

    # Effects of a life ------------------------------------------------------------------------------------------

    def _feed(self, place: _PlannedAgent, event: Event, now_s: float) -> None:
        place.life, effects = handle(place.life, event, now_s, self._source.uniform)
        name = place.member.name
        for effect in effects:
            match effect:
                case Spawn():
                    place.started_s, place.late = now_s, False
                    self._actions.append(SpawnProcess(name))
                case Revoke():
                    self._actions.append(Kill(name))
                case Tell():
                    self._tell_life(place, effect, now_s)
                # The plan checks by itself what is due and what has ended (`tick`, `_admit`, `_stop_next`).
                case AskLeave() | TellToEnd() | LetGo() | TryAt() | LookAgain() | Settle() | WriteRest() | Answer():
                    pass
                case _:
                    assert_never(effect)

    def _tell_life(self, place: _PlannedAgent, effect: Tell, now_s: float) -> None:
        name, restart = place.member.name, place.member.restart
        match effect.news:
            case News.STARTED:
                if self._stopping_s is None:
                    self._tell(name, "ready", "is ready")
            case News.RESTARTS:
                self._tell(name, "restarted", f"{effect.text} and is started again {place.life.restarts.when(now_s)}")
            case News.STOPPED:
                if place.how:
                    self._tell(name, "ended", f"has ended ({place.how})")
            case News.GIVEN_UP:
                self._failed = True
                why = ""
                if restart.policy != "no" and not effect.hopeless:
                    why = f" after {restart.at_most} restarts within {restart.within_s:g} s"
                self._tell(name, "given_up", f"{effect.text} and is given up{why}" if place.how else effect.text)
            case News.REFUSED | News.FAILED | News.FAILED_WHILE_STOPPING | News.FAILED_AT_THE_END | News.STUCK:
                pass
            case _:
                assert_never(effect.news)

    def _tell(self, name: str, event: str, text: str) -> None:
        self._actions.append(TellPerson(name, event, text))


def _spec(restart: ProcessRestart) -> RestartSpec:
    return RestartSpec(restart.policy, restart.at_most, restart.within_s, restart.pause_s, restart.pause_max_s)


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"ended by {Signals(-code).name}"
    except ValueError:  # a real-time signal has no name
        return f"ended by the signal {-code}"


_ENDS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_CHUNK: Final = 65_536


class LaunchReporter(Protocol):
    """Report the output and events of a fleet, in the thread that runs it."""

    def line(self, agent: str, text: str) -> None:
        """Report a line that an agent has printed."""

    def told(self, agent: str, event: str, text: str) -> None:
        """Report what happened to an agent, or to the fleet if `agent` is empty. See `TellPerson`."""


LetBegin = Callable[[dict[str, int]], list[str]]
"""Begins the mission of agents, given their process numbers by name; returns sentences about what went wrong.

It runs in a thread of its own, and may block."""

Elsewhere = Callable[[selectors.BaseSelector, Callable[[], float]], HostAgents]
"""Makes the `HostAgents` that start and end the agents on other hosts."""


class LocalAgents:
    """Start and end agents on this machine, as `HostAgents` does on others.

    Args:
        members: the agents.
        selector: pipes are registered with it; the data of each is the callback to call.
        listener: receives the events of the agents.
    """

    def __init__(
        self, members: Mapping[str, Member], selector: selectors.BaseSelector, listener: LaunchListener
    ) -> None:
        self._members = members
        self._selector = selector
        self._listener = listener
        self._starter = Starter()
        self._processes = AgentProcesses(listener, self._forget)

    def start(self, name: str) -> None:
        """Start an agent."""
        member = self._members[name]
        try:
            process = self._processes.start(
                name, lambda output, progress: self._starter.start(member.path, member.sets, output, progress)
            )
        except OSError as error:
            self._listener.failed(name, (error.strerror or str(error)).lower())
            return
        for pipe, read in self._processes.pipes(name).items():
            self._selector.register(pipe, selectors.EVENT_READ, read)
        self._listener.started(name, process.pid)

    def _forget(self, pipe: int) -> None:
        self._selector.unregister(pipe)

    def end(self, name: str) -> None:
        """Tell an agent to end."""
        self._processes.terminate(name)

    def kill(self, name: str) -> None:
        """End an agent by force."""
        self._processes.kill(name)

    def look(self) -> None:
        """Report the agents that have ended."""
        self._processes.look()

    def close(self) -> None:
        """End all agents by force, and the fork server."""
        end_all(self._processes.processes(), 0.0)
        self._starter.close()


class Runner:
    """Run a fleet until it has ended, in the main thread.

    SIGINT, SIGTERM and SIGHUP stop it gracefully; the second signal stops it at once.

    Args:
        members: its agents.
        plan: decides what to do.
        reporter: reports to the person.
        let_begin: see `LetBegin`.
        elsewhere: see `Elsewhere`; needed if a member has a host.
    """

    def __init__(
        self,
        members: Sequence[Member],
        plan: LaunchPlan,
        reporter: LaunchReporter,
        let_begin: LetBegin,
        elsewhere: Elsewhere | None = None,
    ) -> None:
        self._members = {member.name: member for member in members}
        self._plan = plan
        self._reporter = reporter
        self._let_begin = let_begin
        self._now = MonotonicClock().now
        self._selector = selectors.DefaultSelector()
        self._local = LocalAgents(self._members, self._selector, self)
        self._pids: dict[str, int] = {}
        self._rests: dict[str, dict[str, str]] = {}
        self._elsewhere = elsewhere(self._selector, self._now) if elsewhere is not None else None
        self._posted: deque[Callable[[], None]] = deque()
        self._mute = False

    def run(self) -> int:
        """Run the fleet; return the exit code."""
        self._wake_reader, self._wake_writer = os.pipe()
        os.set_blocking(self._wake_writer, False)
        os.set_blocking(self._wake_reader, False)
        # The operating system may deliver a signal to any thread; this wakes the main thread.
        signal.set_wakeup_fd(self._wake_writer, warn_on_full_buffer=False)
        for number in (*_ENDS, signal.SIGCHLD):
            if number == signal.SIGCHLD or signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` ignores SIGHUP
                signal.signal(number, self._heard)
        self._selector.register(self._wake_reader, selectors.EVENT_READ, self._woken)
        if self._elsewhere is not None:
            self._elsewhere.attend(self)
        try:
            self._do(self._plan.start(self._now()))
            while not self._plan.over:
                self._wait()
        finally:
            if self._elsewhere is not None:
                self._elsewhere.close()
            self._local.close()
        return self._plan.exit_code

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if number != signal.SIGCHLD:
            self._posted.append(lambda: self._do(self._plan.stop(self._now())))

    def _wait(self) -> None:
        times = [self._plan.deadline_s, self._elsewhere.due_s if self._elsewhere is not None else None]
        deadline_s = min((it for it in times if it is not None), default=None)
        timeout_s = None if deadline_s is None else max(0.0, deadline_s - self._now())
        for key, _ in self._selector.select(timeout_s):
            if self._selector.get_map().get(key.fd) is key:  # an earlier callback may have closed this pipe
                key.data()
        while self._posted:
            self._posted.popleft()()
        if self._elsewhere is not None:
            self._elsewhere.tick()
        self._do(self._plan.tick(self._now()))

    def _woken(self) -> None:
        os.read(self._wake_reader, _CHUNK)
        self._local.look()

    def _post(self, function: Callable[[], None]) -> None:
        """Call a function in the main thread, soon. Any thread."""
        self._posted.append(function)
        with contextlib.suppress(BlockingIOError):  # a full pipe wakes the main thread anyway
            os.write(self._wake_writer, b"\0")

    # Actions of the plan -------------------------------------------------------------------------------------

    def _do(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case SpawnProcess(name):
                    self._spawn(name)
                case Terminate(name):
                    self._agents_with(name).end(name)
                case Kill(name):
                    self._agents_with(name).kill(name)
                case BeginMission(names):
                    self._begin(names)
                case TellPerson(name, event, text):
                    self._say(self._reporter.told, name, event, text)

    def _spawn(self, name: str) -> None:
        self._rests[name] = {}
        self._agents_with(name).start(name)

    def _agents_with(self, name: str) -> LocalAgents | HostAgents:
        return self._elsewhere if self._elsewhere is not None and self._members[name].host else self._local

    def _begin(self, names: Sequence[str]) -> None:
        pids = {name: self._pids[name] for name in names}

        def let_begin() -> None:
            problems = self._let_begin(pids)
            self._post(lambda: report(problems))

        def report(problems: list[str]) -> None:
            for problem in problems:
                self._say(self._reporter.told, "", "held", problem)
            if not problems:
                self._say(self._reporter.told, "", "begun", f"the mission of {', '.join(names)} begins")

        threading.Thread(target=let_begin, name="begin", daemon=True).start()

    # Events of agents (`LaunchListener`) ------------------------------------------------------------------------

    def started(self, name: str, pid: int, host: str = "") -> None:
        """See `LaunchListener`."""
        self._pids[name] = pid
        self._say(self._reporter.told, name, "started", f"runs as process {pid}" + (f" on {host}" if host else ""))

    def printed(self, name: str, text: str) -> None:
        """See `LaunchListener`."""
        self._say(self._reporter.line, name, text)

    def said(self, name: str, line: str) -> None:
        """See `LaunchListener`."""
        word, _, rest = line.partition(" ")
        if word == "ready":
            self._do(self._plan.ready(name, self._now(), self._rests[name]))
        elif word == "rests":
            task, _, why = rest.partition(" ")
            self._rests[name][task] = why

    def ended(self, name: str, code: int, how: str = "") -> None:
        """See `LaunchListener`."""
        self._do(self._plan.ended(name, code, self._now(), how))

    def failed(self, name: str, reason: str) -> None:
        """See `LaunchListener`."""
        self._do(self._plan.unstartable(name, reason, self._now()))

    def _say(self, say: Callable[..., None], *what: Any) -> None:
        """Report something. If the reader of the output has ended (`| head`), stop the fleet without more output."""
        if self._mute:
            return
        try:
            say(*what)
        except OSError:
            self._mute = True
            self._posted.append(lambda: self._do(self._plan.stop(self._now())))
