"""The registrar: keeps the registers of all durable tasks that this agent knows, and carries out their rules.

It belongs to no service, because an agent owns the tasks of a stopped service all the same, and guards tasks that it
does not host. A service feeds it events (a checkpoint, a stop, an offer) and is told how its tasks stand; what to
do about that is decided in `reconcile`. Other agents feed it packets. The rules are in `rules`; here is what they leave
open: the disk, the network, and time. `leases` asks members for leases, `takeovers` has silent owners replaced, and
`answers` asks and says what agents know.
"""

from __future__ import annotations

import random
from functools import partial
from typing import Any, Final

from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable import messages, rules
from pancakes.durable.answers import Answers, BootMemory, NeighbourUp, NetworkBegan
from pancakes.durable.bidding_messages import BidAwarded, MoveOver
from pancakes.durable.deadlines import Deadlines
from pancakes.durable.entry import Conclude, Entry, Fed, SayAgain
from pancakes.durable.host_state import HostState, Imported
from pancakes.durable.leases import Leases
from pancakes.durable.messages import REGISTRAR, is_for
from pancakes.durable.peer_talk import LastSaid, PeerTalk
from pancakes.durable.quotas import GUARDED, IN_DOUBT, fault_of_room
from pancakes.durable.reconcile import Outcome
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import (
    ANYONE,
    BLANK,
    NO_EPOCH,
    NOBODY,
    Identity,
    Register,
    Stamp,
    Standing,
    Wanted,
    is_quorum,
    members_in,
)
from pancakes.durable.register_messages import (
    AskAbout,
    CannotStart,
    Concluded,
    Feed,
    GoodbyeSaid,
    Guarded,
    HostBegan,
    HostEnded,
    Judge,
    Judged,
    OfferRefused,
    PermitOver,
    RegistrarBegan,
    Stands,
)
from pancakes.durable.rules import Lease, Memory, desired
from pancakes.durable.snapshot import Assembly, Snapshot, cut
from pancakes.durable.store import Records, RecordWritten
from pancakes.durable.takeovers import Takeovers
from pancakes.durable.times import Times
from pancakes.errors import MigrationError, RemoteProtocolError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import drop_oldest, on
from pancakes.kernel.mailbox import Reference, tell
from pancakes.mesh.mesh import Mesh
from pancakes.packet import NETWORK, Packet, agent_of
from pancakes.supervision.messages import AskedOfGuardian, PeerDown

KEEP: Final = drop_oldest(1024)
"""What falls out is said again."""
MOST_WAIT: Final = 32
"""At most this many events from other agents wait for the disk, for each task; what falls out is said again."""
ALL_BEATS: Final = 2**62
"""Stands for all leases that may have been granted before a restart."""
INLINE_BYTES: Final = 48 * 1024
"""A larger state travels in pieces."""
MOST_PARTIAL: Final = 16
"""Of at most this many packets of one peer the states are waited for; it sends one after the other."""
TIMES: Final = Times()


class Registrar(ActorCore):
    """Keeps the registers of this agent.

    Args:
        records: what is on disk.
        boots: what is remembered of the boots of other agents.
        mesh: says what neighbours there are.
        state: says what this agent could be to a task.

    Attributes:
        entries: what is kept, by task.
        talk: how it talks to other agents.
        me: this agent as an owner and member of tasks.
    """

    def __init__(
        self, *args: Any, records: Records, boots: BootMemory, mesh: Mesh, state: HostState, **others: Any
    ) -> None:
        super().__init__(*args, **others)
        self.records = records
        self.state = state
        self.talk = PeerTalk(self, mesh)
        self.me = self.talk.me
        self.entries: dict[TaskId, Entry] = {}
        self._deadlines = Deadlines(self.after_host, self.kernel.host.now)
        self.leases = Leases(self, self._deadlines)
        self.takeovers = Takeovers(self)
        self.answers = Answers(self, mesh, boots, self.takeovers)
        self._refused = LastSaid()
        self._assembly = Assembly()
        self._partial: dict[tuple[str, TaskId], Packet] = {}  # what waits for its state, by its sender
        self._judging: dict[int, tuple[TaskId, Fed]] = {}
        self._questions = 0
        self._copied: list[str] = []
        self._goodbyes: dict[str, set[TaskId]] = {}  # the tasks whose members are told that the agent ends, by service
        source = self.kernel.random_for("epochs") if self.kernel.virtual is not None else random.SystemRandom()
        self._draw = source.getrandbits

    def on_start(self) -> None:
        self.began_s = self.kernel.host.now()
        self._copied = self._of_copies()  # told once a service begins: the log service has begun before it
        for record in self.records.all().values():
            entry = self._new(record)
            entry.heard_s = entry.as_of_s = self.began_s
            entry.from_disk = True
            entry.effects.extend(rules.recover(self._place(entry), ALL_BEATS))
            self._go_on(entry)
        for service in self.state.services():
            tell(service, RegistrarBegan())
            self._tell_all(service)

    def _of_copies(self) -> list[str]:
        """Return what this agent is no more, if its disk is a copy: it lacks what was promised since."""
        found: list[str] = []
        for record in self.records.all().values():
            members = [it.agent for it in record.members]
            if not record.guarded or self.me in record.members or self.agent not in members:
                continue
            task_id, others = record.task_id, ", ".join(sorted({*members} - {self.agent})) or "none"
            text = f"{self.agent} guards {task_id} no more: its disk is a copy, and lacks later promises"
            if record.was_ours:
                self.leases.note_copied(record)
                text = (
                    f"{task_id} is paused on {self.agent}, whose disk is a copy: its guardians ({others}) have an agent"
                    f" go on with it; if they are gone, `pancakes task recover {self.agent}/{task_id.name}` does"
                )
            found.append(text)
        return found

    # What services tell ----------------------------------------------------------------------------------------

    def take_message(self, message: Any) -> Any:
        match message:
            case Feed():
                self._fed(message)
            case RecordWritten():
                self._written(message)
            case Guarded() | Concluded() | PermitOver() | CannotStart():
                if (entry := self.entries.get(message.task_id)) is not None:
                    self._told_of(entry, message)
            case Judged():
                self._judged(message)
            case HostBegan():
                while self._copied:
                    self.log("warning", self._copied.pop())
                self._tell_all(message.service)
                self.answers.tell_all(message.service)
            case HostEnded():
                self._host_ended(message)
            case AskAbout():
                self.answers.ask(message.peers, message.task_ids)
            case Imported():
                self.on_may_guard(message.waiting)
            case PeerDown():
                self._assembly.drop(message.peer)
                self._partial = {key: it for key, it in self._partial.items() if key[0] != message.peer}
            case AskedOfGuardian():
                self.takeovers.asked(message)
            case BidAwarded():
                self.takeovers.awarded(message)
            case MoveOver():
                self.takeovers.over(message)
            case NeighbourUp():
                self.answers.met(message.peer, message.boot)
                self.leases.met(message.peer)
            case NetworkBegan():
                self.answers.network_began()
            case _:
                return super().take_message(message)
        return None

    def _told_of(self, entry: Entry, message: Guarded | Concluded | PermitOver | CannotStart) -> None:
        match message:
            case Guarded():
                self.leases.learn(entry, message)
            case Concluded():
                self.feed(entry, Fed(Conclude()))
            case PermitOver():
                self.leases.look_for_end(entry)
            case CannotStart():
                self.leases.close(entry)
                self.settle(entry)

    def _tell_all(self, service: Reference) -> None:
        for entry in self.entries.values():
            if entry.record.service == service.name:
                self.leases.open(entry)
                entry.told = None
                self.settle(entry)

    def _fed(self, fed: Feed) -> None:
        entry = self.known(fed.task_id)
        if entry.again is not None and entry.again.feed is not None:
            entry.outcomes.append((entry.again.feed.token, Outcome.FAILED, "something else was decided since"))
        entry.again, entry.service = None, fed.service
        self.feed(entry, Fed(fed.event, feed=fed))
        self._forget_unused(entry)

    def _host_ended(self, ended: HostEnded) -> None:
        entries = [it for it in self.entries.values() if it.record.service == ended.service]
        entries = [it for it in entries if it.record.owned and it.record.guarded]
        if ended.goodbye:
            self._goodbyes[ended.service] = {it.record.task_id for it in entries}
            for entry in entries:
                self.feed(entry, Fed(rules.Goodbye()))
        for entry in entries:
            self.leases.close(entry)
            self._look_at_goodbyes(entry)

    def _look_at_goodbyes(self, entry: Entry) -> None:
        waiting = self._goodbyes.get(entry.record.service)
        if waiting is None or not entry.idle:
            return
        waiting.discard(entry.record.task_id)
        if not waiting:
            del self._goodbyes[entry.record.service]
            self.tell_service(entry, GoodbyeSaid())

    def tell_service(self, entry: Entry, message: Any) -> bool:
        """Tell the service that looks after a task something; return whether it runs."""
        return bool(entry.record.service) and self.kernel.tell(entry.record.service, message)

    # Dealing with events ---------------------------------------------------------------------------------------

    def known(self, task_id: TaskId, type_name: str = "") -> Entry:
        """Return what is kept of a task, from now on."""
        return self.entries.get(task_id) or self._new(Record(task_id, me=self.me, type=type_name))

    def stop_taking(self, entry: Entry) -> None:
        """Leave a task to others."""
        entry.memory = entry.before = entry.memory._replace(taking=NO_EPOCH, asked=(), promises=())
        self.settle(entry)
        self._forget_unused(entry)

    def _new(self, record: Record) -> Entry:
        entry = Entry(record, self._deadlines.new(partial(self._lease_over, record.task_id)))
        self.entries[record.task_id] = entry
        return entry

    def _forget_unused(self, entry: Entry) -> None:
        """Forget a task of which nothing is known: a peer may make up as many as it likes."""
        if entry.register == BLANK and entry.idle and entry.again is None and entry.memory == Memory():
            self.entries.pop(entry.record.task_id, None)

    def _place(self, entry: Entry) -> rules.Place:
        return rules.Place(self.me, entry.register, entry.memory, entry.lease, self._draw(52))

    def feed(self, entry: Entry, fed: Fed) -> None:
        """Deal with an event, after those that came before it."""
        if fed.peer and sum(bool(it.peer) for it in entry.events) >= MOST_WAIT:
            return
        entry.events.append(fed)
        self._go_on(entry)

    def _go_on(self, entry: Entry) -> None:
        while entry.writing is None:
            if entry.effects:
                self._carry_out(entry, entry.effects.popleft())
            elif entry.events:
                entry.dealing, entry.before = entry.events.popleft(), entry.memory
                entry.effects.extend(self._effects_of(entry, entry.dealing))
                feed = entry.dealing.feed
                if feed is not None and not any(isinstance(it, rules.Persist) for it in entry.effects):
                    why = _too_late(entry.record, feed)
                    entry.outcomes.append((feed.token, Outcome.DECLINED, why))
            else:
                break
        if entry.writing is None:
            entry.dealing = None
        self.settle(entry)

    def _effects_of(self, entry: Entry, fed: Fed) -> list[Any]:
        if isinstance(fed.event, Conclude):
            return [rules.Persist(entry.register)] if entry.record.sequel else []
        if isinstance(fed.event, SayAgain):
            return rules.resend(self._place(entry))
        if fed.feed is not None and _too_late(entry.record, fed.feed):
            return []
        effects = rules.handle(self._place(entry), fed.event)
        if isinstance(fed.event, rules.Known) and entry.held is not None and entry.held.closed:
            takes = any(isinstance(it, rules.Send) and isinstance(it.message, rules.Prepare) for it in effects)
            return [] if takes else effects  # it could not run here: it is left to the agent that was promised it
        return effects

    def _carry_out(self, entry: Entry, effect: Any) -> None:
        match effect:
            case rules.Persist():
                self._persist(entry, effect.register)
            case rules.Remember():
                had, was_behind = entry.memory.permit, entry.memory.behind
                entry.memory = effect.memory
                is_old = entry.dealing is not None and isinstance(entry.dealing.event, rules.Accepted)
                if entry.memory.behind and not was_behind and entry.record.owned and is_old:
                    self._tell_behind(entry)
                if entry.memory.permit != had:
                    self.leases.permit_changed(entry, had)
            case rules.Grant():
                self._grant(entry, effect.lease)
            case rules.Send():
                self._send(entry, effect.message)
            case rules.Counts():
                self._counts(entry, effect.register)
            case rules.Ask():
                peer = entry.dealing.peer if entry.dealing is not None else ""
                self.answers.confirm(entry, effect.message, peer, entry.dealing)

    def _persist(self, entry: Entry, register: Register) -> None:
        before, fed = entry.record, entry.dealing
        record = replace(before, register=register, me=self.me, gave=_given(self.me, before, register))
        feed, accept = (fed.feed, fed.accept) if fed is not None else (None, None)
        if feed is not None:
            record = replace(record, service=feed.service)
        elif not record.service and register.owner == self.me:
            record = replace(record, service=entry.service)
        if accept is not None and register.stamp == accept.register.stamp:
            service = accept.service if register.heir == self.me else record.service
            record = replace(record, type=accept.type, lease_s=accept.lease_s, service=service)
        if feed is not None and isinstance(feed.event, rules.Offer | rules.Want):
            record = replace(record, sequel=feed.sequel)
        elif fed is not None and (isinstance(fed.event, Conclude) or _is_taken_back(self.me, register)):
            record = replace(record, sequel=b"")  # after a restart its service accounts for it first
        if not record.type and register.state:
            record = replace(record, type=_type_of(register.state))
        if register.owner == self.me and before.register.owner not in (self.me, NOBODY):
            entry.former = before.register.owner
        entry.writing = record
        may = self.leases.may_write(entry) if feed is not None and feed.is_checkpoint else None
        self.records.write(record, self, may)

    def _written(self, written: RecordWritten) -> None:
        entry = self.entries[written.task_id]
        record, entry.writing = entry.writing, None
        fed, feed = entry.dealing, entry.dealing.feed if entry.dealing is not None else None
        if record is None:
            return
        if written.why_not:
            entry.effects.clear()  # as after a crash: nothing that follows it happens, ...
            had = entry.memory.permit
            entry.memory = entry.before._replace(permit=min(had, entry.before.permit))  # ... and nothing has before
            if entry.memory.permit != had:
                self.leases.permit_changed(entry, had)
            if feed is not None and fed is not None and _is_tried_again(feed.event):
                entry.again = fed
                entry.outcomes.append((feed.token, Outcome.DELAYED, written.why_not))
                self.after_host(TIMES.retry_write_s, partial(self._try_again, entry, fed))
            elif feed is not None:
                entry.outcomes.append((feed.token, Outcome.FAILED, written.why_not))
            self._go_on(entry)
            return
        before, entry.record = entry.record, record
        if (before.epoch, before.owned) != (record.epoch, record.owned):
            stays = record.owned or record.removed
            kept = [it for it in entry.waits if stays and it[0][0] == record.epoch]
            entry.outcomes += [(it[1], Outcome.LAPSED, "") for it in entry.waits if it not in kept]
            entry.waits = kept
        if feed is not None:
            entry.outcomes.append((feed.token, Outcome.WRITTEN, ""))
            entry.waits.append((record.register.stamp, feed.token))
            entry.dealing = Fed(None)  # a second write that follows is not the service's
        if record.owned and (not before.owned or before.epoch != record.epoch):
            self.answers.tell_owned(entry)
            self._note_taken(entry, before)
        elif before.standing is Standing.HEIR and not record.here and record.peer != before.peer:
            text = f"{record.task_id} runs on {record.peer}: what {before.peer} has sent of it is dropped"
            self.log("info", text)
        self._go_on(entry)

    def _note_taken(self, entry: Entry, before: Record) -> None:
        """Tell people that this agent has taken a task over, and from which one."""
        promises = [it.register for it in entry.memory.promises]
        if before.standing is Standing.HEIR or not promises:
            return
        owner = max([before.register, *promises], key=lambda it: it.stamp).owner.agent
        self.event("task_taken", task=entry.record.task_id.name, source_agent=owner, epoch=entry.record.epoch.n)
        entry.taken_from = owner if owner != self.agent else ""

    def _tell_behind(self, entry: Entry) -> None:
        task_id = entry.record.task_id
        self.log(
            "error",
            f"the disk of {self.agent} is an old copy: the guardians of {task_id} have a later checkpoint, and have an"
            " agent go on from that",
        )
        self.event("disk_is_old", task=task_id.name)

    def _try_again(self, entry: Entry, fed: Fed) -> None:
        if entry.again is fed:
            entry.again = None
            self.feed(entry, fed)

    def _counts(self, entry: Entry, register: Register) -> None:
        entry.counted = max(entry.counted, register.stamp)
        done = [it for it in entry.waits if it[0] <= register.stamp and it[0][0] == register.epoch]
        if done:
            entry.waits = [it for it in entry.waits if it not in done]
            entry.outcomes += [(token, Outcome.COUNTS, "") for _, token in done]

    def settle(self, entry: Entry) -> None:
        """Look after what follows from how a task stands now, and tell its service."""
        record = entry.record
        self.leases.look(entry)
        self._remind(entry)
        self._look_at_goodbyes(entry)
        wanted = desired(self.me, entry.register, entry.memory)
        if entry.told == (record, wanted) and not entry.outcomes:
            return
        outcomes = tuple(entry.outcomes)
        service = record.service or entry.service
        stands = Stands(record.task_id, record, wanted, outcomes, entry.taken_from)
        if not service or not self.kernel.tell(service, stands):
            entry.told = None
        else:
            entry.told, entry.taken_from = (record, wanted), ""
        entry.outcomes.clear()

    def _remind(self, entry: Entry) -> None:
        """See to it that what may have been lost is said again."""
        about = (entry.record.standing, entry.register.stamp) if rules.resend(self._place(entry)) else None
        if about == entry.reminded:
            return
        if entry.reminder is not None:
            entry.reminder.cancel()
        entry.reminder, entry.reminded, entry.attempt = None, about, 0
        if about is not None:
            self._remind_later(entry)

    def _remind_later(self, entry: Entry) -> None:
        pause_s = TIMES.pause_s(entry.attempt)
        if entry.record.standing is Standing.OFFERED:  # a large state gets the time that it needs
            pause_s += TIMES.transfer_s(len(entry.record.snapshot))
        pause_s *= self.random.uniform(1.0 - TIMES.spread, 1.0 + TIMES.spread)
        entry.reminder = self.after_host(pause_s, partial(self._due, entry, entry.reminded))

    def _due(self, entry: Entry, about: tuple[Standing, Stamp] | None) -> None:
        if entry.reminded != about or about is None:
            return
        entry.attempt += 1
        self._remind_later(entry)
        if entry.idle:
            self.feed(entry, Fed(SayAgain()))

    # Leases that are granted here ------------------------------------------------------------------------------

    def _grant(self, entry: Entry, lease: Lease) -> None:
        ran, entry.lease = entry.lease.beat > 0, lease
        if lease.beat:
            accept = entry.dealing.accept if entry.dealing is not None else None
            entry.alarm.set(accept.lease_s if accept is not None else entry.record.lease_s)
            if accept is not None:
                entry.heard_s = self.kernel.host.now()
            self.takeovers.lease_runs(entry, lease.epoch)
        else:
            entry.alarm.cancel()
            if ran or entry.dealing is not None:
                self.takeovers.lease_ended(entry, promised=True)
        self.note_shortest(entry if lease.beat else None)

    def _lease_over(self, task_id: TaskId) -> None:
        entry = self.entries[task_id]
        entry.lease = entry.lease._replace(beat=0)
        self.takeovers.lease_ended(entry, promised=False)
        self.note_shortest()

    def note_shortest(self, granted: Entry | None = None) -> None:
        """Keep true for how long this agent may be silent; of a lease that was granted it is mostly true already."""
        shortest = self.state.shortest_lease
        if granted is not None and shortest is not None and shortest.task_id != granted.record.task_id:
            if shortest.lease_s <= granted.record.lease_s:
                return
        leased = [it.record for it in self.entries.values() if it.lease.beat]
        self.state.shortest_lease = min(leased, key=lambda it: (it.lease_s, it.task_id), default=None)

    # Sending ---------------------------------------------------------------------------------------------------

    def _send(self, entry: Entry, message: Any) -> None:
        task_id, kind = entry.record.task_id, entry.record.type
        match message:
            case rules.Accept():
                self._send_accept(entry, message)
            case rules.Accepted():
                owner = message.epoch.minter
                if owner == self.me:
                    self.feed_later(entry, Fed(message))
                else:
                    told = entry.newest_told[1] if entry.newest_told[0] == message.epoch else -1
                    self.talk.to(owner, messages.Accepted(task_id, *message, told))
            case rules.Prepare():
                for member in members_in(message.sets):
                    if member != self.me:
                        self.talk.to(member, messages.Prepare(task_id, kind, *message))
                    elif entry.register != BLANK or entry.memory.promises:
                        # A task that a caller has made up is to leave nothing here: another member promises it first.
                        self.feed_later(entry, Fed(message))
            case rules.Promise():
                taker = message.epoch.minter
                if taker == self.me:
                    self.feed_later(entry, Fed(message))
                else:
                    register, state = message.register.summary(), message.register.state
                    if register.unguarded and _held_by_asker(entry.dealing) == register.stamp:
                        state = None
                    pieces = state is not None and len(state) > INLINE_BYTES
                    promise = messages.Promise(task_id, message.epoch, message.by, register, pieces=pieces)
                    self._send_with_state(taker, promise, state)
            case rules.Known():
                peer = entry.dealing.peer if entry.dealing is not None else ""
                if peer and peer != self.agent:
                    self.answers.say(peer, [entry])
                elif not peer and entry.dealing is not None:
                    self.feed_later(entry, Fed(message))

    def feed_later(self, entry: Entry, fed: Fed) -> None:
        """Deal with a message of this agent to itself, after what is being carried out."""
        entry.events.appendleft(fed)

    def _send_accept(self, entry: Entry, message: rules.Accept) -> None:
        register = message.register
        if message.to != NOBODY:
            receivers = [message.to]
        elif _goes_to_heir_alone(register):
            receivers = [register.heir]
        else:
            heir = [register.heir] if register.heir not in (NOBODY, ANYONE) else []
            receivers = [*dict.fromkeys([*heir, *entry.record.members, entry.former])]
        for receiver in receivers:
            if receiver in (self.me, NOBODY):
                continue
            state, age_s = self.leases.state_for(entry, receiver, register, message.beat)
            accept = messages.Accept(
                entry.record.task_id,
                entry.record.type,
                entry.record.service,
                register.summary(),
                message.beat,
                entry.record.lease_s,
                message.to,
                age_s=age_s,
            )
            self._send_with_state(receiver, accept, state)
        if message.to == NOBODY and register.heir == NOBODY:
            entry.former = NOBODY

    def _send_with_state(
        self, receiver: Identity, body: messages.Accept | messages.Promise, state: bytes | None
    ) -> None:
        """Send a message with a state, in pieces if that is large."""
        if state is None or len(state) <= INLINE_BYTES:
            self.talk.to(receiver, replace(body, state=state))
            return
        self.talk.to(receiver, body)
        for piece in cut(body.task_id, body.register.stamp, state):
            self.talk.to(receiver, piece)

    # What other agents say -------------------------------------------------------------------------------------

    @on(NETWORK, messages.Accept, queue=KEEP, addressed=True)
    def on_accept(self, packet: Packet) -> None:
        """The owner of a task says what it has written."""
        body: messages.Accept = packet.body
        peer = agent_of(packet.source)
        if not is_for(body, self.me.journal) or body.register.state is not None:
            return
        is_offer = body.register.heir == self.me
        if fault := self._fault_of_owner(peer, body):
            if self._refused.is_news(peer, fault):
                self.log("warning", f"{self.agent} does not keep {body.task_id} for {peer}: {fault}")
            if is_offer:
                self._decline(peer, body, Refusal("unable", fault))
            return
        if self.me in body.register.members and not is_offer and body.task_id not in self.entries:
            self.takeovers.origins.judge(packet, self._accept)  # anybody may make up a task that is not known here
        else:
            self._accept(packet, None)

    def _accept(self, packet: Packet, refusal: Refusal | None) -> None:
        body, peer = packet.body, agent_of(packet.source)
        if refusal is not None:
            if self._refused.is_news(peer, refusal.text):
                self.log("warning", f"{self.agent} does not keep {body.task_id} for {peer}: {refusal.text}")
            return
        entry = self.entries.get(body.task_id)
        register, state = body.register, body.state
        own = entry.register if entry is not None else BLANK
        if state is None and own.stamp == register.stamp:
            state = own.state
        if state is None and register.wanted.value != "removed" and register.stamp > own.stamp:
            self._wait_for_pieces(peer, packet)
            if register.heir == self.me:
                return
        self._take_accept(peer, body, state)

    def _take_accept(self, peer: str, body: messages.Accept, state: bytes | None) -> None:
        entry = self.known(body.task_id)
        register, is_removed = body.register, body.register.wanted.value == "removed"
        whole = state is not None or is_removed
        event = rules.Accept(register._replace(state=state), body.beat, body.to, whole)
        entry.newest_told = max(entry.newest_told, register.stamp)
        fed = Fed(event, peer, accept=body)
        if register.heir == self.me and entry.register.stamp < register.stamp and state is not None:
            self._judge(entry, fed, body, state)
            return
        if state is not None and register.stamp >= entry.register.stamp:
            entry.as_of_s, entry.from_disk = self.kernel.host.now() - body.age_s, False
        self.feed(entry, fed)
        self._forget_unused(entry)

    def _wait_for_pieces(self, peer: str, packet: Packet) -> None:
        self._partial[peer, packet.body.task_id] = packet
        theirs = [key for key in self._partial if key[0] == peer]
        for key in theirs[:-MOST_PARTIAL]:
            del self._partial[key]

    @on(NETWORK, messages.Piece, queue=KEEP, addressed=True)
    def on_piece(self, packet: Packet) -> None:
        """A part of a large state has come."""
        peer, body = agent_of(packet.source), packet.body
        waiting = self._partial.get((peer, body.task_id))
        if waiting is None or not is_for(body, self.me.journal) or waiting.body.register.stamp != body.stamp:
            return
        try:
            state = self._assembly.add(peer, body)
        except RemoteProtocolError as error:
            self.log("warning", str(error))
            if isinstance(waiting.body, messages.Accept) and waiting.body.register.heir == self.me:
                self._decline(peer, waiting.body, Refusal("invalid", str(error)))
            return
        if state is None:
            return
        del self._partial[peer, body.task_id]
        if isinstance(waiting.body, messages.Accept):
            self._take_accept(peer, waiting.body, state)
        else:
            self._take_promise(peer, waiting.body, state)

    def _judge(self, entry: Entry, fed: Fed, body: messages.Accept, state: bytes) -> None:
        """Have the service say whether a task that is offered can run here, before it is put on disk."""
        task_id = body.task_id
        under_way = [it for known, it in self._judging.values() if known == task_id]
        under_way += [it for it in (entry.dealing, *entry.events) if it is not None]
        if any(it.accept is not None and it.accept.register.stamp == body.register.stamp for it in under_way):
            return  # it was said again meanwhile
        self._questions += 1
        self._judging[self._questions] = (task_id, fed)
        if not self.kernel.tell(body.service, Judge(self._questions, fed.peer, task_id, state)):
            self._judged(Judged(self._questions, Refusal("unsupported", f"runs no service {body.service!r}")))

    def _judged(self, judged: Judged) -> None:
        task_id, fed = self._judging.pop(judged.number, (None, None))
        if task_id is None or fed is None or fed.accept is None:
            return
        # It may have been forgotten meanwhile, as another offer of it was declined.
        entry = self.known(task_id)
        if judged.refusal is not None:
            self._decline(fed.peer, fed.accept, judged.refusal)
            self._forget_unused(entry)
        else:  # the whereabouts of the task were asked before room was kept for it
            self.feed(entry, replace(fed, event=rules.Confirmed(fed.event)))

    def _decline(self, peer: str, body: messages.Accept, refusal: Refusal) -> None:
        self.talk.say(peer, REGISTRAR, messages.Refuse(body.task_id, body.register.no, refusal))

    @on(NETWORK, messages.Refuse, queue=KEEP, addressed=True)
    def on_refuse(self, packet: Packet) -> None:
        """An heir declines what it was offered."""
        body, peer = packet.body, agent_of(packet.source)
        entry = self.entries.get(body.task_id)
        if entry is None or not is_for(body, self.me.journal):
            return
        register = entry.register
        if entry.record.standing is Standing.OFFERED and (register.heir.agent, register.no) == (peer, body.ask):
            self.tell_service(entry, OfferRefused(body.task_id, peer, body.refusal))
            self.feed(entry, Fed(rules.GiveUp(), peer))

    @on(NETWORK, messages.Accepted, queue=KEEP, addressed=True)
    def on_accepted(self, packet: Packet) -> None:
        """A member or heir has a write."""
        body, peer = packet.body, agent_of(packet.source)
        entry = self.entries.get(body.task_id)
        if entry is None or body.by.agent != peer or not is_for(body, self.me.journal):
            return
        no = max(body.no, body.told) if body.told > entry.register.no else body.no
        self.leases.heard(entry, body)
        self.feed(entry, Fed(rules.Accepted(body.epoch, body.by, body.beat, no), peer))

    @on(NETWORK, messages.Prepare, queue=KEEP, addressed=True)
    def on_prepare(self, packet: Packet) -> None:
        """An agent asks for a promise."""
        body, peer = packet.body, agent_of(packet.source)
        if not is_for(body, self.me.journal) or body.epoch.minter.agent != peer:
            return
        entry = self.entries.get(body.task_id)
        kind = entry.record.type if entry is not None and entry.record.type else body.type
        offered = entry is not None and entry.register.owner == self.me and entry.register.heir.agent == peer
        if not offered and (fault := self.kernel.access.fault(peer, "host", kind)):
            if self._refused.is_news(peer, fault):
                self.log("warning", f"{peer} is not promised {body.task_id}: {fault}")
            return
        if entry is None and self._full_of(peer, body.task_id, GUARDED, 0):
            return
        if self.records.lost(body.task_id) is not None:
            return  # it may have promised the task to another agent, and have forgotten that
        entry = self.known(body.task_id, body.type)
        self.feed(entry, Fed(rules.Prepare(body.epoch, body.held, body.sets), peer))
        self._forget_unused(entry)

    @on(NETWORK, messages.Promise, queue=KEEP, addressed=True)
    def on_promise(self, packet: Packet) -> None:
        """A member has promised a task to this agent."""
        body, peer = packet.body, agent_of(packet.source)
        entry = self.entries.get(body.task_id)
        if entry is None or body.by.agent != peer or not is_for(body, self.me.journal):
            return
        state = body.state
        if body.pieces and entry.register.stamp == body.register.stamp:
            state = entry.register.state
        if body.pieces and state is None:
            self._wait_for_pieces(peer, packet)
            return
        self._take_promise(peer, body, state)

    def _take_promise(self, peer: str, body: messages.Promise, state: bytes | None) -> None:
        entry = self.entries.get(body.task_id)
        if entry is None:
            return
        if state is not None:
            try:
                if Snapshot.decode(state).task_id != body.task_id:
                    raise MigrationError("it is of another task")
            except MigrationError as error:
                self.log("warning", f"the promise of {peer} for {body.task_id} does not count: {error}")
                return
        self.feed(entry, Fed(rules.Promise(body.epoch, body.by, body.register._replace(state=state)), peer))

    @on(NETWORK, messages.WhoHas, queue=KEEP, addressed=True)
    def on_who_has(self, packet: Packet) -> None:
        """Somebody asks what this agent knows of tasks."""
        self.answers.asked(packet)

    @on(NETWORK, messages.Known, queue=KEEP, addressed=True)
    def on_known(self, packet: Packet) -> None:
        """Another agent says what it knows of tasks."""
        self.takeovers.origins.told(packet)
        self.answers.told(packet)

    @on(NETWORK, messages.BootRemembered, queue=KEEP, addressed=True)
    def on_boot(self, packet: Packet) -> None:
        """Another agent takes this one's disk for an old copy."""
        self.answers.boot_remembered(packet)

    @on(NETWORK, messages.Call, queue=KEEP, addressed=True)
    def on_call(self, packet: Packet) -> None:
        """A member has this agent take a task whose owner is silent."""
        self.takeovers.called(packet)

    @on(NETWORK, messages.MayGuard, queue=KEEP, addressed=True)
    def on_may_guard(self, packet: Packet) -> None:
        """The owner of a task looks for members."""
        asked, peer = packet.body, agent_of(packet.source)
        if not is_for(asked, self.me.journal):
            return
        if self.state.hosts() and self.state.imports_first(self, peer, asked.type, packet):
            return
        access = self.kernel.access
        refusal = access.fault(peer, "guard", asked.type) or access.fault(peer, "host", asked.type)
        if not refusal and self.records.lost(asked.task_id) is not None:
            refusal = f"{self.agent} has lost what it knew of it"
        answer = messages.CanGuard(
            asked.task_id,
            self.me,
            refusal,
            not refusal and self.state.runs(asked.type),
            "battery" in self.kernel.registry.device_types(),
            self.kernel.host.now() - self.began_s,
        )
        self.talk.say(peer, packet.source.partition("/")[2], answer)

    @on(NETWORK, messages.CanGuard, queue=KEEP, addressed=True)
    def on_can_guard(self, packet: Packet) -> None:
        """A neighbour says whether it would guard a task."""
        body, peer = packet.body, agent_of(packet.source)
        entry = self.entries.get(body.task_id)
        if entry is not None and body.guardian.agent == peer and is_for(body, self.me.journal):
            self.leases.can_guard(entry, body)

    # Who may say what ------------------------------------------------------------------------------------------

    def _fault_of_owner(self, peer: str, body: messages.Accept) -> str:
        """Return why a peer is not believed to own a task, or may not keep it here, as a clause; empty: it may."""
        register, known = body.register, self.entries.get(body.task_id)
        if register.owner.agent != peer:
            return f"the epoch {register.epoch} is not of its making, and each agent speaks only for itself"
        if known is not None and known.record.type not in ("", body.type):
            return f"it is a {known.record.type}, and no {body.type}"
        if known is not None and known.record.standing is Standing.YIELDED and known.record.gave == peer:
            return ""  # it was given the task, whatever it may bring here
        access = self.kernel.access
        if fault := access.fault(peer, "host", body.type):
            return fault
        is_member = self.me in register.members and register.heir != self.me
        if is_member and (fault := access.fault(peer, "guard", body.type)):
            return fault
        if self.me in register.members and self.records.lost(body.task_id) is not None:
            return f"{self.agent} has lost what it knew of it, and may have forgotten a promise"
        size = len(body.state) if body.state is not None else 0
        if register.heir == self.me:
            return self._full_of(peer, body.task_id, IN_DOUBT, size)
        if not is_member or (known is not None and _takes_no_more(known.record, peer, body)):
            return ""
        return self._full_of(peer, body.task_id, GUARDED, size)

    def _full_of(self, peer: str, task_id: TaskId, kind: str, size: int) -> str:
        others = [it.record for it in self.entries.values() if it.record.task_id != task_id]
        return fault_of_room(peer, kind, others, size)


def _takes_no_more(record: Record, peer: str, news: messages.Accept) -> bool:
    """Return whether a task that is guarded for a peer takes no more room than before, as after most news of it."""
    if record.standing is not Standing.MEMBER or record.seen.minter.agent != peer:
        return False
    if news.state is None:  # it may come in pieces
        return news.register.stamp <= record.register.stamp
    return len(news.state) <= len(record.snapshot)


def _too_late(record: Record, feed: Feed) -> str:
    """Return why a state of a task's actor is not written any more, as a clause; empty: it may be."""
    has_state = isinstance(feed.event, rules.Save | rules.Want | rules.Offer) and feed.event.state is not None
    return "it was away meanwhile" if has_state and feed.epoch != record.epoch else ""


def _is_taken_back(me: Identity, register: Register) -> bool:
    """Return whether this write takes back an offer, if there was one. What follows a stop stays until it is done."""
    stays = register.owner == me and register.heir == NOBODY and register.promised <= register.epoch
    return stays and register.wanted is not Wanted.STOPPED


def _is_tried_again(event: Any) -> bool:
    """Return whether what a service fed is tried again by itself if it cannot be written."""
    if isinstance(event, rules.Want):
        return event.wanted is not Wanted.REMOVED
    return isinstance(event, rules.Begin)


def _goes_to_heir_alone(register: Register) -> bool:
    """Return whether only the heir is sent an offer: a large state takes long to send, and the task is paused.

    The heir needs no promise but the owner's, and gives the state to the other members once it owns the task.
    """
    if register.heir in (NOBODY, ANYONE) or len(register.state or b"") <= INLINE_BYTES:
        return False
    return is_quorum(register.sets, {register.owner, register.heir})


def _held_by_asker(fed: Fed | None) -> Stamp | None:
    """Return the newest write of the agent that asks for a promise, which an heir has with its state; None: unknown."""
    event = fed.event if fed is not None else None
    prepare = event.message if isinstance(event, rules.Confirmed) else event
    return prepare.held if isinstance(prepare, rules.Prepare) else None


def _given(me: Identity, before: Record, register: Register) -> str:
    """Return the agent to which this one gave the task last, once this is written; empty: none.

    After that it follows only what the members of the task decide, if it is one.
    """
    if register.owner == me:
        return register.promised.minter.agent if register.promised > register.epoch else ""
    is_member = before.gave != "" and me in before.register.members
    return register.owner.agent if before.register.owner == me or is_member else before.gave


def _type_of(state: bytes) -> str:
    try:
        return Snapshot.decode(state).type
    except MigrationError:
        return ""
