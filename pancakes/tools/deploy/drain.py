"""Drain an agent before its restart: its tasks migrate to neighbours, and come back afterwards.

`Steadiness` is pure: it decides whether the tasks run as they should after the restart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.client import Client, TaskRow, Where
from pancakes.control import Describe, Start
from pancakes.errors import PancakesError
from pancakes.util.clock import MonotonicClock

GOOD: Final = frozenset({"running", "stopped"})
"""A task that is stopped was told so, or is elsewhere: that is for its agent to know."""
HOPELESS: Final = frozenset({"failed", "stuck"})
GIVEN_UP: Final = "failed"
"""Why a task rests that was given up in an earlier life of its agent; its state is `stopped` then."""


@dataclass
class Steadiness:
    """Look at an agent's tasks until they have run for a while.

    Args:
        before: the states of its tasks before, by name; what did not run then need not now.
        calm_s: so long nothing may have begun again.
    """

    before: Mapping[str, str]
    calm_s: float
    _seen: dict[str, int] = field(default_factory=dict)
    _since_s: float | None = None

    def look(self, tasks: Sequence[TaskRow], now_s: float) -> bool:
        """Take how they are; return whether they have run for long enough."""
        seen = {str(row): row.incarnation for row in tasks}
        if self.faults(tasks) or seen != self._seen:
            self._since_s = None if self.faults(tasks) else now_s
            self._seen = seen
            return False
        self._since_s = now_s if self._since_s is None else self._since_s
        return now_s - self._since_s >= self.calm_s

    def faults(self, tasks: Sequence[TaskRow]) -> list[str]:
        """Return a clause for each task that does not run, and did before, or is new."""
        return [
            f"{row.service}/{row.task} is {_state(row)}" + (f": {row.reason}" if row.reason else "")
            for row in tasks
            if _state(row) not in GOOD and self._ran(row)
        ]

    def is_hopeless(self, tasks: Sequence[TaskRow]) -> bool:
        """Return whether one of them has been given up."""
        return any(_state(row) in HOPELESS and self._ran(row) for row in tasks)

    def _ran(self, row: TaskRow) -> bool:
        return self.before.get(f"{row.service}/{row.task}", "running") in GOOD


def is_given_up(row: TaskRow) -> bool:
    """Return whether a task was given up, now or in an earlier life of its agent."""
    return _state(row) == GIVEN_UP


def _state(row: TaskRow) -> str:
    return GIVEN_UP if row.rest == GIVEN_UP else row.state


ANSWER_S: Final = 10.0
SOON_S: Final = 5.0
"""So long an agent that is ready again may take until its neighbours are linked to it, and its tasks are back."""
BACK_S: Final = 20.0
"""So long it may take at the end, when all agents have their versions."""
SETTLE_S: Final = 60.0
"""So long the tasks of an agent may take until all of them run."""
LOOK_S: Final = 0.5
HOSTED: Final = "client"
"""The service that has the tasks which can move."""
RECORDER: Final = "log/Recorder"
RUNNING: Final = ("running", "starting", "restarting")
AWAY: Final = ("moved", "forgotten", "disputed")
"""How the reasons begin for which a task rests that is not for this agent to start."""


@dataclass(frozen=True)
class MovedTask:
    """A task that is away from its agent.

    Attributes:
        task: its name.
        home: the agent that it belongs to.
        at: the agent that has it now.
    """

    task: str
    home: str
    at: str


@dataclass(frozen=True)
class AgentBefore:
    """How an agent was before it was restarted.

    Attributes:
        states: the states of its tasks, as `SERVICE/TASK`.
        recorder: the settings of its recording; None: it recorded nothing.
    """

    states: Mapping[str, str] = field(default_factory=dict)
    recorder: Mapping[str, Any] | None = None

    def ran(self, row: TaskRow) -> bool:
        """Return whether a task ran, or was about to."""
        return self.states.get(_name(row)) in RUNNING


class TaskMoves:
    """Move tasks, and look how they are.

    Args:
        ways: the address of each agent of the fleet that can be reached from here, by name.
        fleet: their fleet.
        tell: takes a clause about an agent, to be read after its name.
    """

    def __init__(self, ways: Mapping[str, str], fleet: str, tell: Callable[[str, str], None]) -> None:
        self._ways = ways
        self._fleet = fleet
        self._tell = tell
        self._moved: list[MovedTask] = []
        self._now = MonotonicClock().now

    def tasks(self, agent: str) -> list[TaskRow]:
        """Return the tasks of an agent.

        Raises:
            PancakesError: it does not answer.
        """
        with self._client(agent) as client:
            return client.tasks(agent)

    def look(self, agent: str) -> AgentBefore:
        """Return how an agent is, so that `run_again` can make it so once more; empty if it does not answer."""
        try:
            with self._client(agent) as client:
                states = {_name(row): row.state for row in client.tasks(agent)}
                told = client.request(agent, Describe(RECORDER)) if states.get(RECORDER) == "running" else None
        except PancakesError as error:
            self._tell(agent, f"does not say what runs on it: {error}")
            return AgentBefore()
        return AgentBefore(states, told.result["settings"] if told is not None and told.ok else None)

    def given_up(self, agent: str) -> list[str]:
        """Return a clause for each task of an agent that was given up; none if it does not answer."""
        try:
            rows = self.tasks(agent)
        except PancakesError:
            return []
        return [
            f"{_name(row)} was given up" + (f": {row.reason}" if row.reason else "")
            for row in filter(is_given_up, rows)
        ]

    def run_again(self, agent: str, before: AgentBefore, only_those: bool) -> None:
        """Start tasks that an agent does not start by itself; say which do not start.

        Args:
            agent: the agent, which has been restarted.
            before: how it was.
            only_those: whether only what ran then is started, and that however it ended; otherwise what was given up,
                because it has another version now.
        """
        for row in self._answering(agent):
            if row.state in RUNNING or row.rest.startswith(AWAY):
                continue
            if not (before.ran(row) if only_those else is_given_up(row)):
                continue
            settings = before.recorder if _name(row) == RECORDER else None
            try:
                with self._client(agent) as client:
                    reply = client.request(agent, Start(_name(row), settings))
            except PancakesError as error:
                self._tell(agent, f"does not start {row.task}: {error}")
                continue
            if reply.ok:
                self._tell(agent, f"runs {row.task} again")
            else:
                self._tell(agent, f"does not start {row.task}: {reply.reason}")

    def _answering(self, agent: str) -> list[TaskRow]:
        """Return the tasks of an agent that has just been started, as soon as it answers."""
        until_s = self._now() + ANSWER_S
        with self._client(agent) as client:
            while True:
                try:
                    return client.tasks(agent)
                except PancakesError as error:
                    if self._now() >= until_s:
                        self._tell(agent, f"does not say what runs on it: {error}")
                        return []
                client.wait(lambda: False, LOOK_S)

    def movable(self, agent: str) -> list[tuple[str, str]]:
        """Return the running tasks that could move, each with the agent that would take it now; empty: none would."""
        found = []
        for row in self._hosted(agent):
            with self._client(agent) as client:
                try:
                    found.append((row.task, client.migrate(row, dry_run=True, timeout_s=ANSWER_S).winner))
                except PancakesError:
                    found.append((row.task, ""))
        return found

    def away(self, agent: str) -> None:
        """Move the running tasks of an agent to its neighbours, if these can take them; say which stay.

        Those of others that wait there move on, and go home from where they are then.
        """
        for row in self._hosted(agent):
            guest = next((it for it in self._moved if (it.task, it.at) == (row.task, agent)), None)
            try:
                with self._client(agent) as client:
                    ledger = client.migrate(row)
            except PancakesError as error:
                self._tell(agent, f"keeps {row.task} while it is restarted: {error}")
                continue
            self._tell(agent, f"gives {row.task} to {ledger.winner}")
            if guest is not None:
                self._moved.remove(guest)
            home = guest.home if guest is not None else agent
            if home != ledger.winner:
                self._moved.append(MovedTask(row.task, home, ledger.winner))

    def back(self, agent: str, within_s: float = SOON_S) -> None:
        """Move tasks back to an agent that runs again.

        One that is refused waits where it is: tasks move between equal versions alone.
        """
        until_s = self._now() + within_s
        for it in [it for it in self._moved if it.home == agent]:
            if it.at not in self._ways:
                self._moved.remove(it)
                self._tell(agent, f"does not get {it.task} back: {it.at} has no host in the fleet file")
            elif not (fault := self._back(it, until_s)):
                self._moved.remove(it)
                self._tell(agent, f"gets {it.task} back from {it.at}")
            elif within_s > SOON_S:
                self._moved.remove(it)
                self._tell(agent, f"does not get {it.task} back from {it.at}: {fault}")

    def all_back(self) -> None:
        """Move all tasks back that are still away, once all agents run; say which stay away."""
        for agent in dict.fromkeys(it.home for it in self._moved):
            self.back(agent, BACK_S)

    def settle(
        self, agent: str, before: Mapping[str, str], calm_s: float, called_off: Callable[[], bool] = lambda: False
    ) -> str:
        """Wait until the tasks of an agent run; return what is wrong, empty: nothing.

        Args:
            agent: the agent.
            before: the states of its tasks before, by name.
            calm_s: so long they have to run without one beginning from scratch.
            called_off: returns whether to wait no more.
        """
        steadiness, until_s = Steadiness(before, calm_s), self._now() + SETTLE_S
        with self._client(agent) as client:
            while not called_off():
                try:
                    tasks = client.tasks(agent)
                except PancakesError as error:
                    if self._now() >= until_s:
                        return str(error)
                    client.wait(lambda: False, LOOK_S)
                    continue
                if steadiness.look(tasks, self._now()):
                    return ""
                if steadiness.is_hopeless(tasks) or self._now() >= until_s:
                    return "; ".join(steadiness.faults(tasks)) or "its tasks begin again and again"
                client.wait(lambda: False, LOOK_S)
        return ""

    def _hosted(self, agent: str) -> list[TaskRow]:
        try:
            return [row for row in self.tasks(agent) if row.service == HOSTED and row.state == "running"]
        except PancakesError as error:
            self._tell(agent, f"is not asked for its tasks: {error}")
            return []

    def _back(self, it: MovedTask, until_s: float) -> str:
        """Move a task home; return why not, empty: it is there."""
        with self._client(it.at) as client:
            while True:
                try:
                    client.migrate(f"{it.at}/{HOSTED}/{it.task}", it.home)
                    return ""
                except PancakesError as error:
                    if self._now() >= until_s:
                        return str(error)
                client.wait(lambda: False, LOOK_S)

    def _client(self, agent: str) -> Client:
        return Client(Where((self._ways[agent],), self._fleet), ANSWER_S, lambda text: None)


def _name(row: TaskRow) -> str:
    return f"{row.service}/{row.task}"
