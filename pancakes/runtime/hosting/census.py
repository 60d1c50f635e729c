"""The census: linked agents tell each other what tasks they own, so that two owners of one task are noticed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.migration.boots import Boot, BootRemembered
from pancakes.mesh.migration.claim import Claims, Owned, OwnerClaim, claims_of, in_packets
from pancakes.mesh.migration.knowledge import AskTasks, TaskFact, TasksKnown, fact_of, newest_fact, questions
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import NETWORK, Packet, agent_of, join
from pancakes.runtime.hosting.boot_memory import BootMemory
from pancakes.runtime.hosting.census_messages import (
    CENSUS,
    AskAbout,
    CensusNews,
    ClaimsCame,
    CopyNoticed,
    FactsCame,
    HostBegan,
    NeighbourCame,
    NeighbourUp,
    NetworkBegan,
    Owns,
)
from pancakes.runtime.hosting.courier_messages import COURIER, OwnerHeard
from pancakes.runtime.hosting.host_state import HostState
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.hosting.registers import Registers
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.handlers import on
from pancakes.runtime.kernel.keep import queue
from pancakes.runtime.kernel.tell import tell

KEEP: Final = queue(256)


class Census(Component):
    """Tells neighbours what this agent owns and knows, and its services what neighbours own and know.

    It belongs to no service: what a service owns that does not run now is owned all the same.

    Args:
        records: what this agent owns.
        registers: what it knows as a guardian.
        boots: what it remembers of the boots of others.
        state: says which services host tasks.
        mesh: says what neighbours there are.
    """

    def __init__(
        self,
        *args: Any,
        records: Records,
        registers: Registers,
        boots: BootMemory,
        state: HostState,
        mesh: Mesh,
        **others: Any,
    ) -> None:
        super().__init__(*args, **others)
        self._records = records
        self._registers = registers
        self._boots = boots
        self._state = state
        self._mesh = mesh
        self._claims = Claims()
        self._say_so: set[str] = set()  # the agents that take this one's disk for an old copy

    def take_message(self, message: Any) -> Any:
        match message:
            case NeighbourUp():
                self._meet(message.peer, message.boot)
            case NetworkBegan():
                for hello in self._mesh.connected().values():
                    if hello.role == "agent":
                        self._meet(hello.name, Boot(hello.journal, hello.boot, hello.life))
            case Owns():
                self._say_claims([message.peer] if message.peer else self._mesh.neighbours(), [message.owned])
            case AskAbout():
                for peer in message.peers or self._mesh.neighbours():
                    self._say(peer, questions(message.task_ids), "was not asked about tasks")
            case HostBegan():
                for peer, claims in self._claims.by_peer().items():
                    tell(message.service, ClaimsCame(peer, claims))
                for peer in sorted(self._say_so):
                    tell(message.service, CopyNoticed(peer))
            case _:
                return super().take_message(message)
        return None

    def _meet(self, peer: str, boot: Boot) -> None:
        self._say_claims([peer], claims_of(self._records.all().values()))
        later = self._boots.met(peer, boot)
        if later is not None:
            self.log("warning", f"the disk of {peer} is an old copy: {_why(self.agent, later, boot)}")
            self._say(peer, [BootRemembered(*later)], "was not told that its disk is an old copy")
        self._tell_services(NeighbourCame(peer))

    def _say_claims(self, peers: list[str], claims: list[OwnerClaim]) -> None:
        for peer in peers:
            self._say(peer, in_packets(claims), f"was not told what {self.agent} owns")

    def _say(self, peer: str, bodies: Iterable[object], otherwise: str) -> None:
        for body in bodies:
            try:
                self.publish(NETWORK, body, to=join(peer, CENSUS))
            except PancakesError as error:
                self.log("debug", f"{peer} {otherwise}: {error}")

    def _tell_services(self, news: CensusNews) -> None:
        for service in self._state.services():
            tell(service, news)

    def _speaker(self, packet: Packet) -> str:
        """Returns the neighbour that says something; empty: it is none."""
        peer = agent_of(packet.source)
        return peer if peer in self._mesh.neighbours() else ""

    @on(NETWORK, Owned, keep=KEEP, addressed=True)
    def on_owned(self, packet: Packet) -> None:
        """Another agent tells what it owns."""
        if not (peer := self._speaker(packet)):
            return
        claims: dict[TaskId, OwnerClaim] = {}
        for claim in packet.body.claims:
            self._claims.heard(peer, claim)
            claims[claim.task_id] = claim
        self._tell_services(ClaimsCame(peer, claims))
        self.kernel.tell(COURIER, OwnerHeard(peer, packet.body.claims))

    @on(NETWORK, AskTasks, keep=KEEP, addressed=True)
    def on_ask(self, packet: Packet) -> None:
        """Another agent asks what this one knows of tasks."""
        if peer := self._speaker(packet):
            task_ids = packet.body.task_ids
            facts = tuple(fact for fact in map(self._fact, task_ids) if fact is not None)
            self._say(peer, [TasksKnown(task_ids, facts)], f"was not told what {self.agent} knows")

    def _fact(self, task_id: TaskId) -> TaskFact | None:
        # What others have claimed is not among it: whether they may, is known where the task's type is.
        record, register = self._records.get(task_id), self._registers.get(task_id)
        lost = self._records.lost(task_id)
        return newest_fact(
            (
                fact_of(self.agent, record) if record is not None else None,
                TaskFact(task_id, register.promised.minter, register.promised) if register is not None else None,
                TaskFact(task_id, "", lost.seen) if lost is not None else None,
            )
        )

    @on(NETWORK, TasksKnown, keep=KEEP, addressed=True)
    def on_known(self, packet: Packet) -> None:
        """Another agent tells what it knows of tasks."""
        if peer := self._speaker(packet):
            self._tell_services(FactsCame(peer, packet.body))

    @on(NETWORK, BootRemembered, keep=KEEP, addressed=True)
    def on_boot(self, packet: Packet) -> None:
        """Another agent takes this one's disk for an old copy."""
        peer, own = self._speaker(packet), self._mesh.identity
        boot = Boot(own.journal, own.boot, own.life)
        if not peer or peer in self._say_so or not boot.is_before(packet.body.boot):
            return
        self._say_so.add(peer)
        self.log(
            "warning", f"{peer} takes the disk of {self.agent} for an old copy: {_why(peer, packet.body.boot, boot)}"
        )
        self._tell_services(CopyNoticed(peer))


def _why(agent: str, later: Boot, boot: Boot) -> str:
    if later.number == boot.number:
        return f"{agent} remembers another start of its journal with the same number, {boot.number}"
    return f"{agent} remembers start {later.number} of its journal, and this is start {boot.number}"
