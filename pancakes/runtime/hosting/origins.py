"""Which agent has a task: asked before the task is taken from another one, or over, as an actuator asks."""

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
MOST_OF_PEER: Final = 16
"""So many packets of one peer wait for an answer; of more, the peer asks again."""

Take = Callable[[Packet, str], None]
"""Takes a packet, and why it is refused; empty: it is not."""


class _Waiting(msgspec.Struct):
    """A packet that waits until other agents have said where the task is.

    Attributes:
        packet: the packet.
        take: takes it then.
        asked: the agents that were asked, the last one just now.
    """

    packet: Packet
    take: Take
    asked: list[str]


class Origins:
    """Asks the agents that must know which one has a task. All in the service's actor.

    The birthplace of a task knows, or the agent that has given it away, to which one it gave it, and so does each after
    that. If one of them has the task itself, no other gives it away, and no guardian has it taken over. An agent that
    is not linked, or does not answer, is no reason to refuse: a task outlives its birthplace. A guarded task is taken
    over also from an owner that is linked here, if its guardians do not let it act.

    Args:
        host: the service.
        records: what is known of tasks here.
    """

    def __init__(self, host: HostingService, records: Records) -> None:
        self._host = host
        self._records = records
        self._waiting: dict[tuple[str, str, TaskId], _Waiting] = {}

    def judge(self, packet: Packet, take: Take) -> None:
        """Has a packet taken that says where a task is to come from, once it is known whether that may be."""
        source, _, task_id = key = _key(packet)
        first = self._first(source, task_id, self._records.get(task_id))
        if not first:
            take(packet, "")
        elif key in self._waiting or sum(it[0] == source for it in self._waiting) < MOST_OF_PEER:
            waiting = self._waiting[key] = _Waiting(packet, take, [])
            self._ask(waiting, first)

    def told(self, packet: Packet) -> None:
        """An agent says which one has a task."""
        by, at = agent_of(packet.source), packet.body
        for (source, _, task_id), waiting in list(self._waiting.items()):
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
        if at.peer == by and (at.acts or isinstance(waiting.packet.body, Reserve)):
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
        key = _key(waiting.packet)
        if self._waiting.get(key) is waiting:
            del self._waiting[key]
            waiting.take(waiting.packet, refusal)


def _key(packet: Packet) -> tuple[str, str, TaskId]:
    return agent_of(packet.source), packet.type, packet.body.task_id
