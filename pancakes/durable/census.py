"""The census: linked agents tell each other what they own, so that two owners of one task are noticed.

It belongs to no service, because an agent owns the tasks of a stopped service all the same. It remembers on disk how
often each peer was started, and tells a peer whose disk is an old copy.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import msgspec

from pancakes.durable.courier import COURIER, OwnerHeard
from pancakes.durable.host_state import HostState
from pancakes.durable.ownership import (
    AskTasks,
    Boot,
    BootRemembered,
    BootsSeen,
    Claims,
    Owned,
    OwnerClaim,
    TaskFact,
    TasksKnown,
    claims_of,
    fact_of,
    in_packets,
    newest_fact,
    questions,
)
from pancakes.durable.record import TaskId
from pancakes.durable.store import Records, Registers
from pancakes.errors import PancakesError
from pancakes.journal import Disk, RecordTable
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import drop_oldest, on
from pancakes.kernel.mailbox import Reference, tell
from pancakes.mesh.mesh import Mesh
from pancakes.packet import NETWORK, Packet, agent_of, join
from pancakes.util import codecs

CENSUS: Final = "kernel/Census"
"""Where on each agent the census is."""


class NetworkBegan(msgspec.Struct, frozen=True):
    """The Network Service tells the census that packets can go to other agents from now on."""


class NeighbourUp(msgspec.Struct, frozen=True):
    """The agent tells the census that a link to another agent stands.

    Attributes:
        peer: the other agent.
        boot: its boot.
    """

    peer: str
    boot: Boot


class Owns(msgspec.Struct, frozen=True):
    """A service tells the census that this agent owns a task.

    Attributes:
        owned: the task, and under which epoch.
        peer: the neighbour that is to know; empty: all of them.
    """

    owned: OwnerClaim
    peer: str = ""


class AskAbout(msgspec.Struct, frozen=True):
    """A service has the census ask neighbours what they know of tasks.

    Attributes:
        peers: the neighbours; empty: all of them.
        task_ids: the tasks.
    """

    peers: tuple[str, ...]
    task_ids: tuple[TaskId, ...]


class HostBegan(msgspec.Struct, frozen=True):
    """A service that hosts tasks tells the census that it has begun: it is told the claims of other agents.

    Attributes:
        service: the service.
    """

    service: Reference


class ClaimsCame(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks what another agent says that it owns.

    Attributes:
        peer: the other agent.
        claims: its claims, by task.
    """

    peer: str
    claims: dict[TaskId, OwnerClaim]


class NeighbourCame(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks that another agent can be asked from now on.

    Attributes:
        peer: the other agent.
    """

    peer: str


class FactsCame(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks what another agent knows of tasks.

    Attributes:
        peer: the other agent.
        told: what it says.
    """

    peer: str
    told: TasksKnown


class CopyNoticed(msgspec.Struct, frozen=True):
    """The census tells a service that hosts tasks that another agent takes the disk of this one for an old copy.

    Attributes:
        peer: the other agent.
    """

    peer: str


CensusNews = ClaimsCame | NeighbourCame | FactsCame | CopyNoticed
"""What the census tells a service that hosts tasks."""


KIND: Final = "boot"
MOST_AGENTS: Final = 1024
"""The boots of so many agents are remembered; of further ones none."""


class BootMemory:
    """What is remembered of the boots of other agents. One thread at a time.

    It lies on disk, because a fleet whose power has failed, or which is set up from backups, starts all at once: then
    no agent remembers what it has not written down. An agent has one entry, and a new boot costs one write.

    Args:
        disk: what it is kept on.
    """

    def __init__(self, disk: Disk) -> None:
        self._table = RecordTable(disk, KIND, codecs.decoder(BootsSeen), lambda key, why: None)

    def knows_any(self) -> bool:
        """Returns whether there is an agent that this one has ever met."""
        return bool(self._table.newest)

    def met(self, agent: str, boot: Boot) -> Boot | None:
        """Learns of a boot of an agent; returns the later one that is remembered, where its disk is an old copy."""
        known = self._table.newest.get(agent, BootsSeen())
        later = known.after(boot)
        seen = known.with_(boot)
        if seen != known and (agent in self._table.newest or len(self._table.newest) < MOST_AGENTS):
            # What cannot be written is remembered until this agent ends; its journal tells people.
            self._table.write(agent, seen, lambda: None, lambda why: None)
        return later


KEEP: Final = drop_oldest(256)


class Census(ActorCore):
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

    @on(NETWORK, Owned, queue=KEEP, addressed=True)
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

    @on(NETWORK, AskTasks, queue=KEEP, addressed=True)
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

    @on(NETWORK, TasksKnown, queue=KEEP, addressed=True)
    def on_known(self, packet: Packet) -> None:
        """Another agent tells what it knows of tasks."""
        if peer := self._speaker(packet):
            self._tell_services(FactsCame(peer, packet.body))

    @on(NETWORK, BootRemembered, queue=KEEP, addressed=True)
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
