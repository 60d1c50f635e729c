"""The course of a launched fleet: when each agent starts, starts again, and ends. Pure: events in, actions out.

An agent is started once those that it comes after are ready. What ends by itself is started again as its policy says,
within its limits, or given up. On the way down an agent is told to end once those that come after it have ended.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from signal import Signals
from types import MappingProxyType
from typing import Final, assert_never

from pancakes.runtime.life.life import Life, State
from pancakes.runtime.life.life_effect import (
    Answer,
    AskLeave,
    LetGo,
    LookAgain,
    News,
    Revoke,
    Settle,
    Spawn,
    Tell,
    TellToEnd,
    TryAt,
    WriteRest,
)
from pancakes.runtime.life.life_event import (
    Admitted,
    Began,
    Event,
    Finished,
    LeaveRefused,
    Overdue,
    StartAsked,
    StopAsked,
    TryDue,
)
from pancakes.runtime.life.restart import Restarts, RestartSpec
from pancakes.runtime.life.table import handle
from pancakes.tools.launch.member import Member, ProcessRestart

READY_S: Final = 30.0
"""An agent that is not ready after so long is named, in seconds."""
END_S: Final = 2.5
"""An agent that was told to end is killed after so long; it ends itself sooner even where a task is stuck."""
ALL_END_S: Final = 5.0
"""So long after it was told to stop, whatever still runs is killed."""
BAD_CONFIGURATION: Final = 4
"""The exit code of an agent that would end in the same way each time."""


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
    """Let the mission of these agents begin, which they hold at 0."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TellPerson:
    """Tell the person what has become of an agent.

    Attributes:
        name: the agent; empty where it is about the fleet.
        event: what happened, in a word for programs.
        text: the same as a phrase for people, to be read after the agent's name.
    """

    name: str
    event: str
    text: str


Action = SpawnProcess | Terminate | Kill | BeginMission | TellPerson


class _Place:
    """What the course knows of one agent.

    Attributes:
        life: how far its process is.
        how: how its process has ended, as a phrase; empty: it has not, or people know.
        kill_s: when it is killed, once it was told to end.
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


class Course:
    """The course of one fleet.

    Args:
        members: its agents, in the order in which they are to start.
        begin: whether missions that wait at 0 are let begin once all agents are ready.
        source: the pauses before restarts are drawn with it; None: with one of its own.
    """

    def __init__(self, members: Sequence[Member], begin: bool = True, source: random.Random | None = None) -> None:
        self._places = {member.name: _Place(member) for member in members}
        self._begin = begin
        self._source = source or random.Random()
        self._begun = False
        self._stopping_s: float | None = None
        self._failed = False
        self._actions: list[Action] = []

    @property
    def over(self) -> bool:
        """Whether nothing runs any more, nor will."""
        return all(place.over for place in self._places.values())

    @property
    def exit_code(self) -> int:
        """0; 1 where an agent was given up, or never started."""
        return int(self._failed)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` is due; None where nothing is waited for."""
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
        """Begins."""
        for place in self._places.values():
            self._feed(place, StartAsked(), now_s)
        self._admit(now_s)
        return self._done()

    def unstartable(self, name: str, reason: str, now_s: float) -> list[Action]:
        """A process could not be made, for a reason that is a phrase."""
        self._failed = True
        self._feed(self._places[name], Finished(f"cannot be started: {reason}", True, hopeless=True), now_s)
        self._give_up_followers(now_s)
        return self._done()

    def ready(self, name: str, now_s: float, rests: Mapping[str, str] = MappingProxyType({})) -> list[Action]:
        """An agent says that all which should run at its start does.

        Args:
            name: the agent.
            now_s: the time.
            rests: those of its tasks that do not start because of what happened when it ran before, and why.
        """
        place = self._places[name]
        if place.life.state is not State.STARTING:
            return []
        self._feed(place, Began(), now_s)
        if self._stopping_s is None:
            for task, why in rests.items():
                self._tell(name, "rests", f"does not start {task}: {why}")
            if self._begun and place.member.config.clock.hold:
                # An agent that was started again holds its mission once more, while that of the others goes on.
                self._actions.append(BeginMission((name,)))
            self._admit(now_s)
            self._begin_if_all_are_ready()
        return self._done()

    def ended(self, name: str, code: int, now_s: float, how: str = "") -> list[Action]:
        """A process has ended.

        Args:
            name: the agent.
            code: its exit code; minus the number of the signal that ended it.
            now_s: the time.
            how: the same as a phrase, where the exit code does not say it.
        """
        place = self._places[name]
        stopping = self._stopping_s is not None
        place.how = (how or _how(code)) + (", killed because it took too long" if place.killed else "")
        failed = code != 0 and not stopping
        story = f"has ended ({place.how})"
        self._feed(place, Finished(story, failed, code == BAD_CONFIGURATION, closing=stopping), now_s)
        if stopping:
            self._stop_next(now_s)
        elif place.over:
            self._give_up_followers(now_s)
        return self._done()

    def stop(self, now_s: float) -> list[Action]:
        """A person wants an end; one that says so for the second time does not want to wait."""
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
        """Time has passed."""
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
        """Starts the agents that wait and come after none that is not ready."""
        for place in self._places.values():
            if place.life.state is State.CALLED_OFF:
                self._feed(place, LeaveRefused("the fleet ends"), now_s)
            elif place.waits and all(self._places[other].ready for other in place.member.after):
                self._feed(place, Admitted(), now_s)

    def _give_up_followers(self, now_s: float) -> None:
        """An agent has ended for good: those that come after it will never start."""
        lost = True
        while lost:
            lost = False
            for place in self._places.values():
                gone = [other for other in place.member.after if self._places[other].over]
                if place.waits and gone:
                    self._failed = lost = True
                    self._feed(place, LeaveRefused(f"{gone[0]}, which it comes after, has ended", for_good=True), now_s)
                    told = f"is not started: {gone[0]}, which it comes after, has ended"
                    self._tell(place.member.name, "given_up", told)
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
        """Tells those to end that no running agent comes after, the last that was started first."""
        for name, place in reversed(self._places.items()):
            later = any(other.runs and name in other.member.after for other in self._places.values())
            if place.life.state in (State.STARTING, State.RUNNING) and not later:
                place.kill_s = now_s + END_S
                self._actions.append(Terminate(name))
                self._feed(place, StopAsked(), now_s)

    def _kill(self, places: Iterable[_Place], now_s: float) -> None:
        for place in places:
            if not place.killed:
                self._feed(place, StopAsked(), now_s)
                self._feed(place, Overdue(place.life.incarnation), now_s)

    # What a life asks for --------------------------------------------------------------------------------------

    def _feed(self, place: _Place, event: Event, now_s: float) -> None:
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
                # The course looks itself at what is due, and at what has ended (`tick`, `_admit`, `_stop_next`).
                case AskLeave() | TellToEnd() | LetGo() | TryAt() | LookAgain() | Settle() | WriteRest() | Answer():
                    pass
                case _:
                    assert_never(effect)

    def _tell_life(self, place: _Place, effect: Tell, now_s: float) -> None:
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
