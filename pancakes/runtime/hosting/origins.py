"""Whether the agent that brings a task has it: asked before a place is kept for the task, as an actuator asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.migration.messages import Reserve
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.mesh.migration.whereabouts import TaskAt, WhereIs
from pancakes.packet import NETWORK, Packet, agent_of, join
from pancakes.runtime.hosting.courier_messages import COURIER
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.records import Records

ANSWER_S: Final = 0.3
"""So long each agent has to say where a task is, in host time: its source waits a second for the place."""
MOST_ASKED: Final = 8
"""So many agents are asked, one after the other, each named by the one before."""
MOST: Final = 64
"""So many reservations wait for an answer; of more, the source asks again."""


class _Waiting(msgspec.Struct):
    """A reservation that waits until other agents have said where the task is.

    Attributes:
        packet: the reservation.
        asked: the agents that were asked, the last one just now.
    """

    packet: Packet
    asked: list[str]


class Origins:
    """Asks the agents that must know which one has a task. All in the service's actor.

    The birthplace of a task knows, or the agent that has given it away, to which one it gave it, and so does each after
    that. A source that none of them names has no right to the task. An agent that is not linked, or does not answer,
    is no reason to refuse: a task outlives its birthplace.

    Args:
        host: the service.
        records: what is known of tasks here.
        take: takes a reservation, and why it is refused; empty: it is not.
    """

    def __init__(self, host: HostingService, records: Records, take: Callable[[Packet, str], None]) -> None:
        self._host = host
        self._records = records
        self._take = take
        self._waiting: dict[tuple[str, TaskId], _Waiting] = {}  # by the source

    def judge(self, packet: Packet) -> None:
        """Has a reservation taken once it is known that its source may make it."""
        message: Reserve = packet.body
        source, task_id = agent_of(packet.source), message.task_id
        first = self._first(source, task_id, self._records.get(task_id))
        if not first:
            self._take(packet, "")
        elif len(self._waiting) < MOST or (source, task_id) in self._waiting:
            waiting = self._waiting[source, task_id] = _Waiting(packet, [])
            self._ask(waiting, first)

    def told(self, packet: Packet) -> None:
        """An agent says which one has a task."""
        by, at = agent_of(packet.source), packet.body
        for (source, task_id), waiting in list(self._waiting.items()):
            if str(task_id) == at.task_id and waiting.asked[-1] == by:
                self._heard(waiting, source, by, at)

    def _first(self, source: str, task_id: TaskId, record: Record | None) -> str:
        """Returns the agent that must know where a task is; empty: none that can be asked."""
        gave_to = record.peer if record is not None and record.phase is Phase.RELEASED else ""
        knows = gave_to or task_id.birthplace
        return knows if knows != source and self._may_ask(knows) else ""

    def _may_ask(self, agent: str) -> bool:
        return agent != self._host.agent and self._host.connected(agent)

    def _heard(self, waiting: _Waiting, source: str, by: str, at: TaskAt) -> None:
        if at.peer == by:
            self._end(waiting, f"{by} has {at.task_id}, under the epoch {at.epoch}: {source} has no right to it")
        elif at.peer not in ("", source, *waiting.asked) and len(waiting.asked) < MOST_ASKED and self._may_ask(at.peer):
            self._ask(waiting, at.peer)
        else:
            self._end(waiting)

    def _ask(self, waiting: _Waiting, agent: str) -> None:
        waiting.asked.append(agent)
        task_id, number = str(waiting.packet.body.task_id), len(waiting.asked)
        try:
            self._host.publish(NETWORK, WhereIs(task_id), to=join(agent, COURIER))
        except PancakesError as error:
            self._host.log("debug", f"{agent} was not asked about {task_id}: {error}")
            self._end(waiting)
            return
        self._host.after_host(ANSWER_S, lambda: self._end(waiting) if len(waiting.asked) == number else None)

    def _end(self, waiting: _Waiting, refusal: str = "") -> None:
        key = agent_of(waiting.packet.source), waiting.packet.body.task_id
        if self._waiting.get(key) is waiting:
            del self._waiting[key]
            self._take(waiting.packet, refusal)
