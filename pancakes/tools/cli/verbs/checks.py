"""Register the checks of `pancakes doctor`: a check is a function with a decorator.

A check looks at one thing and yields findings. The checks of this machine are in `machine_checks`, those of agents in
`agent_checks`. The agents are asked once, and each check gets their answers as `Facts`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeVar

from pancakes.util.runtime_dir import RunningAgent

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check.

    Attributes:
        level: `ok`; `warning`: it works, but not as well as it could; `error`: something does not work.
        about: the subject, such as `runtime directory` or `agent1/ir`.
        text: what was found.
        advice: what to do; empty if nothing.
    """

    level: Level
    about: str
    text: str
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """The answers of the agents of a fleet.

    Attributes:
        agents: the result of `Describe` of each agent.
        silent: a sentence for each agent that did not answer.
        asleep: the sentences in `silent` about agents that had announced that their network would sleep.
        entries: the agents that run on this machine; empty if other agents were asked.
        guards: the answers of all agents to `Guarding`.
        rosters: the number of the newest roster of each fleet on this machine.
        now_s: the time of day here when they answered, in seconds since 1970; None: not known.
        describe: asks an agent for the details of a target; returns None if it does not answer.
        fences: returns the epochs that an actuator (an agent, `service/device`) has seen of its tasks.
    """

    agents: Sequence[dict[str, Any]] = ()
    silent: Sequence[str] = ()
    asleep: Sequence[str] = ()
    entries: Sequence[RunningAgent] = ()
    guards: Sequence[dict[str, Any]] = ()
    rosters: Mapping[str, int] = field(default_factory=dict)
    now_s: float | None = None
    describe: Callable[[str, str], Any] = lambda agent, target: None
    fences: Callable[[str, str], Sequence[dict[str, Any]]] = lambda agent, target: ()


_Machine = TypeVar("_Machine", bound=Callable[[], Iterator[Finding]])
FleetCheck = Callable[[Facts], Iterator[Finding]]
AgentCheck = Callable[[dict[str, Any], Facts], Iterator[Finding]]
TaskCheck = Callable[[str, dict[str, Any], Facts], Iterator[Finding]]

MACHINE_CHECKS: Final[list[Callable[[], Iterator[Finding]]]] = []
FLEET_CHECKS: Final[list[FleetCheck]] = []
AGENT_CHECKS: Final[list[AgentCheck]] = []
TASK_CHECKS: Final[list[TaskCheck]] = []


def machine_check(check: _Machine) -> _Machine:
    """Register a check of this machine, whether agents run or not."""
    MACHINE_CHECKS.append(check)
    return check


def fleet_check(check: FleetCheck) -> FleetCheck:
    """Register a check that compares agents. It is called with the facts."""
    FLEET_CHECKS.append(check)
    return check


def agent_check(check: AgentCheck) -> AgentCheck:
    """Register a check of one agent. It is called with the agent's description and the facts."""
    AGENT_CHECKS.append(check)
    return check


def task_check(check: TaskCheck) -> TaskCheck:
    """Register a check of one task or device. It is called with the agent's name, the task and the facts."""
    TASK_CHECKS.append(check)
    return check
