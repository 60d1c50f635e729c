"""The guarded tasks of a service: renews leases, grants permits to act, replaces guardians, and takes tasks over.

`Leases` asks the guardians of each owned task for leases, and lets the task act while more than half of them agree.
`Takings` asks them for pledges if this agent is to take a task. The rules are in `guarding`. All in the service's
actor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Final

from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable import guarding as rules
from pancakes.durable.checkpoints import Checkpointing, Deliveries, rules_of
from pancakes.durable.guarding import (
    GuardNote,
    Seizing,
    Tenure,
    answered,
    asked_again,
    begun,
    conclusion,
    keep_lease,
    kept_packets,
    may_ask,
    yield_lease,
)
from pancakes.durable.handoff import is_checkpoint, is_disputed
from pancakes.durable.handoff_events import ClaimHeard, GuardsChosen, PacketId, PermitGiven, Seize
from pancakes.durable.hosting import Deadlines, HostingService, LastSaid, OtherOwner, PeerTalk, Place, Taking, Tenancy
from pancakes.durable.messages import (
    MOST_AGE_S,
    NO_CHECKPOINT,
    CanGuard,
    CheckpointId,
    DenyLease,
    GuardAnswer,
    KeepLease,
    LeaseKept,
    MayGuard,
    Pledge,
    TakeTask,
    choose,
    is_for,
)
from pancakes.durable.ownership_checks import Disputes, Origins
from pancakes.durable.record import NO_EPOCH, NO_GUARDS, GuardianId, Guards, Phase, Record, TaskId, forgotten_guards
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.state_machine import Standing, idle
from pancakes.durable.store import Records
from pancakes.errors import MigrationError
from pancakes.journal import May
from pancakes.kernel.mailbox import tell
from pancakes.migration import PERMIT_SHARE, RENEWED, GuardRule
from pancakes.packet import Fence, Packet, agent_of, join
from pancakes.supervision.lifecycle import State
from pancakes.supervision.messages import GUARDIAN, GoOn


class GuardedLooks:
    """Looks at guarded tasks. All in the service's actor.

    Their checkpoints share packets, and rounds of the disk.

    Args:
        host: the service.
        held: the places of its guarded tasks, which change.
        save: has tasks written down where they have changed, by name.
    """

    def __init__(self, host: HostingService, held: Iterable[Place], save: Callable[[Sequence[str]], None]) -> None:
        self._host = host
        self._held = held
        self._save = save
        self._periods: set[float] = set()

    def begin(self, place: Place) -> None:
        """Looks at a task now."""
        self._look_at([place])

    def go_on(self, place: Place) -> None:
        """Looks at a task again and again; its period may be another one since."""
        assert place.tenancy is not None
        every_s = place.tenancy.checkpoint_s
        if every_s in self._periods:
            return
        self._periods.add(every_s)
        to_next_s = every_s - self._host.kernel.host.now() % every_s
        if to_next_s < every_s / 2:  # it may be next to nothing, as numbers are rounded
            to_next_s += every_s
        self._host.after_host(to_next_s, partial(self._look_at_all, every_s))

    def _look_at_all(self, every_s: float) -> None:
        self._periods.discard(every_s)
        places = [it for it in self._held if it.tenancy is not None and it.tenancy.checkpoint_s == every_s]
        self._look_at(places)
        if places:
            self.go_on(places[0])

    def _look_at(self, places: Sequence[Place]) -> None:
        self._save([place.slot.name for place in places if place.slot is not None])
        for place in places:
            self._look_at_actuators(place)

    def _look_at_actuators(self, place: Place) -> None:
        slot, tenancy = place.slot, place.tenancy
        if slot is None or tenancy is None:
            return
        unsafe = frozenset(self._host.kernel.registry.without_dead_man(slot.address))
        for device in sorted(unsafe - tenancy.unsafe):
            self._host.log(
                "warning",
                f"{slot.address} is guarded and commands {device}, whose hardware does not hold by itself: where this"
                " process is stopped or killed, it keeps its last command",
            )
            self._host.event("no_dead_man", task=slot.name, device=device)
        tenancy.unsafe = unsafe


REPLACED_S: Final = 60.0
"""A guardian that has said nothing for so long is replaced where there is another one, in host time."""
CHOOSE_S: Final = 1.0
ASK_AGAIN_S: Final = 2.0
ANSWERED_S: Final = 0.2
"""So long the owner waits for what its neighbours say when it chooses guardians."""
OWNED: Final = (Phase.OWNER, Phase.FROZEN)
STOP_HEARD_S: Final = 4.0
"""So long a stop waits for the task's guardians, in host time."""
REMEMBERED: Final = 16
"""So many askings may be under way; a lease that was granted on an older one is as good as over."""


class Leases:
    """Looks after the permits of one service's tasks. All in that service's actor.

    Args:
        host: the service.
        talk: how it talks to guardians.
        records: say which tasks the original of this disk owned, where it is a copy.
        save: has tasks written down, by name.
        on_disk: acknowledges a packet.
        outvoted: learns that the guardians of a task follow another owner.
    """

    def __init__(
        self,
        host: HostingService,
        talk: PeerTalk,
        records: Records,
        save: Callable[[Sequence[str]], None],
        on_disk: Callable[[Place, PacketId], None],
        outvoted: Callable[[Place, OtherOwner], None],
    ) -> None:
        self._host = host
        self._talk = talk
        self._records = records
        self._on_disk = on_disk
        self._outvoted = outvoted
        self._held: list[Place] = []
        self._choosing = False
        self._looks = GuardedLooks(host, self._held, save)
        self._deadlines = Deadlines(host.after_host, host.kernel.host.now)

    def begin(self, places: Iterable[Place]) -> None:
        """Looks at the guardians of all tasks from now on; `places`: those of which there is a record."""
        for place in list(places):
            self.look(place)

    def permits(self, place: Place) -> bool:
        """Returns whether a guarded task may act now."""
        return place.tenancy is not None and self._host.kernel.permits.may_act(_right(place))

    def look(self, place: Place) -> None:
        """The record of a task may have changed: asks for leases, or no longer."""
        record, permits = place.standing.record, self._host.kernel.permits
        owned, disputed = record.phase in OWNED, is_disputed(record)
        if owned and record.guarded and not disputed:
            if place.tenancy is None:
                self._begin(place)
            elif permits.begin(_right(place)):
                place.permit = False
            assert place.tenancy is not None
            if place.tenancy.told != (record.epoch, record.no, record.guards.version):
                self._renew(place)
            return
        if place.tenancy is not None:
            if disputed:  # the other owner gets no lease before this one's is over, and it acts no more
                self._renew(place)
            tenure = place.tenancy.tenure
            if record.removed:
                self._dismiss(place, place.tenancy)
            self._end(place)
            if record.phase is Phase.COMMITTED or disputed:
                self._yield(record, tenure, given=True)
        if record.phase is Phase.OWNER and not disputed:
            permits.free(str(place.task_id))
            slot = place.slot
            if slot is not None and slot.spec.guard is not None and idle(place.standing):
                self._host.feed_place(place, GuardsChosen(((self._talk.me,),)))

    def close(self) -> None:
        """The service ends: its tasks act no more, and where the agent ends, others may take them at once."""
        for place in list(self._held):
            record = place.standing.record
            self._renew(place)
            assert place.tenancy is not None
            tenure = place.tenancy.tenure
            self._end(place)
            if self._host.kernel.stopping:
                self._yield(record, tenure, given=False)

    def _yield(self, record: Record, tenure: Tenure, given: bool) -> None:
        """Tells the guardians that the task acts no more here: they believe only its owner."""
        for guardian in record.guards.members():
            self._talk.to_guardian(guardian, yield_lease(tenure, record, guardian, given))

    def _begin(self, place: Place) -> None:
        now_s, original = self._host.kernel.host.now(), self._records.original_epoch(place.task_id)
        if self._talk.me in place.standing.record.guards.members():
            original = NO_EPOCH  # it was not guarded there
        place.tenancy = Tenancy(
            tenure=begun(self._talk.boot, now_s, original),
            lost_s=now_s,
            renewal=self._deadlines.new(partial(self._renew, place)),
            end=self._deadlines.new(partial(self._look_for_end, place)),
        )
        self._held.append(place)
        if not self._choosing:
            self._choosing = True
            self._host.after_host(CHOOSE_S, self._choose_all)
        self._learn_rule(place)
        self._host.kernel.permits.revoke(_right(place))
        self._looks.begin(place)
        if not may_ask(place.tenancy.tenure, place.standing.record):
            self._note(place, place.tenancy)
            self._tell_copied(place)

    def _end(self, place: Place) -> None:
        assert place.tenancy is not None
        place.tenancy.cancel()
        place.tenancy, place.permit = None, False
        self._held.remove(place)
        self._host.kernel.guard_notes.drop(self._address(place))
        self._host.kernel.permits.revoke(_right(place))

    def _dismiss(self, place: Place, tenancy: Tenancy) -> None:
        """Tells all guardians that a task was removed, also those that another set has replaced."""
        epoch, beat = place.standing.record.epoch, tenancy.tenure.beat
        forgotten = forgotten_guards(epoch)
        keep = KeepLease(place.task_id, tenancy.type, epoch, beat, tenancy.lease_s, NO_CHECKPOINT, forgotten)
        for guardian in tenancy.heard_s:
            self._talk.to_guardian(guardian, keep)

    def _learn_rule(self, place: Place) -> None:
        tenancy = place.tenancy
        assert tenancy is not None
        tenancy.rule = self.rule_of(place)
        self._looks.go_on(place)
        if place.slot is not None:
            tenancy.type = place.slot.spec.type
        elif not tenancy.type:
            try:
                tenancy.type = Snapshot.decode(place.standing.record.snapshot).type
            except MigrationError as error:
                self._host.log("error", f"{place.task_id} cannot be guarded: {error}")

    def rule_of(self, place: Place, snapshot: bytes = b"") -> GuardRule | None:
        """Returns how a task is guarded; None: it is not. `snapshot`: where its record has none."""
        if place.removal is not None:
            return None  # its guardians are to let go of it
        if place.slot is not None:
            rule: GuardRule | None = place.slot.spec.guard
            return rule
        try:
            return rules_of(snapshot or place.standing.record.snapshot, place.task_id)[1].guard
        except MigrationError:
            return None

    # Asking ----------------------------------------------------------------------------------------------------

    def _renew(self, place: Place) -> None:
        """Asks all guardians of a task for a lease."""
        tenancy, record = place.tenancy, place.standing.record
        if tenancy is None or not may_ask(tenancy.tenure, record):
            return
        if tenancy.tenure.epoch != record.epoch:
            tenancy.as_of_s = {}
        self._learn_rule(place)
        if place.permit and not self.permits(place):
            self._lost(place, tenancy)
            return
        tenancy.tenure = tenure = asked_again(tenancy.tenure, record)
        # The clock is read before anything is sent: a lease begins later, so it ends later.
        tenancy.until[tenure.beat] = self._host.kernel.permits.moment().later(PERMIT_SHARE * tenancy.lease_s)
        tenancy.until.pop(tenure.beat - REMEMBERED, None)
        tenancy.told = (record.epoch, record.no, record.guards.version)
        self._note(place, tenancy)
        age_s = min(max(0.0, self._host.kernel.host.now() - tenancy.as_of_s[record.no]), MOST_AGE_S)
        for guardian in sorted(record.guards.members(), key=lambda one: one != self._talk.me):
            with_body = self._lacks_body(tenancy, guardian, record.no)
            keep = keep_lease(tenure, record, tenancy.type, tenancy.lease_s, with_body)
            self._talk.to_guardian(guardian, replace(keep, age_s=age_s))
        tenancy.renewal.set(tenancy.lease_s / RENEWED)

    def _note(self, place: Place, tenancy: Tenancy) -> None:
        """Notes what is known of its guardians, for others on this agent."""
        now_s, record = self._host.kernel.host.now(), place.standing.record
        known_s, slot = tenancy.as_of_s, place.slot
        if idle(place.standing) or record.no not in known_s:
            known_s[record.no] = place.looked_s if slot is not None and slot.task is not None else now_s
        while len(known_s) > REMEMBERED:
            del known_s[next(iter(known_s))]
        for one in record.guards.members():
            tenancy.heard_s.setdefault(one, now_s)
        note = GuardNote(
            _right(place),
            tenancy.number,
            tenancy.lease_s,
            record.guards,
            tenancy.tenure,
            dict(tenancy.heard_s),
            dict(known_s),
        )
        self._host.kernel.guard_notes.enter(self._address(place), note)

    def _lacks_body(self, tenancy: Tenancy, guardian: GuardianId, no: int) -> bool:
        beat = tenancy.tenure.beat
        if tenancy.tenure.of(guardian).no >= no:
            return False
        sent = tenancy.bodies.get(guardian)
        if sent is not None and sent[0] == no and beat - sent[1] < 2:
            return False  # it is on its way
        tenancy.bodies[guardian] = (no, beat)
        return True

    # What guardians say ----------------------------------------------------------------------------------------

    def heard(self, place: Place, answer: LeaseKept | DenyLease) -> None:
        """A guardian has answered."""
        tenancy, record = place.tenancy, place.standing.record
        if tenancy is None:
            return
        if isinstance(answer, LeaseKept):
            tenancy.heard_s[answer.guardian] = self._host.kernel.host.now()
        before, tenancy.tenure = tenancy.tenure, answered(tenancy.tenure, record, answer)
        if tenancy.tenure.behind:
            if not before.behind:
                self._tell_behind(place)
        elif isinstance(answer, LeaseKept):
            self._permit(place, tenancy)
            self._acknowledge(place, tenancy)
        follows = conclusion(tenancy.tenure, record, self.permits(place), place.taking is not None)
        if isinstance(follows, ClaimHeard):
            self._outvoted(place, OtherOwner(follows.peer, follows.epoch))
        elif follows is not None:
            self._host.feed_place(place, follows)

    def _permit(self, place: Place, tenancy: Tenancy) -> None:
        permits = self._host.kernel.permits
        until = tenancy.until.pop(tenancy.tenure.granted_beat(place.standing.record.guards), None)
        if until is None or until.left_s(permits.moment()) <= 0:  # no quorum, as before, or it came too late
            return
        self._note(place, tenancy)
        if place.permit and not self.permits(place):
            self._lost(place, tenancy)
        permits.give(_right(place), until)
        tenancy.end.set(permits.left_s(_right(place)) or 0.0)
        if place.permit:
            return
        place.permit = True
        without_s = self._host.kernel.host.now() - tenancy.lost_s
        self._host.event("permit_given", task=place.task_id.name, without_s=without_s)
        self._host.feed_place(place, PermitGiven())
        self._go_on(place)

    def _go_on(self, place: Place) -> None:
        standing, slot = place.standing, place.slot
        stands = standing.record.phase is Phase.OWNER and not standing.volatile.freezing
        if stands and slot is not None and slot.task is not None and slot.life.state is State.RUNNING:
            record, fenced = standing.record, slot.fence
            if fenced is not None:  # its epoch is another one where a person has said that its guardians are gone
                slot.fence = Fence(fenced.task_id, (record.epoch.n, record.epoch.minter))
            tell(slot.task, GoOn(slot.fence))

    def _look_for_end(self, place: Place) -> None:
        tenancy = place.tenancy
        if tenancy is None or not place.permit:
            return
        left_s = self._host.kernel.permits.left_s(_right(place)) or 0.0
        if left_s > 0.0:
            tenancy.end.set(left_s)
            return
        self._lost(place, tenancy)

    def has_no_permit(self, place: Place) -> None:
        """A task has found its permit over, and stands still."""
        if self._host.kernel.permits.may_act(_right(place)):  # its guardians have answered since
            self._hold(place)
            self._go_on(place)
        elif place.tenancy is not None and place.permit:
            self._lost(place, place.tenancy)

    def _lost(self, place: Place, tenancy: Tenancy) -> None:
        """The permit is over: the actuators are held, and the guardians asked at once."""
        step_s = self._host.kernel.permits.ended_by_step(_right(place))
        place.permit, tenancy.lost_s = False, self._host.kernel.host.now()
        self._hold(place)
        silent = ", ".join(sorted(one.agent for one in self._silent(place, tenancy, tenancy.lease_s / 2))) or "too few"
        why = f"its guardians do not answer ({silent})"
        if step_s:
            why = f"the time of day of {self._host.agent} was set forward by {step_s:.1f} s, so its permit is over"
            self._host.event("clock_stepped", task=place.task_id.name, by_s=step_s)
        self._host.log("warning", f"{place.task_id} stands still: {why}")
        self._host.event("permit_lost", task=place.task_id.name)
        self._renew(place)

    def _hold(self, place: Place) -> None:
        slot = place.slot
        if slot is not None and slot.task is not None:
            self._host.hold_actuators(slot, "its guardians do not answer")

    def _tell_behind(self, place: Place) -> None:
        self._host.log(
            "error",
            f"the disk of {self._host.agent} is an old copy: the guardians of {place.task_id} have a later"
            " checkpoint, and have an agent go on from that",
        )
        self._host.event("disk_is_old", task=place.task_id.name)

    def _tell_copied(self, place: Place) -> None:
        agent, task_id = self._host.agent, place.task_id
        others = sorted({one.agent for one in place.standing.record.guards.members()} - {agent})
        self._host.log(
            "warning",
            f"{task_id} stands still on {agent}, whose disk is a copy: its guardians ({', '.join(others) or 'none'})"
            f" have an agent go on with it; where they are gone, `pancakes task revive {agent}/{task_id.name}` does",
        )

    def owe(self, place: Place, packet: PacketId) -> None:
        """Acknowledges a packet once the checkpoint with its effect is at a quorum, so that a take-over keeps it."""
        assert place.tenancy is not None
        record = place.standing.record
        place.tenancy.owed.append((CheckpointId(record.epoch, record.no), packet))
        self._acknowledge(place, place.tenancy)

    def stopped(self, place: Place, answer: Callable[[str], None]) -> None:
        """A person has had a task stopped: that is done once a quorum knows, as else a taker would go on with it."""
        tenancy = place.tenancy
        if tenancy is None:
            answer("")
            return
        tenancy.stops.append((place.standing.record.no, answer))
        self._acknowledge(place, tenancy)
        self._host.after_host(STOP_HEARD_S, partial(self._stop_overdue, place, tenancy, answer))

    def _stop_overdue(self, place: Place, tenancy: Tenancy, answer: Callable[[str], None]) -> None:
        waits = [it for it in tenancy.stops if it[1] is answer]
        if waits:
            tenancy.stops = [it for it in tenancy.stops if it not in waits]
            guardians = place.standing.record.guards.members()
            names = ", ".join(sorted(one.agent for one in guardians if one != self._talk.me))
            answer(
                f"{place.task_id} is stopped on {self._host.agent}, but too few of its guardians ({names}) have"
                " confirmed that: where they cannot be reached, another agent may go on with it"
            )

    def _tell_stops(self, place: Place, tenancy: Tenancy) -> None:
        no = tenancy.tenure.replicated_no(place.standing.record.guards)
        known, tenancy.stops = tenancy.stops, [it for it in tenancy.stops if it[0] > no]
        for at, answer in known:
            if at <= no:
                answer("")

    def _acknowledge(self, place: Place, tenancy: Tenancy) -> None:
        if tenancy.owed:
            kept, tenancy.owed = kept_packets(tenancy.tenure, place.standing.record, tenancy.owed)
            for packet in kept:
                self._on_disk(place, packet)
        if tenancy.stops:
            self._tell_stops(place, tenancy)

    # Choosing guardians ----------------------------------------------------------------------------------------

    def _choose_all(self) -> None:
        for place in list(self._held):
            tenancy, record = place.tenancy, place.standing.record
            if tenancy is None or record.phase is not Phase.OWNER or len(record.guards.sets) != 1:
                continue
            if not may_ask(tenancy.tenure, record):
                continue
            members = record.guards.sets[0]
            if len(members) == tenancy.number and not self._silent(place, tenancy, REPLACED_S):
                continue
            if tenancy.number == 1:
                self._replace(place, (self._talk.me,))
            elif self._host.kernel.host.now() - tenancy.asked_s >= ASK_AGAIN_S:
                self._ask(place, tenancy)
        self._choosing = bool(self._held)
        if self._choosing:
            self._host.after_host(CHOOSE_S, self._choose_all)

    def _ask(self, place: Place, tenancy: Tenancy) -> None:
        tenancy.asked_s = self._host.kernel.host.now()
        tenancy.answers = {}
        for peer in self._talk.neighbours():
            self._talk.say(peer, GUARDIAN, MayGuard(place.task_id, tenancy.type))
        self._host.after_host(ANSWERED_S, partial(self._choose, place))

    def can_guard(self, place: Place, peer: str, answer: CanGuard) -> None:
        """A neighbour says whether it would guard a task."""
        if place.tenancy is not None:
            place.tenancy.answers[peer] = answer

    def _choose(self, place: Place) -> None:
        tenancy, record = place.tenancy, place.standing.record
        if tenancy is None or record.phase is not Phase.OWNER or len(record.guards.sets) != 1:
            return
        members, rule = record.guards.sets[0], tenancy.rule
        silent = self._silent(place, tenancy, REPLACED_S)
        named = rule.guardians if rule is not None else ()
        chosen = choose(self._talk.me, members, silent, named, tenancy.number, tenancy.answers.values())
        if chosen is not None:
            tenancy.thin = False
            self._replace(place, chosen)
        elif not tenancy.thin:
            tenancy.thin = True
            self._tell_thin(place, tenancy, members)

    def _tell_thin(self, place: Place, tenancy: Tenancy, members: Sequence[GuardianId]) -> None:
        refusals = [f"{peer}: {one.refusal}" for peer, one in sorted(tenancy.answers.items()) if one.refusal]
        why = f" ({'; '.join(refusals)})" if refusals else ""
        able = sum(not one.refusal for one in tenancy.answers.values())
        if len(members) == 1:
            text = (
                f"{place.task_id} is not guarded: it needs {tenancy.number - 1} other agents, and {able} can guard it"
            )
        else:
            text = f"{place.task_id} has a silent guardian, and no other agent can guard it"
        self._host.log("warning", text + why)
        self._host.event("guard_thin", task=place.task_id.name, guardians=[one.agent for one in members])

    def _replace(self, place: Place, chosen: tuple[GuardianId, ...]) -> None:
        record = place.standing.record
        if set(chosen) != set(record.guards.sets[0]):
            names = ", ".join(one.agent for one in chosen)
            self._host.log("info", f"{place.task_id} is to be guarded by {names}")
            self._host.event("guards_chosen", task=place.task_id.name, guardians=[one.agent for one in chosen])
            self._host.feed_place(place, GuardsChosen((record.guards.sets[0], chosen)))

    def _silent(self, place: Place, tenancy: Tenancy, since_s: float) -> list[GuardianId]:
        now_s = self._host.kernel.host.now()
        members = place.standing.record.guards.members()
        for one in members:
            tenancy.heard_s.setdefault(one, now_s)
        return [one for one in members if now_s - tenancy.heard_s[one] >= since_s and one != self._talk.me]

    def _address(self, place: Place) -> str:
        return join(self._host.address, place.task_id.name)


def _right(place: Place) -> Fence:
    """Returns the right under which a task acts here."""
    return Fence(str(place.task_id), place.standing.record.epoch)


AGAIN_S: Final = 0.25
"""How often guardians that have not answered are asked again, in host time."""
MOST_CALLED: Final = 64
"""So many tasks are being taken at once at the word of guardians; they call again."""
GIVEN_UP_S: Final = 3.0
"""A task that a guardian has called this agent to take is left to others after this time."""


class Takings:
    """Takes tasks for one service. All in that service's actor.

    Args:
        host: the service.
        talk: how it talks to guardians.
    """

    def __init__(self, host: HostingService, talk: PeerTalk) -> None:
        self._host = host
        self._talk = talk
        self._called = 0  # how many are being taken at a guardian's word

    def given(self, place: Place, effect: Seize) -> None:
        """The owner has given a task away, and never acts under its epoch again."""
        commit, record = effect.commit, place.standing.record
        if place.taking is not None and place.taking.seizing.offer == commit.offer:
            return
        try:
            type = Snapshot.decode(record.snapshot).type
        except MigrationError as error:
            self._host.log("error", f"{place.task_id} cannot be taken: {error}")
            return
        self._begin(place, rules.given_away(self._host.agent, record, type, effect.source, commit), None)

    def called(self, place: Place, call: TakeTask, own: Guards) -> None:
        """A guardian says that the owner of a task is silent, and that this agent is to take it.

        Args:
            place: the place of the task.
            call: what the guardian says.
            own: the guards that this agent knows as a guardian itself.
        """
        if place.taking is not None or self._called >= MOST_CALLED:
            return
        seizing = rules.called(self._host.agent, place.standing.record, place.standing.volatile, call, own)
        if seizing is None:
            return
        self._host.places.keep(place)
        self._called += 1
        self._host.event("task_called", task=place.task_id.name, epoch=seizing.epoch.n, silent_s=call.silent_s)
        self._begin(place, seizing, self._host.kernel.host.now() + GIVEN_UP_S)

    def _begin(self, place: Place, seizing: Seizing, until_s: float | None) -> None:
        if place.taking is not None:
            self._end(place, place.taking)
        place.taking = Taking(seizing, until_s)
        self._ask(place, seizing.unasked())
        self._later(place, place.taking)

    def _ask(self, place: Place, guardians: list[GuardianId]) -> None:
        assert place.taking is not None
        for guardian in sorted(guardians, key=lambda one: one != self._talk.me):
            self._talk.to_guardian(guardian, place.taking.seizing.ask())

    def _later(self, place: Place, taking: Taking) -> None:
        taking.again = self._host.after_host(AGAIN_S, partial(self._again, place, taking))

    def _again(self, place: Place, taking: Taking) -> None:
        if place.taking is not taking:
            return
        late = taking.until_s is not None and self._host.kernel.host.now() >= taking.until_s
        if late or rules.is_vain(taking.seizing, place.standing.record):
            self._end(place, taking)
            return
        taking.seizing = rules.asked_anew(taking.seizing, self._host.agent)
        self._ask(place, taking.seizing.unasked())
        self._later(place, taking)

    def _end(self, place: Place, taking: Taking) -> None:
        place.taking = None
        if taking.again is not None:
            taking.again.cancel()
        if taking.until_s is not None:
            self._called -= 1
        if place.standing.record.unborn and place.slot is None:
            self._host.places.drop(place)  # a peer may make up as many tasks as it likes

    def heard(self, place: Place, answer: GuardAnswer) -> None:
        """A guardian has answered."""
        taking = place.taking
        if taking is None or answer.epoch != taking.seizing.epoch:
            return
        if isinstance(answer, Pledge) and answer.body is not None:
            try:
                rules_of(answer.body.snapshot, place.task_id)
            except MigrationError as error:
                self._host.log("warning", f"the pledge of {answer.guardian.agent} does not count: {error}")
                return
        known = taking.seizing.members()
        taking.seizing = seizing = rules.told(taking.seizing, answer)
        if isinstance(answer, DenyLease):
            self._host.log("debug", f"{answer.guardian.agent} does not pledge {place.task_id}: {answer.reason}")
            return
        result = seizing.result()
        if result is not None:
            self._end(place, taking)
            self._host.places.keep(place)
            if not result.source:
                owner, epoch = seizing.checkpoint.epoch.minter, result.epoch.n
                self._host.event("task_taken", task=place.task_id.name, source_agent=owner, epoch=epoch)
                if owner != self._host.agent:
                    place.came_from = owner
            self._host.feed_place(place, result)
        else:
            self._ask(place, [one for one in seizing.unasked() if one not in known])


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

    def _judged(self, packet: Packet, refusal: Refusal | None) -> None:
        if refusal is not None:
            self._not_believed(packet, refusal.text)
            return
        call = packet.body
        place = self._host.places.get(call.task_id) or Place(call.task_id, Standing(Record(call.task_id)))
        self._takings.called(place, call, self._own_guards(call.task_id))

    def _not_believed(self, packet: Packet, why: str) -> None:
        peer, task_id = agent_of(packet.source), packet.body.task_id
        if self._unbelieved.is_news(peer, f"{task_id} {why}"):
            self._host.log("warning", f"{peer} says that {task_id} is to be taken over, and is not believed: {why}")
