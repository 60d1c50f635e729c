"""What an agent says about the tasks of others, as packets to their registrars."""

from __future__ import annotations

from typing import Any

import msgspec

from pancakes.durable.bidding_messages import MIGRATOR
from pancakes.durable.messages import REGISTRAR, Accept, Fact, Known, Solicit, addressed
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.durable.snapshot import Snapshot
from pancakes.testing import Fleet


def identity(fleet: Fleet, name: str) -> Identity:
    """Returns an agent as an owner and member of tasks."""
    of = fleet.agents[name].agent.mesh.identity
    return Identity(name, of.journal, of.copy)


def say(fleet: Fleet, speaker: str, message: msgspec.Struct, to: str, at: str = REGISTRAR) -> None:
    """Has an agent send a message to an actor of another."""
    if hasattr(message, "journal"):
        message = addressed(message, identity(fleet, to).journal)
    fleet.agents[speaker].publish("network", message, to=f"{to}/{at}")


def owns(fleet: Fleet, name: str, task_id: TaskId, n: int = 9) -> Fact:
    """Returns what an agent says that owns a task."""
    me = identity(fleet, name)
    return Fact(task_id, Register(Epoch(n, me), sets=((me,),)))


def tell(fleet: Fleet, speaker: str, to: str, *facts: Fact, task_ids: tuple[TaskId, ...] = ()) -> None:
    """Has an agent tell another what it knows of tasks; without `task_ids`: unasked."""
    say(fleet, speaker, Known(identity(fleet, speaker), task_ids, facts), to)


def room(fleet: Fleet, task_id: TaskId, type: str = "test.Count", of: str = "a/Count") -> Solicit:
    """Returns how an agent asks for room for a task, whose class is that of one that runs."""
    agent, _, task = of.partition("/")
    version = fleet.agents[agent].slot(task).spec.version
    return Solicit(task_id, 1, type, version, "client", hold=True)


def ask_for_room(fleet: Fleet, speaker: str, request: Solicit, to: str) -> None:
    """Has an agent ask another to keep room for a task."""
    say(fleet, speaker, request, to, MIGRATOR)


def offer(fleet: Fleet, speaker: str, task_id: TaskId, to: str, n: int = 0, no: int = 1, **snapshot: Any) -> Accept:
    """Returns how an agent offers a task to another. It never gives it away, as it says that it has another disk."""
    me, heir = Identity(speaker, "gone"), identity(fleet, to)
    register = Register(Epoch(n, me), no, ((me,),), heir=heir)
    state = Snapshot(**{"task_id": task_id, "type": "test.Count", "version": "", "service": "client", **snapshot})
    return Accept(task_id, "test.Count", "client", register, to=heir, state=state.encode())


def heard_by(fleet: Fleet, name: str, *kinds: type) -> list[Any]:
    """Returns the bodies of these kinds that an agent is told from now on; the list grows."""
    heard: list[Any] = []
    fleet.agents[name].kernel.stream.tap(
        "network", lambda packet: heard.append(packet.body) if isinstance(packet.body, kinds) else None
    )
    return heard
