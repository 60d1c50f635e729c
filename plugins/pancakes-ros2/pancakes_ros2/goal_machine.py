"""What becomes of the goals of one action server: when each is sent and cancelled. Pure: events and a time go in.

A goal is wanted while fresh commands for it come. At most one is at work: the next one is sent when the one before has
ended. A goal that is not wanted any more is cancelled, again each second until it has ended, because nobody else would:
not even its task is there if its agent was killed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes_ros2.goal_packets import GoalState

SETTLED_S: Final = 0.3
"""After this time with a server it is known which goals of a former life it still works on."""
CANCEL_AGAIN_S: Final = 1.0
TELL_UNCANCELLED_S: Final = 3.0
"""A goal that has not ended this long after it was cancelled is told of."""
TELL_WAITING_S: Final = 3.0
ANSWER_S: Final = 5.0
"""A server that has not accepted or refused a goal for this long does not answer."""
RESULT_S: Final = 2.0
"""A goal that its server does not know has had its result, or never will."""
STAYS_S: Final = 60.0
"""For this long a goal is cancelled after the agent is gone."""

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
ENDS: Final[dict[int, GoalState]] = {SUCCEEDED: "succeeded", CANCELED: "canceled", ABORTED: "aborted"}
ACTIVE: Final = (1, 2, 3)
"""Of action_msgs/GoalStatus: accepted, executing, canceling."""
REJECTED, UNKNOWN, TERMINATED = 1, 2, 3
"""Return codes of action_msgs/CancelGoal: it does not cancel, it knows no such goal, the goal has ended."""

Key = tuple[str, int]
"""The address of the task that wants a goal, and the goal's number."""


# Effects ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Send:
    """Send a goal under an id."""

    id: bytes
    fields: dict[str, Any]


@dataclass(frozen=True)
class Cancel:
    """Ask the server to cancel a goal."""

    id: bytes


@dataclass(frozen=True)
class AskResult:
    """Ask the server once more for the result of a goal."""

    id: bytes


@dataclass(frozen=True)
class Tell:
    """Tell the task how its goal stands."""

    key: Key
    state: GoalState
    text: str = ""
    result: dict[str, Any] | None = None


@dataclass(frozen=True)
class Warn:
    """Tell people."""

    text: str


@dataclass(frozen=True)
class Leave:
    """There is nothing left to do, and nobody to do it for."""


Effect = Send | Cancel | AskResult | Tell | Warn | Leave


# State -----------------------------------------------------------------------------------------------------------


@dataclass
class _Wanted:
    key: Key
    fields: dict[str, Any] | None
    until_s: float
    since_s: float
    told_waiting: str = ""
    goal: dict[str, Any] | None = None  # what a cancelled one was

    def __post_init__(self) -> None:
        self.goal = self.fields


@dataclass
class _Cancelling:
    """When a goal was first asked to end, and when to ask it again."""

    since_s: float
    again_s: float
    told: bool = False


@dataclass
class _Flight:
    key: Key
    id: bytes
    fields: dict[str, Any]
    sent_s: float
    accepted: bool = False
    servers: frozenset[str] = frozenset()
    cancelling: _Cancelling | None = None
    result_due_s: float | None = None
    listed_as: GoalState | None = None


def _is_of(fields: dict[str, Any] | None, key: Key, command: _Wanted) -> bool:
    """Return whether a command is about a goal: a task that begins again may use a number once more."""
    return command.key == key and (command.fields is None or command.fields == fields)


@dataclass
class GoalMachine:
    """The goals of one action server.

    Args:
        name: the full name of the action, for people.
        mark: how the ids of its goals begin: those of a former life begin so as well.
        draw: returns the rest of a new id.
    """

    name: str
    mark: bytes
    draw: Callable[[], bytes]
    _wanted: _Wanted | None = None
    _flight: _Flight | None = None
    _ended: tuple[Tell, dict[str, Any] | None] | None = None
    _orphans: dict[bytes, _Cancelling] = field(default_factory=dict)
    _servers: frozenset[str] = frozenset()
    _ready_s: float | None = None
    _why_not: str = ""
    _alone_s: float | None = None

    # Events ------------------------------------------------------------------------------------------------------

    def want(self, key: Key, fields: dict[str, Any] | None, until_s: float, now_s: float) -> list[Effect]:
        """A command has come. It is good until a time; without fields, it cancels the goal."""
        if until_s <= now_s or self._alone_s is not None:
            return self._settle(now_s)
        command = _Wanted(key, fields, until_s, now_s)
        if self._ended is not None:
            told, ended = self._ended
            if _is_of(ended, told.key, command):
                self._wanted = None
                return [told, *self._settle(now_s)]  # its task may not have heard it
        before = self._wanted
        if before is not None and before.key == key:
            before.fields, before.until_s = fields, until_s
            before.goal = before.goal if fields is None else fields
        else:
            self._wanted = command
        return self._settle(now_s)

    def hold(self, now_s: float) -> list[Effect]:
        """No goal is wanted any more: its task has let go, or gives no commands."""
        self._wanted = self._ended = None
        return self._settle(now_s)

    def alone(self, now_s: float) -> list[Effect]:
        """The agent is gone."""
        if self._alone_s is None:
            self._wanted, self._alone_s = None, now_s
        return self._settle(now_s)

    def look(self, servers: Iterable[str], ready: bool, now_s: float, why_not: str = "") -> list[Effect]:
        """Time passes.

        Args:
            servers: what tells the servers of this action apart that are there.
            ready: whether one of them can be spoken to.
            now_s: the time.
            why_not: why that cannot be, if it is known.
        """
        self._servers, self._why_not = frozenset(servers), why_not
        if not ready:
            self._ready_s = None
        elif self._ready_s is None:
            self._ready_s = now_s
        return self._settle(now_s)

    def unsendable(self, id: bytes, text: str, now_s: float) -> list[Effect]:
        """A goal could not be sent, because it is none of that type."""
        return self._over(id, "refused", text, None, now_s)

    def answered(self, id: bytes, accepted: bool, now_s: float) -> list[Effect]:
        """The server has accepted or refused a goal."""
        flight = self._flight
        if not accepted:
            self._orphans.pop(id, None)
            return self._over(id, "refused", f"the server of {self.name} refuses it", None, now_s)
        if flight is None or flight.id != id:
            # It was given up: now it is known to run.
            self._orphans.setdefault(id, _Cancelling(now_s, now_s))
            return self._settle(now_s)
        flight.accepted, flight.servers = True, self._servers
        if flight.cancelling is not None:
            flight.cancelling.again_s = now_s  # what came before it was accepted had no effect
        told: list[Effect] = [AskResult(id)]
        if self._wants(flight):
            told.append(Tell(flight.key, "running"))
        return [*told, *self._settle(now_s)]

    def feedback(self, id: bytes) -> Key | None:
        """Feedback has come; returns whose it is; None: nobody wants it."""
        flight = self._flight
        return flight.key if flight is not None and flight.id == id and self._wants(flight) else None

    def result(self, id: bytes, status: int, result: dict[str, Any] | None, now_s: float) -> list[Effect]:
        """A goal has ended, with a status of action_msgs/GoalStatus; 0: the server does not know it."""
        self._orphans.pop(id, None)
        state = ENDS.get(status)
        if state is None:
            return self._lose(id, f"the server of {self.name} does not know its goal: it was restarted", now_s)
        return self._over(id, state, "", result, now_s)

    def cancel_answered(self, id: bytes, code: int, now_s: float) -> list[Effect]:
        """The server has answered a cancellation, with a return code of action_msgs/CancelGoal."""
        if code in (UNKNOWN, TERMINATED):
            self._orphans.pop(id, None)
            flight = self._flight
            if flight is not None and flight.id == id and flight.accepted and flight.result_due_s is None:
                flight.result_due_s = now_s + RESULT_S
        return self._settle(now_s)

    def listed(self, goals: Iterable[tuple[bytes, int]], now_s: float) -> list[Effect]:
        """The server tells which goals it knows, with a status of each."""
        for id, status in goals:
            flight = self._flight
            if status not in ACTIVE:
                self._orphans.pop(id, None)
                if flight is not None and flight.id == id and flight.accepted:
                    flight.listed_as = ENDS.get(status)
                    flight.result_due_s = flight.result_due_s or now_s + RESULT_S
            elif flight is not None and flight.id == id:
                continue
            elif id.startswith(self.mark) and self._alone_s is None:
                # Without an agent it may be one of the next life, which has a keeper of its own.
                self._orphans.setdefault(id, _Cancelling(now_s, now_s))
        return self._settle(now_s)

    # What follows ------------------------------------------------------------------------------------------------

    def _wants(self, flight: _Flight) -> bool:
        wanted = self._wanted
        return wanted is not None and wanted.fields is not None and _is_of(flight.fields, flight.key, wanted)

    def _over(self, id: bytes, state: GoalState, text: str, result: Any, now_s: float) -> list[Effect]:
        flight = self._flight
        if flight is None or flight.id != id:
            return self._settle(now_s)
        self._flight = None
        wanted = self._wanted
        if wanted is None or not _is_of(flight.fields, flight.key, wanted):
            return [Tell(flight.key, "held", text, result), *self._settle(now_s)]
        if wanted.fields is not None and flight.cancelling is not None and state != "succeeded":
            # It was cancelled while no command came, and is wanted again by now.
            return [Tell(flight.key, "held", text, result), *self._settle(now_s)]
        told = Tell(flight.key, state, text, result)
        self._wanted, self._ended = None, (told, flight.fields)
        return [told, *self._settle(now_s)]

    def _settle(self, now_s: float) -> list[Effect]:
        """Return what to do now that something has changed."""
        if self._wanted is not None and now_s >= self._wanted.until_s:
            self._wanted = None
        effects = self._check_flight(now_s)
        for id, cancelling in self._orphans.items():
            effects += self._cancel(id, cancelling, now_s)
        wanted = self._wanted
        if self._flight is None and wanted is not None:
            if wanted.fields is None:
                told = Tell(wanted.key, "canceled")
                self._wanted, self._ended = None, (told, wanted.goal)
                effects.append(told)
            elif why := self._obstacle(now_s):
                if now_s - wanted.since_s >= TELL_WAITING_S and why != wanted.told_waiting:
                    wanted.told_waiting = why
                    effects += [Tell(wanted.key, "waiting", why), Warn(why)]
            elif self._ready_s is not None and now_s - self._ready_s >= SETTLED_S:
                id = self.mark + self.draw()
                self._flight, self._ended = _Flight(wanted.key, id, wanted.fields, now_s), None
                effects.append(Send(id, wanted.fields))
        elif (
            self._flight is not None
            and wanted is not None
            and not _is_of(self._flight.fields, self._flight.key, wanted)
        ):
            why = f"the goal before it at {self.name} has not ended"
            if now_s - wanted.since_s >= TELL_WAITING_S and why != wanted.told_waiting:
                wanted.told_waiting = why
                effects.append(Tell(wanted.key, "waiting", why))
        if self._alone_s is not None:
            idle = self._flight is None and not self._orphans
            if idle or now_s - self._alone_s >= STAYS_S:
                effects.append(Leave())
        return effects

    def _obstacle(self, now_s: float) -> str:
        if self._ready_s is None:
            absent = f"there is no action server {self.name}: start it, or name the one that the robot has"
            return self._why_not or absent
        if self._orphans:
            return f"the server of {self.name} still works on a goal of before, which was cancelled"
        return ""

    def _check_flight(self, now_s: float) -> list[Effect]:
        flight = self._flight
        if flight is None:
            return []
        if flight.accepted and flight.servers.isdisjoint(self._servers):
            return self._lose(flight.id, f"the server of {self.name} is gone", now_s)
        effects: list[Effect] = []
        if flight.accepted and not flight.servers <= self._servers:
            # One of several has gone, and it may have been this goal's.
            flight.servers &= self._servers
            effects.append(AskResult(flight.id))
        if not flight.accepted and now_s - flight.sent_s >= ANSWER_S:
            return self._lose(flight.id, f"the server of {self.name} does not answer", now_s)
        if flight.result_due_s is not None and now_s >= flight.result_due_s:
            why = f"the server of {self.name} gives no result of it"
            if flight.listed_as is not None:
                return self._over(flight.id, flight.listed_as, why, None, now_s)
            return self._lose(flight.id, why, now_s)
        if not self._wants(flight):
            flight.cancelling = flight.cancelling or _Cancelling(now_s, now_s)
        if flight.cancelling is not None:
            effects += self._cancel(flight.id, flight.cancelling, now_s)
        return effects

    def _lose(self, id: bytes, why: str, now_s: float) -> list[Effect]:
        """Nothing more is heard of a goal. It may be worked on all the same, so it is cancelled until that is known."""
        if self._flight is None or self._flight.id != id:
            return self._settle(now_s)
        self._orphans[id] = _Cancelling(now_s, now_s)
        return [Warn(why), *self._over(id, "lost", why, None, now_s)]

    def _cancel(self, id: bytes, cancelling: _Cancelling, now_s: float) -> list[Effect]:
        effects: list[Effect] = []
        if now_s >= cancelling.again_s:
            cancelling.again_s = now_s + CANCEL_AGAIN_S
            effects.append(Cancel(id))
        if not cancelling.told and now_s - cancelling.since_s >= TELL_UNCANCELLED_S:
            cancelling.told = True
            effects.append(
                Warn(f"the server of {self.name} does not end a goal that was cancelled: the robot may still move")
            )
        return effects
