"""The guarded tasks of one service: their leases, and those that it is to take."""

from __future__ import annotations

from pancakes.mesh.guarding.choosing import CanGuard
from pancakes.mesh.guarding.guard_messages import DenyLease, LeaseKept
from pancakes.mesh.guarding.taking_over import TakeTask
from pancakes.mesh.migration.effect import Seize
from pancakes.mesh.migration.event import PacketId
from pancakes.mesh.migration.guarded_task import is_checkpoint
from pancakes.mesh.migration.guards import NO_GUARDS, GuardianId, Guards
from pancakes.mesh.migration.messages import is_for
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.packet import Fence, Packet, agent_of
from pancakes.runtime.hosting.checkpointing import Checkpointing
from pancakes.runtime.hosting.deliveries import Deliveries
from pancakes.runtime.hosting.disputes import Disputes
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.last_said import LastSaid
from pancakes.runtime.hosting.leases import Leases
from pancakes.runtime.hosting.origins import Origins
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
        origins: asks which agent has a task.
    """

    def __init__(
        self,
        host: HostingService,
        records: Records,
        talk: PeerTalk,
        checkpointing: Checkpointing,
        deliveries: Deliveries,
        disputes: Disputes,
        origins: Origins,
    ) -> None:
        self._host = host
        self._records = records
        self._origins = origins
        self._unbelieved = LastSaid()
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
            self._called(packet)
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

    def _called(self, packet: Packet) -> None:
        """A guardian says that a task is to be taken. It is believed only if no agent is known to have the task."""
        peer, call = agent_of(packet.source), packet.body
        here = self._records.service_of(call.task_id) in ("", self._host.name)
        if not here or self._host.kernel.access.fault(peer, "guard", call.type):
            return
        record, own = self._records.get(call.task_id), self._own_guards(call.task_id)
        if peer not in {one.agent for one in (own if own.sets else call.guards).members()}:
            self._not_believed(packet, f"{peer} does not guard it")
        elif record is not None and self._needs_no_taker(record, call):
            self._not_believed(packet, f"it is {record.phase.value} here, and not guarded")
        else:
            self._origins.judge(packet, self._judged)

    def _own_guards(self, task_id: TaskId) -> Guards:
        """Returns what this agent knows itself of the guardians of a task; none where it is none of them."""
        register = self._host.state.register_of(task_id)
        guards_it = register is not None and self._talk.me in register.guards.members()
        return register.guards if register is not None and guards_it else NO_GUARDS

    def _needs_no_taker(self, record: Record, call: TakeTask) -> bool:
        if record.removed:
            return call.promised <= record.seen
        return record.phase in (Phase.OWNER, Phase.FROZEN, Phase.COMMITTED) and not record.guarded

    def _judged(self, packet: Packet, refusal: str) -> None:
        if refusal:
            self._not_believed(packet, refusal)
            return
        call = packet.body
        place = self._host.places.get(call.task_id) or Place(call.task_id, Standing(Record(call.task_id)))
        self._takings.called(place, call, self._own_guards(call.task_id))

    def _not_believed(self, packet: Packet, why: str) -> None:
        peer, task_id = agent_of(packet.source), packet.body.task_id
        if self._unbelieved.is_news(peer, f"{task_id} {why}"):
            self._host.log("warning", f"{peer} says that {task_id} is to be taken over, and is not believed: {why}")
