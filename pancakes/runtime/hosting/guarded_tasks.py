"""The guarded tasks of one service: their leases, and those that it is to take."""

from __future__ import annotations

from pancakes.mesh.guarding.choosing import CanGuard
from pancakes.mesh.guarding.guard_messages import DenyLease, LeaseKept
from pancakes.mesh.guarding.taking_over import TakeTask
from pancakes.mesh.migration.effect import Seize
from pancakes.mesh.migration.event import PacketId
from pancakes.mesh.migration.guarded_task import is_checkpoint
from pancakes.mesh.migration.guards import GuardianId
from pancakes.mesh.migration.messages import is_for
from pancakes.mesh.migration.record import Record
from pancakes.packet import Fence, Packet, agent_of
from pancakes.runtime.hosting.checkpointing import Checkpointing
from pancakes.runtime.hosting.deliveries import Deliveries
from pancakes.runtime.hosting.disputes import Disputes
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.leases import Leases
from pancakes.runtime.hosting.peer_talk import PeerTalk
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.hosting.standing import Standing
from pancakes.runtime.hosting.takings import Takings
from pancakes.runtime.journal import May


class GuardedTasks:
    """Looks after the guarded tasks of one service. All in that service's actor.

    Args:
        host: the service.
        records: says which service has the record of a task.
        mesh: says what neighbours there are.
        checkpointing: has its tasks written down.
        deliveries: acknowledges packets.
        disputes: learns that the guardians of a task follow another owner.
    """

    def __init__(
        self,
        host: HostingService,
        records: Records,
        talk: PeerTalk,
        checkpointing: Checkpointing,
        deliveries: Deliveries,
        disputes: Disputes,
    ) -> None:
        self._host = host
        self._records = records
        self._talk = talk
        self._leases = Leases(host, self._talk, records, checkpointing.look_at, deliveries.on_disk, disputes.outvoted)
        self._takings = Takings(host, self._talk)
        self.begin = self._leases.begin
        self.close = self._leases.close
        self.look = self._leases.look
        self.stopped = self._leases.stopped
        self.has_no_permit = self._leases.has_no_permit
        self._deliveries = deliveries

    def first_guardian(self, place: Place, snapshot: bytes = b"") -> GuardianId | None:
        """Returns the first guardian of a task that begins here: this agent; None: the task is not guarded."""
        return self._talk.me if self._leases.rule_of(place, snapshot) is not None else None

    def acknowledge(self, place: Place, packet: PacketId) -> None:
        """The effect of a packet is on disk here: acknowledges it once that outlives this agent too."""
        if place.tenancy is not None:
            self._leases.owe(place, packet)
        else:
            self._deliveries.on_disk(place, packet)

    def may_write(self, place: Place, record: Record) -> May | None:
        """Returns what is asked before a checkpoint of a task that runs is written; None: nothing is."""
        if not place.standing.volatile.running or not is_checkpoint(place.standing.record, record):
            return None
        permits, right = self._host.kernel.permits, Fence(str(record.task_id), record.epoch)

        def why_not() -> str:
            if permits.may_act(right):
                return ""
            permits.hold_back(right, "checkpoints")
            return f"{record.task_id} may not act until its guardians answer"

        return why_not

    def given(self, place: Place, effect: Seize) -> None:
        """A task was given to this agent: its guardians are asked."""
        self._takings.given(place, effect)

    def heard(self, packet: Packet) -> None:
        """A guardian has said something."""
        body, peer = packet.body, agent_of(packet.source)
        if not is_for(body, self._talk.me.journal):
            return
        if isinstance(body, TakeTask):
            self._called(peer, body)
            return
        place = self._host.places.get(body.task_id)
        if place is None or body.guardian.agent != peer:
            return
        if isinstance(body, CanGuard):
            self._leases.can_guard(place, peer, body)
            return
        self._takings.heard(place, body)
        if isinstance(body, (LeaseKept, DenyLease)):
            self._leases.heard(place, body)

    def _called(self, peer: str, call: TakeTask) -> None:
        here = self._records.service_of(call.task_id) in ("", self._host.name)
        if here and not self._host.kernel.access.fault(peer, "guard", call.type):
            place = self._host.places.get(call.task_id) or Place(call.task_id, Standing(Record(call.task_id)))
            self._takings.called(place, call)
