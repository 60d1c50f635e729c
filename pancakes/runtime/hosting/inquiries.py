"""What other agents know of a task that is to be created here: one question to each, for a short time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from pancakes.mesh.migration.knowledge import TaskFact, TasksKnown
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.net.mesh import Mesh
from pancakes.runtime.hosting.census_messages import CENSUS, AskAbout
from pancakes.runtime.hosting.hosting_service import HostingService

ANSWERED_S: Final = 1.0
"""So long, in host time, the agents that are connected have for their answers."""


class InquiryFindings(msgspec.Struct, frozen=True):
    """What was found out about a task.

    Attributes:
        facts: what agents know of it.
        silent: the agents that have not answered.
    """

    facts: Sequence[TaskFact]
    silent: Sequence[str]


class _Inquiry(msgspec.Struct):
    """One task that is asked about.

    Attributes:
        type: entry point name of its class.
        silent: the agents that have not answered.
        facts: what the others know.
        done: gets what was found out.
    """

    type: str
    silent: list[str]
    facts: list[TaskFact]
    done: Callable[[InquiryFindings], None]


class Inquiries:
    """Asks all neighbours about tasks. All in the service's actor.

    Args:
        host: the service.
        mesh: says what neighbours there are.
    """

    def __init__(self, host: HostingService, mesh: Mesh) -> None:
        self._host = host
        self._mesh = mesh
        self._open: dict[TaskId, _Inquiry] = {}

    def about(self, task_id: TaskId) -> bool:
        """Returns whether a task is being asked about."""
        return task_id in self._open

    def begin(self, task_id: TaskId, type_name: str, done: Callable[[InquiryFindings], None]) -> None:
        """Asks about a task, and calls `done` once all have answered, or the time is over."""
        peers = sorted(self._mesh.neighbours())
        if not peers:
            done(InquiryFindings((), ()))
            return
        self._open[task_id] = inquiry = _Inquiry(type_name, peers, [], done)
        self._host.kernel.tell(CENSUS, AskAbout((), (task_id,)))
        self._host.after_host(ANSWERED_S, lambda: self._conclude(task_id, inquiry))

    def heard(self, peer: str, told: TasksKnown) -> None:
        """Another agent has told what it knows."""
        for task_id in told.task_ids:
            inquiry = self._open.get(task_id)
            if inquiry is None or peer not in inquiry.silent:
                continue
            inquiry.silent.remove(peer)
            for fact in told.facts:
                if fact.task_id == task_id:
                    self._learn(peer, inquiry, fact)
            if not inquiry.silent:
                self._conclude(task_id, inquiry)

    def _learn(self, peer: str, inquiry: _Inquiry, fact: TaskFact) -> None:
        access = self._host.kernel.access
        if fault := access.fault(peer, "host", inquiry.type) and access.fault(peer, "guard", inquiry.type):
            self._host.log("warning", f"{peer} says that it knows {fact.task_id}, and is not believed: {fault}")
        else:
            inquiry.facts.append(fact)

    def _conclude(self, task_id: TaskId, inquiry: _Inquiry) -> None:
        if self._open.get(task_id) is inquiry:
            del self._open[task_id]
            inquiry.done(InquiryFindings(tuple(inquiry.facts), tuple(inquiry.silent)))
