"""Records, messages and short ways to the hand-off that its tables are tested with."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.handoff import handle
from pancakes.durable.handoff_events import Effect, Received
from pancakes.durable.messages import Solicit
from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Record, TaskId, Volatile

SCAN = TaskId("agent1", "ScanTarget")
REQUEST = Solicit(SCAN, 1, "encirclement.ScanTarget", "0.1.0", "client", ("pose", "motors"))
BIRTH = Epoch(0, "agent1")
OFFER = Epoch(1, "agent1")

REST = Volatile()
RUNNING = Volatile(running=True)
ASKED = Volatile(running=True, asked="agent2")
FREEZING = Volatile(running=True, asked="agent2", freezing=True)

OWNER = Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"checkpoint")
FROZEN = Record(SCAN, Phase.FROZEN, BIRTH, OFFER, OFFER, "agent2", snapshot=b"as it stopped")
COMMITTED = replace(FROZEN, phase=Phase.COMMITTED)
RELEASED = Record(SCAN, Phase.RELEASED, BIRTH, OFFER, NO_EPOCH, "agent2")
TAKEN_BACK = Record(SCAN, Phase.OWNER, BIRTH, OFFER, snapshot=b"as it stopped")

ABSENT = Record(SCAN)
PREPARED = Record(SCAN, Phase.PREPARED, NO_EPOCH, OFFER, OFFER, "agent1", snapshot=b"as it stopped")
NEW_OWNER = Record(SCAN, Phase.OWNER, OFFER, OFFER, snapshot=b"as it stopped")
DROPPED = Record(SCAN, Phase.ABSENT, NO_EPOCH, OFFER, NO_EPOCH, "agent1")


def at_source(record: Record, volatile: Volatile, event: object) -> list[Effect]:
    return handle("agent1", record, volatile, event)  # type: ignore[arg-type]


def at_destination(record: Record, event: object, volatile: Volatile = REST) -> list[Effect]:
    return handle("agent2", record, volatile, event)  # type: ignore[arg-type]


def from_agent2(message: object) -> Received:
    return Received("agent2", message)  # type: ignore[arg-type]


def from_agent1(message: object, refusal: Refusal | None = None) -> Received:
    return Received("agent1", message, refusal)  # type: ignore[arg-type]
