"""Drain an agent before its restart: its tasks migrate to neighbours, and come back afterwards.

`Steadiness` is pure: it decides whether the tasks run well after the restart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.client import Client, Target, TaskInfo
from pancakes.control import Describe, Start
from pancakes.errors import PancakesError
from pancakes.util.clock import MonotonicClock

GOOD: Final = frozenset({"running", "stopped"})
"""States that are fine after a restart. A stopped task was stopped on purpose, or has migrated."""
HOPELESS: Final = frozenset({"failed", "stuck"})
GIVEN_UP: Final = "failed"
"""The `rest` of a task that was given up in an earlier run of its agent; its state is then `stopped`."""


@dataclass
class Steadiness:
    """Watch the tasks of an agent until they have run undisturbed for a while.

    Args:
        before: the states of its tasks before the restart, by name; a task that did not run then need not run now.
        calm_s: how long all tasks must run without a restart, in seconds.
    """

    before: Mapping[str, str]
    calm_s: float
    _seen: dict[str, int] = field(default_factory=dict)
    _since_s: float | None = None

    def look(self, tasks: Sequence[TaskInfo], now_s: float) -> bool:
        """Take the present tasks; return whether they have run undisturbed for long enough."""
        seen = {str(row): row.incarnation for row in tasks}
        if self.faults(tasks) or seen != self._seen:
            self._since_s = None if self.faults(tasks) else now_s
            self._seen = seen
            return False
        self._since_s = now_s if self._since_s is None else self._since_s
        return now_s - self._since_s >= self.calm_s

    def faults(self, tasks: Sequence[TaskInfo]) -> list[str]:
        """Return a clause for each task that does not run although it ran before, or is new."""
        return [
            f"{row.service}/{row.task} is {_state(row)}" + (f": {row.reason}" if row.reason else "")
            for row in tasks
            if _state(row) not in GOOD and self._ran(row)
        ]

    def is_hopeless(self, tasks: Sequence[TaskInfo]) -> bool:
        """Return whether a task has been given up, so that waiting is useless."""
        return any(_state(row) in HOPELESS and self._ran(row) for row in tasks)

    def _ran(self, row: TaskInfo) -> bool:
        return self.before.get(f"{row.service}/{row.task}", "running") in GOOD


def is_given_up(row: TaskInfo) -> bool:
    """Return whether a task was given up, now or in an earlier run of its agent."""
    return _state(row) == GIVEN_UP


def _state(row: TaskInfo) -> str:
    return GIVEN_UP if row.rest == GIVEN_UP else row.state


ANSWER_S: Final = 10.0
SOON_S: Final = 5.0
"""How long tasks may take to come back to a restarted agent, in seconds, including the time to connect it."""
BACK_S: Final = 20.0
"""The same at the end, when all agents have their new versions."""
SETTLE_S: Final = 60.0
"""How long all tasks of an agent may take to run, in seconds."""
LOOK_S: Final = 0.5
HOSTED: Final = "client"
"""The service whose tasks can migrate."""
RECORDER: Final = "log/Recorder"
RUNNING: Final = ("running", "starting", "restarting")
AWAY: Final = ("moved", "forgotten", "disputed")
"""How `rest` begins for a task that this agent must not start."""


@dataclass(frozen=True)
class MovedTask:
    """A task that is away from its agent.

    Attributes:
        task: its name.
        home: the agent that it belongs to.
        at: the agent that runs it now.
    """

    task: str
    home: str
    at: str


@dataclass(frozen=True)
class AgentBefore:
    """The tasks of an agent before its restart.

    Attributes:
        states: the states of its tasks, by `SERVICE/TASK`.
        recorder: the settings of its recorder; None: it did not record.
    """

    states: Mapping[str, str] = field(default_factory=dict)
    recorder: Mapping[str, Any] | None = None

    def ran(self, row: TaskInfo) -> bool:
        """Return whether a task ran, or was about to."""
        return self.states.get(_name(row)) in RUNNING


class TaskMoves:
    """Migrate the tasks of a fleet away and back, and check them.

    Args:
        addresses: the address of each agent of the fleet that can be reached from here, by name.
        fleet: their fleet.
        tell: reports a clause about an agent, to be read after its name.
    """

    def __init__(self, addresses: Mapping[str, str], fleet: str, tell: Callable[[str, str], None]) -> None:
        self._addresses = addresses
        self._fleet = fleet
        self._tell = tell
        self._moved: list[MovedTask] = []
        self._now = MonotonicClock().now

    def tasks(self, agent: str) -> list[TaskInfo]:
        """Return the tasks of an agent.

        Raises:
            PancakesError: the agent does not answer.
        """
        with self._client(agent) as client:
            return client.tasks(agent)

    def look(self, agent: str) -> AgentBefore:
        """Return the present tasks of an agent, for a later `run_again`; empty if it does not answer."""
        try:
            with self._client(agent) as client:
                states = {_name(row): row.state for row in client.tasks(agent)}
                recorder = client.request(agent, Describe(RECORDER)) if states.get(RECORDER) == "running" else None
        except PancakesError as error:
            self._tell(agent, f"does not report its tasks: {error}")
            return AgentBefore()
        return AgentBefore(states, recorder.result["settings"] if recorder is not None and recorder.ok else None)

    def given_up(self, agent: str) -> list[str]:
        """Return a clause for each task of an agent that was given up; empty if the agent does not answer."""
        try:
            rows = self.tasks(agent)
        except PancakesError:
            return []
        return [
            f"{_name(row)} was given up" + (f": {row.reason}" if row.reason else "")
            for row in filter(is_given_up, rows)
        ]

    def run_again(self, agent: str, before: AgentBefore, only_those: bool) -> None:
        """Start tasks that a restarted agent does not start by itself; report those that do not start.

        Args:
            agent: the agent.
            before: its tasks before the restart.
            only_those: True: start the tasks that ran before. False: start the tasks that were given up, as the new
                version may run them.
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

    def _answering(self, agent: str) -> list[TaskInfo]:
        """Return the tasks of an agent that has just been started, once it answers."""
        until_s = self._now() + ANSWER_S
        with self._client(agent) as client:
            while True:
                try:
                    return client.tasks(agent)
                except PancakesError as error:
                    if self._now() >= until_s:
                        self._tell(agent, f"does not report its tasks: {error}")
                        return []
                client.wait(lambda: False, LOOK_S)

    def movable(self, agent: str) -> list[tuple[str, str]]:
        """Return the running tasks that could migrate, each with the agent that would take it now; empty: none."""
        found = []
        for row in self._hosted(agent):
            with self._client(agent) as client:
                try:
                    found.append((row.task, client.migrate(row, dry_run=True, timeout_s=ANSWER_S).winner))
                except PancakesError:
                    found.append((row.task, ""))
        return found

    def away(self, agent: str) -> None:
        """Migrate the running tasks of an agent to its neighbours; report those that no neighbour takes.

        Tasks of other agents that wait there migrate on, and later go home from their new place.
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
        """Migrate tasks back to an agent that runs again.

        A task that is refused stays where it is for now: tasks migrate only between equal versions.
        """
        until_s = self._now() + within_s
        for it in [it for it in self._moved if it.home == agent]:
            if it.at not in self._addresses:
                self._moved.remove(it)
                self._tell(agent, f"does not get {it.task} back: {it.at} has no host in the fleet file")
            elif not (fault := self._back(it, until_s)):
                self._moved.remove(it)
                self._tell(agent, f"gets {it.task} back from {it.at}")
            elif within_s > SOON_S:
                self._moved.remove(it)
                self._tell(agent, f"does not get {it.task} back from {it.at}: {fault}")

    def all_back(self) -> None:
        """Migrate all tasks home that are still away, after all agents run; report those that stay away."""
        for agent in dict.fromkeys(it.home for it in self._moved):
            self.back(agent, BACK_S)

    def settle(
        self, agent: str, before: Mapping[str, str], calm_s: float, called_off: Callable[[], bool] = lambda: False
    ) -> str:
        """Wait until the tasks of an agent run; return what is wrong, or an empty string.

        Args:
            agent: the agent.
            before: the states of its tasks before, by name.
            calm_s: how long they must run without a restart, in seconds.
            called_off: returns whether to stop waiting.
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
                    return "; ".join(steadiness.faults(tasks)) or "its tasks restart again and again"
                client.wait(lambda: False, LOOK_S)
        return ""

    def _hosted(self, agent: str) -> list[TaskInfo]:
        try:
            return [row for row in self.tasks(agent) if row.service == HOSTED and row.state == "running"]
        except PancakesError as error:
            self._tell(agent, f"does not report its tasks: {error}")
            return []

    def _back(self, it: MovedTask, until_s: float) -> str:
        """Migrate a task home; return why this failed, or an empty string."""
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
        return Client(Target((self._addresses[agent],), self._fleet), ANSWER_S, lambda text: None)


def _name(row: TaskInfo) -> str:
    return f"{row.service}/{row.task}"
