"""Asks the agents that must know which one has a task, before it is taken from another one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from pancakes.control import Refusal
from pancakes.durable.messages import REGISTRAR, Fact, Known, WhoHas
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing
from pancakes.durable.store import Records
from pancakes.errors import PancakesError
from pancakes.kernel.actor import ActorCore
from pancakes.packet import NETWORK, Packet, agent_of, join

ANSWER_S: Final = 0.3
"""Each agent has this long to say where a task is, in host time: its source waits a second for the room."""
MOST_ASKED: Final = 8
"""At most this many agents are asked, one after the other, each named by the one before."""
MOST_OF_PEER: Final = 16
"""At most this many packets of one peer wait for an answer; of more, the peer asks again."""

Take = Callable[[Packet, Refusal | None], None]
"""Takes a packet, and why it is refused; None: it is not."""


class _Waiting(msgspec.Struct):
    """A packet that waits until other agents have said where the task is.

    Attributes:
        packet: the packet.
        take: takes it then.
        asked: the agents that were asked, the last one just now.
        claim: what an agent says that has the task and does not act, while a guardian of that is asked; None: none is.
        claimed_by: that agent.
    """

    packet: Packet
    take: Take
    asked: list[str]
    claim: Fact | None = None
    claimed_by: str = ""


class Origins:
    """Asks the agents that must know which one has a task. All in one actor.

    The birthplace of a task knows, or the agent that has given it away, to which one it gave it, and so does each after
    that. If one of them has the task itself, no other gives it away, and no member has it taken over. An agent that is
    not linked, or does not answer, is no reason to refuse: a task outlives its birthplace. A guarded task is taken over
    also from an owner that is linked here, if its members do not let it act. And an owner that was away while its
    guarded task was taken over may not have learned that: if it does not act, one of its guardians is asked whether the
    source has the task now, unless this agent is a guardian of the source's itself.

    Args:
        asker: the actor that asks; it hands the answers to `told`.
        records: what is known of tasks here.
        linked: returns the agents that are linked.
    """

    def __init__(self, asker: ActorCore, records: Records, linked: Callable[[], list[str]]) -> None:
        self._asker = asker
        self._records = records
        self._linked = linked
        self._waiting: dict[tuple[str, str, TaskId], _Waiting] = {}

    def judge(self, packet: Packet, take: Take) -> None:
        """Have a packet taken that says where a task is to come from, once it is known whether that may be."""
        source, _, task_id = key = _key(packet)
        first = self._first(source, task_id, self._records.get(task_id))
        if not first:
            take(packet, None)
        elif key in self._waiting or sum(it[0] == source for it in self._waiting) < MOST_OF_PEER:
            waiting = self._waiting[key] = _Waiting(packet, take, [])
            self._ask(waiting, first)

    def told(self, packet: Packet) -> None:
        """An agent says which one has tasks."""
        known: Known = packet.body
        by = agent_of(packet.source)
        facts = {fact.task_id: fact for fact in known.facts}
        for (source, _, task_id), waiting in list(self._waiting.items()):
            if task_id in known.task_ids and waiting.asked[-1] == by:
                self._heard(waiting, source, by, facts.get(task_id))

    def _first(self, source: str, task_id: TaskId, record: Record | None) -> str:
        """Return the agent that must know where a task is; empty: none that can be asked."""
        gave_to = record.gave if record is not None else ""
        knows = gave_to or task_id.birthplace
        return knows if knows != source and self._may_ask(knows) else ""

    def _may_ask(self, agent: str) -> bool:
        return agent != self._asker.agent and agent in self._linked()

    def _heard(self, waiting: _Waiting, source: str, by: str, fact: Fact | None) -> None:
        owner = fact.at(by) if fact is not None else ""
        is_call = not hasattr(waiting.packet.body, "hold")
        if waiting.claim is not None:
            taken_over = (
                fact is not None
                and fact.register.epoch > waiting.claim.register.epoch
                and fact.register.owner.agent == source
            )
            self._end(waiting, None if taken_over else self._refusal(waiting, source))
        elif fact is not None and owner == by and (fact.acts or not is_call):
            waiting.claim, waiting.claimed_by = fact, by
            guardian = "" if fact.acts else self._guardian(fact, source, by)
            if not fact.acts and self._guards_for(source, fact):
                self._end(waiting)
            elif guardian:
                self._ask(waiting, guardian)
            else:
                self._end(waiting, self._refusal(waiting, source))
        elif owner not in ("", source, *waiting.asked) and len(waiting.asked) < MOST_ASKED and self._may_ask(owner):
            self._ask(waiting, owner)
        else:
            self._end(waiting)

    def _guards_for(self, source: str, claim: Fact) -> bool:
        """Return whether this agent is a guardian of the task itself, and has followed the source since that claim."""
        record = self._records.get(claim.task_id)
        if record is None or record.standing is not Standing.MEMBER:
            return False
        return record.register.owner.agent == source and record.register.epoch > claim.register.epoch

    def _guardian(self, fact: Fact, source: str, by: str) -> str:
        """Return an agent that guards a task with its owner and can be asked; empty: there is none."""
        members = sorted({member.agent for one in fact.register.sets for member in one} - {source, by})
        return next((agent for agent in members if self._may_ask(agent)), "")

    def _refusal(self, waiting: _Waiting, source: str) -> Refusal | None:
        """Return why a packet is refused whose task another agent claims; None: none does."""
        claim, by = waiting.claim, waiting.claimed_by
        if claim is None:
            return None
        text = f"{by} has {claim.task_id}, under the epoch {claim.epoch}: {source} has no right to it"
        return Refusal("forbidden", text)

    def _ask(self, waiting: _Waiting, agent: str) -> None:
        waiting.asked.append(agent)
        task_id, number = waiting.packet.body.task_id, len(waiting.asked)
        try:
            self._asker.publish(NETWORK, WhoHas((task_id,)), to=join(agent, REGISTRAR))
        except PancakesError as error:
            self._asker.log("debug", f"{agent} was not asked about {task_id}: {error}")
            self._end(waiting, self._refusal(waiting, agent_of(waiting.packet.source)))
            return
        self._asker.after_host(ANSWER_S, lambda: self._gave_up(waiting, number))

    def _gave_up(self, waiting: _Waiting, number: int) -> None:
        """End the wait for an answer, unless it came and another agent was asked."""
        if len(waiting.asked) == number:
            self._end(waiting, self._refusal(waiting, agent_of(waiting.packet.source)))

    def _end(self, waiting: _Waiting, refusal: Refusal | None = None) -> None:
        key = _key(waiting.packet)
        if self._waiting.get(key) is waiting:
            del self._waiting[key]
            waiting.take(waiting.packet, refusal)


def _key(packet: Packet) -> tuple[str, str, TaskId]:
    return agent_of(packet.source), packet.type, packet.body.task_id
