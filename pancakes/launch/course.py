"""The course of a launched fleet: when each agent starts, starts again, and ends. Pure: events in, actions out.

An agent is started once those that it comes after are ready. What ends by itself is started again as its policy says,
within its limits, or given up. On the way down an agent is told to end once those that come after it have ended.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from signal import Signals
from types import MappingProxyType
from typing import Final

from pancakes.launch.member import Member, ProcessRestart
from pancakes.supervision import Next, RestartSpec, Supervision

READY_S: Final = 30.0
"""An agent that is not ready after so long is named, in seconds."""
END_S: Final = 2.5
"""An agent that was told to end is killed after so long; it ends itself sooner even where a task is stuck."""
ALL_END_S: Final = 5.0
"""So long after it was told to stop, whatever still runs is killed."""
BAD_CONFIGURATION: Final = 4
"""The exit code of an agent that would end in the same way each time."""

_POLICIES: Final = {"never": "temporary", "on-failure": "transient", "always": "permanent"}


@dataclass(frozen=True, slots=True)
class Spawn:
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
class Begin:
    """Let the mission of these agents begin, which they hold at 0."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Tell:
    """Tell the person what has become of an agent.

    Attributes:
        name: the agent; empty where it is about the fleet.
        event: what happened, in a word for programs.
        text: the same as a phrase for people, to be read after the agent's name.
    """

    name: str
    event: str
    text: str


Action = Spawn | Terminate | Kill | Begin | Tell


class State(Enum):
    """How far an agent is."""

    WAITING = "waiting"
    STARTING = "starting"
    RESTARTING = "restarting"
    READY = "ready"
    ENDED = "ended"


class _Place:
    """What the course knows of one agent."""

    def __init__(self, member: Member) -> None:
        self.member = member
        self.state = State.WAITING
        self.supervision = Supervision(_spec(member.restart))
        self.started_s = 0.0
        self.late = False
        self.kill_s: float | None = None
        self.killed = False

    @property
    def runs(self) -> bool:
        return self.state in (State.STARTING, State.READY)


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

    @property
    def over(self) -> bool:
        """Whether nothing runs any more, nor will."""
        return all(place.state is State.ENDED for place in self._places.values())

    @property
    def exit_code(self) -> int:
        """0; 1 where an agent was given up, or never started."""
        return int(self._failed)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` is due; None where nothing is waited for."""
        times = [place.kill_s for place in self._places.values() if place.runs and place.kill_s is not None]
        for place in self._places.values():
            if place.state is State.STARTING and not place.late:
                times.append(place.started_s + READY_S)
            if place.supervision.due_s is not None:
                times.append(place.supervision.due_s)
        if self._stopping_s is not None and any(it.runs and not it.killed for it in self._places.values()):
            times.append(self._stopping_s + ALL_END_S)
        return min(times, default=None)

    def start(self, now_s: float) -> list[Action]:
        """Begins."""
        return self._start_who_can(now_s)

    def unstartable(self, name: str, reason: str, now_s: float) -> list[Action]:
        """A process could not be made, for a reason that is a phrase."""
        place = self._places[name]
        place.state = State.ENDED
        self._failed = True
        return [Tell(name, "given_up", f"cannot be started: {reason}"), *self._follow(now_s)]

    def ready(self, name: str, now_s: float, rests: Mapping[str, str] = MappingProxyType({})) -> list[Action]:
        """An agent says that all which should run at its start does.

        Args:
            name: the agent.
            now_s: the time.
            rests: those of its tasks that do not start because of what happened when it ran before, and why.
        """
        place = self._places[name]
        if place.state is not State.STARTING:
            return []
        place.state = State.READY
        place.supervision.runs(now_s)
        if self._stopping_s is not None:
            return []
        told = [Tell(name, "ready", "is ready")]
        told += [Tell(name, "rests", f"does not start {task}: {why}") for task, why in rests.items()]
        return [*told, *self._begin_again(place), *self._start_who_can(now_s), *self._begin_if_all_are_ready()]

    def ended(self, name: str, code: int, now_s: float) -> list[Action]:
        """A process has ended.

        Args:
            name: the agent.
            code: its exit code; minus the number of the signal that ended it.
            now_s: the time.
        """
        place = self._places[name]
        how = _how(code)
        if self._stopping_s is not None:
            place.state = State.ENDED
            how += ", killed because it took too long" if place.killed else ""
            return [Tell(name, "ended", f"has ended ({how})"), *self._stop_who_can(now_s)]
        restart = place.member.restart
        supervision = place.supervision
        following = supervision.ended(code != 0, now_s, self._source, hopeless=code == BAD_CONFIGURATION)
        if following is Next.RESTART:
            place.state = State.RESTARTING
            return [Tell(name, "restarted", f"has ended ({how}) and is started again {supervision.when(now_s)}")]
        place.state = State.ENDED
        if following is Next.REST:
            return [Tell(name, "ended", f"has ended ({how})"), *self._follow(now_s)]
        self._failed = True
        why = ""
        if restart.policy != "never" and code != BAD_CONFIGURATION:
            why = f" after {restart.at_most} restarts within {restart.within_s:g} s"
        return [Tell(name, "given_up", f"has ended ({how}) and is given up{why}"), *self._follow(now_s)]

    def stop(self, now_s: float) -> list[Action]:
        """A person wants an end; who says so for the second time does not want to wait."""
        if self._stopping_s is not None:
            return self._kill(place for place in self._places.values() if place.runs)
        self._stopping_s = now_s
        for place in self._places.values():
            if place.state in (State.WAITING, State.RESTARTING):
                place.supervision.cancel()
                place.state = State.ENDED
        return self._stop_who_can(now_s)

    def tick(self, now_s: float) -> list[Action]:
        """Time has passed."""
        actions: list[Action] = []
        for place in self._places.values():
            due_s = place.supervision.due_s
            if due_s is not None and now_s >= due_s:
                actions += self._spawn(place, now_s)
            if place.state is State.STARTING and not place.late and now_s >= place.started_s + READY_S:
                place.late = True
                actions.append(Tell(place.member.name, "late", f"is not ready after {READY_S:g} s"))
        too_late = self._stopping_s is not None and now_s >= self._stopping_s + ALL_END_S
        overdue = [
            place
            for place in self._places.values()
            if place.runs and not place.killed and (too_late or (place.kill_s is not None and now_s >= place.kill_s))
        ]
        return [*actions, *self._kill(overdue)]

    # Starting --------------------------------------------------------------------------------------------------

    def _start_who_can(self, now_s: float) -> list[Action]:
        return [
            action
            for place in self._places.values()
            if place.state is State.WAITING
            and all(self._places[other].state is State.READY for other in place.member.after)
            for action in self._spawn(place, now_s)
        ]

    def _spawn(self, place: _Place, now_s: float) -> list[Action]:
        place.supervision.cancel()
        place.state = State.STARTING
        place.started_s = now_s
        place.late = False
        return [Spawn(place.member.name)]

    def _follow(self, now_s: float) -> list[Action]:
        """What follows where an agent has ended for good: who waits for it will never start."""
        actions: list[Action] = []
        lost = True
        while lost:
            lost = False
            for place in self._places.values():
                gone = [other for other in place.member.after if self._places[other].state is State.ENDED]
                if place.state is State.WAITING and gone:
                    place.state = State.ENDED
                    self._failed = lost = True
                    told = f"is not started: {gone[0]}, which it comes after, has ended"
                    actions.append(Tell(place.member.name, "given_up", told))
        if self._begin and not self._begun and any(place.runs for place in self._places.values()) and self._held():
            self._begin = False
            actions.append(Tell("", "held", "the mission does not begin: not all agents of the fleet run"))
        return actions

    def _held(self) -> list[str]:
        return [name for name, place in self._places.items() if place.member.config.clock.hold]

    def _begin_if_all_are_ready(self) -> list[Action]:
        if not self._begin or self._begun or any(it.state is not State.READY for it in self._places.values()):
            return []
        self._begun = True
        held = tuple(self._held())
        return [Begin(held)] if held else []

    def _begin_again(self, place: _Place) -> list[Action]:
        """An agent that was started again holds its mission once more, while that of the others goes on."""
        return [Begin((place.member.name,))] if self._begun and place.member.config.clock.hold else []

    # Stopping --------------------------------------------------------------------------------------------------

    def _stop_who_can(self, now_s: float) -> list[Action]:
        """Tells those to end that no running agent comes after, the last that was started first."""
        actions: list[Action] = []
        for name, place in reversed(self._places.items()):
            later = any(other.runs and name in other.member.after for other in self._places.values())
            if place.runs and place.kill_s is None and not place.killed and not later:
                place.kill_s = now_s + END_S
                actions.append(Terminate(name))
        return actions

    def _kill(self, places: Iterable[_Place]) -> list[Action]:
        actions: list[Action] = []
        for place in places:
            place.killed = True
            place.kill_s = None
            actions.append(Kill(place.member.name))
        return actions


def _spec(restart: ProcessRestart) -> RestartSpec:
    policy = _POLICIES[restart.policy]
    return RestartSpec(policy, restart.at_most, restart.within_s, restart.pause_s, restart.pause_max_s)  # type: ignore[arg-type]


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"ended by {Signals(-code).name}"
    except ValueError:  # a real-time signal has no name
        return f"ended by the signal {-code}"
