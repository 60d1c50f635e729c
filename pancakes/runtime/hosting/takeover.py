"""Has guarded tasks taken over whose owners are silent: guardians ask each other, and then all neighbours for bids."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import msgspec

from pancakes.errors import ControlRefused, MigrationError
from pancakes.mesh.guarding.guardian_core import GuardRegister
from pancakes.mesh.guarding.taking_over import AskLease, HeldUntil, LeaseSeen, TakeTask
from pancakes.mesh.migration.cost import CostChoice, is_of_core
from pancakes.mesh.migration.epoch import Epoch, is_out_of_reach
from pancakes.mesh.migration.guard_rule import GuardRule
from pancakes.mesh.migration.guards import GuardianId, Guards, newest
from pancakes.mesh.migration.messages import Solicit
from pancakes.mesh.migration.record import TaskId, Wanted
from pancakes.mesh.migration.rule import MigrationRule
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.runtime.hosting.bidding_messages import MIGRATOR, AttemptOver, BidAwarded, HasMoved, MoveOver, Negotiate
from pancakes.runtime.hosting.peer_talk import PeerTalk
from pancakes.runtime.hosting.snapshots import rules_of
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.kernel.timer import OneShot
from pancakes.runtime.supervision.guardian_messages import AskedOfGuardian, GuardianAnswers

RANK_S: Final = 0.15
"""So much later than the guardian before it each guardian looks for a new owner: so that one of them does it."""
CALLED_S: Final = 1.5
"""An agent that was called to take a task has so long to ask for its first lease."""
POLLED_S: Final = 1.0
"""A person who asks is told after this time that too few guardians have answered."""
NEGOTIATED_S: Final = 10.0
"""A negotiation that has not ended by then is forgotten: the Task Migrator was started anew."""


class _Orphan(msgspec.Struct):
    """A task on which no lease runs here.

    Attributes:
        register: what this guardian has of it.
        snapshot: its checkpoint.
        rule: how it is guarded.
        move: when it moves by itself; None: it does not.
        heard_s: when its owner was heard last, in host time.
        held: the newest checkpoint that any of them has.
        promised: the latest epoch that any of them follows.
        guards: the newest guards that any of them knows.
        over: the guardians that say that no lease runs there either.
        asks: how often neighbours were asked for bids.
        negotiating_s: since when, in host time; None: bids are not compared now.
        called: the agent that was called to take it.
        asked: what a person has asked for that waits for an answer; None: nothing.
        told: whether people were told that it waits for a person.
        timer: what comes next.
    """

    register: GuardRegister
    snapshot: Snapshot
    rule: GuardRule
    move: MigrationRule | None
    heard_s: float
    held: HeldUntil
    promised: Epoch
    guards: Guards
    over: set[GuardianId] = set()
    asks: int = 0
    negotiating_s: float | None = None
    called: str = ""
    asked: AskedOfGuardian | None = None
    told: bool = False
    timer: OneShot | None = None


class Takeovers:
    """Looks after the tasks whose leases are over. All in the guardian's actor.

    Args:
        guardian: the guardian.
        talk: how it talks to other agents.
    """

    def __init__(self, guardian: Component, talk: PeerTalk) -> None:
        self._guardian = guardian
        self._talk = talk
        self._orphans: dict[TaskId, _Orphan] = {}
        self._asks = 0

    def lease_ended(self, register: GuardRegister, heard_s: float, held: HeldUntil, wait_s: float) -> None:
        """No lease runs on a task any more.

        Args:
            register: what this guardian has of it.
            heard_s: when its owner was heard last, in host time.
            held: the checkpoint that this guardian has.
            wait_s: for so long no new owner is looked for.
        """
        members = register.guards.members()
        known = self._orphans.get(register.task_id)
        if known is not None and self._talk.me in members:
            # An agent asks for a pledge, which may be the one that was called.
            known.register, known.promised = register, max(known.promised, register.promised)
            self._later(known, wait_s + RANK_S * members.index(self._talk.me))
            return
        self._drop(register.task_id)
        if register.body is None or register.body.wanted is not Wanted.RUNNING or self._talk.me not in members:
            return
        try:
            snapshot, rules = rules_of(register.body.snapshot, register.task_id)
        except MigrationError as error:
            self._guardian.log("error", f"{register.task_id} cannot be taken over: {error}")
            return
        if rules.guard is None:
            return
        orphan = _Orphan(
            register,
            snapshot,
            rules.guard,
            rules.move,
            heard_s,
            held,
            register.promised,
            register.guards,
        )
        self._orphans[register.task_id] = orphan
        self._later(orphan, wait_s + RANK_S * members.index(self._talk.me))

    def lease_runs(self, task_id: TaskId, epoch: Epoch) -> None:
        """A task has an owner again."""
        orphan = self._orphans.get(task_id)
        if orphan is None:
            return
        self._drop(task_id)
        self._answer(orphan, "", {"task_id": str(task_id), "winner": epoch.minter, **self._loss(orphan)})
        if orphan.negotiating_s is None:
            return
        if epoch.minter == orphan.called:
            self._guardian.log("warning", f"{task_id} runs on {epoch.minter}, {self._cause(orphan)}")
            owner = orphan.held.checkpoint.epoch.minter
            told = {"by": epoch.minter, "source_agent": owner, **self._loss(orphan)}
            self._guardian.event("taken_over", task=task_id.name, **told)
            self._guardian.kernel.tell(MIGRATOR, HasMoved(self._guardian, task_id, epoch.minter, str(epoch), None, ""))
        else:
            self._guardian.kernel.tell(
                MIGRATOR, AttemptOver(self._guardian, task_id, "", f"{epoch.minter} owns it", None)
            )

    def _cause(self, orphan: _Orphan) -> str:
        silent_s, owner = self._guardian.kernel.host.now() - orphan.heard_s, orphan.held.checkpoint.epoch.minter
        return f"taken over from {owner}, silent for {silent_s:.1f} s; {orphan.held.story()}"

    def _loss(self, orphan: _Orphan) -> dict[str, Any]:
        """Returns what is lost of a task that is taken over, as plain values."""
        checkpoint, silent_s = orphan.held.checkpoint, self._guardian.kernel.host.now() - orphan.heard_s
        name = f"{checkpoint.epoch}/{checkpoint.no}"
        return {"checkpoint": name, "age_s": orphan.held.age_s, "silent_s": silent_s}

    def _drop(self, task_id: TaskId) -> None:
        orphan = self._orphans.pop(task_id, None)
        if orphan is not None and orphan.timer is not None:
            orphan.timer.cancel()

    # Asking the other guardians ---------------------------------------------------------------------------------

    def _later(self, orphan: _Orphan, delay_s: float) -> None:
        if orphan.timer is not None:
            orphan.timer.cancel()
        orphan.timer = self._guardian.after_host(delay_s, partial(self._poll, orphan))

    def _poll(self, orphan: _Orphan) -> None:
        now_s = self._guardian.kernel.host.now()
        if orphan.negotiating_s is not None and now_s - orphan.negotiating_s > NEGOTIATED_S:
            orphan.negotiating_s = None
        orphan.over = {self._talk.me}
        for member in orphan.guards.members():
            if member != self._talk.me:
                self._talk.to_guardian(member, AskLease(orphan.register.task_id))
        members = orphan.register.guards.members()
        self._later(orphan, max(1.0, orphan.rule.lease_s / 2) + RANK_S * members.index(self._talk.me))
        self._look(orphan)

    def seen(self, answer: LeaseSeen) -> None:
        """Another guardian says whether a lease runs there."""
        orphan = self._orphans.get(answer.task_id)
        if orphan is None or answer.guardian not in orphan.guards.members():
            return
        if is_out_of_reach(max(answer.promised, answer.guards.epoch), orphan.register.promised):
            return  # no guardian would pledge itself to an epoch after that one
        orphan.guards = newest(orphan.guards, answer.guards)
        orphan.promised = max(orphan.promised, answer.promised)
        if answer.held.checkpoint > orphan.held.checkpoint:
            orphan.held = answer.held
        if self._talk.me not in orphan.guards.members():
            self._drop(answer.task_id)  # another one has taken its place
            return
        if not answer.runs:
            orphan.over.add(answer.guardian)
        self._look(orphan)

    def put_off(self, task_id: TaskId) -> None:
        """Another guardian asks: it is the one that looks for a new owner, unless it dies too."""
        orphan = self._orphans.get(task_id)
        if orphan is not None and orphan.negotiating_s is None:
            self._later(orphan, max(1.0, orphan.rule.lease_s / 2))

    def _look(self, orphan: _Orphan) -> None:
        if orphan.negotiating_s is not None or not orphan.guards.has_quorum(orphan.over):
            return
        if orphan.rule.takeover == "ask" and orphan.asked is None:
            self._tell_waiting(orphan)
            return
        self._negotiate(orphan)

    def _tell_waiting(self, orphan: _Orphan) -> None:
        if not orphan.told:
            orphan.told = True
            task_id = orphan.register.task_id
            self._guardian.log(
                "warning",
                f"the owner of {task_id} is silent, and the task waits for you: `pancakes task take"
                f" {self._guardian.agent}/{task_id.name}` has another agent run it",
            )
            self._guardian.event("takeover_waits", task=task_id.name)

    # Asking for bids -------------------------------------------------------------------------------------------

    def _negotiate(self, orphan: _Orphan) -> None:
        snapshot, task_id = orphan.snapshot, orphan.register.task_id
        rule = orphan.move
        self._asks += 1
        cost = rule.cost if rule is not None else "tasks"
        request = Solicit(
            task_id,
            self._asks,
            snapshot.type,
            snapshot.version,
            snapshot.service,
            snapshot.requires,
            cost,
            rule.below if rule is not None and rule.when == "battery" else None,
            self._offer(snapshot, cost),
        )
        now_s = self._guardian.kernel.host.now()
        orphan.negotiating_s = now_s
        asked = orphan.asked
        owner, cause = orphan.held.checkpoint.epoch.minter, self._cause(orphan)
        asked_by = asked.request.by if asked is not None else "guardians"
        dry_run = asked is not None and asked.dry_run
        self._guardian.kernel.tell(MIGRATOR, Negotiate(self._guardian, request, asked_by, "", dry_run, owner, cause))

    def _offer(self, snapshot: Snapshot, cost: CostChoice) -> bytes:
        try:
            return b"" if is_of_core(cost) else snapshot.offer()
        except MigrationError as error:
            self._guardian.log("warning", f"bidders for {snapshot.task_id} are told nothing of it: {error}")
            return b""

    def awarded(self, awarded: BidAwarded) -> None:
        """The bids are compared: calls the cheapest bidder."""
        orphan = self._orphans.get(awarded.task_id)
        if orphan is None:
            reason = "its owner is back"
            self._guardian.kernel.tell(MIGRATOR, AttemptOver(self._guardian, awarded.task_id, "", reason, None))
            return
        orphan.called = awarded.peer
        register = orphan.register
        silent_s = self._guardian.kernel.host.now() - orphan.heard_s
        call = TakeTask(
            register.task_id, register.type, orphan.promised, orphan.guards, orphan.held.checkpoint, silent_s
        )
        self._talk.say(awarded.peer, orphan.snapshot.service, call)
        self._guardian.after_host(CALLED_S, partial(self._look_at_called, orphan, awarded.peer))

    def _look_at_called(self, orphan: _Orphan, peer: str) -> None:
        task_id = orphan.register.task_id
        if self._orphans.get(task_id) is orphan and orphan.called == peer:
            reason = f"did not take it within {CALLED_S:g} s"
            self._guardian.kernel.tell(MIGRATOR, AttemptOver(self._guardian, task_id, peer, reason, None))

    def over(self, over: MoveOver) -> None:
        """The negotiation is over, one way or the other."""
        orphan = self._orphans.get(over.task_id)
        if orphan is None:
            return
        orphan.negotiating_s, orphan.called = None, ""
        if orphan.asked is not None:
            self._answer(orphan, over.reason, {**over.result, **self._loss(orphan)} if over.result else None)
            return
        if over.reason and not orphan.told:
            orphan.told = True
            self._guardian.log("warning", f"{over.task_id} runs nowhere, and is not taken over: {over.reason}")

    # What a person asks for -----------------------------------------------------------------------------------

    def take(self, asked: AskedOfGuardian, task_id: TaskId) -> None:
        """A person says that a task is to be taken over.

        Raises:
            ControlRefused: it does not wait for that.
        """
        orphan = self._orphans.get(task_id)
        if orphan is None:
            raise ControlRefused(f"{task_id} is not to run, as its checkpoint says: there is nothing to take over")
        if orphan.negotiating_s is not None or orphan.asked is not None:
            raise ControlRefused(f"{task_id} is being taken over already")
        orphan.asked = asked
        self._poll(orphan)
        self._guardian.after_host(POLLED_S, partial(self._look_at_polled, orphan))

    def _look_at_polled(self, orphan: _Orphan) -> None:
        if orphan.asked is None or orphan.negotiating_s is not None:
            return
        members = orphan.guards.members()
        silent = ", ".join(sorted(one.agent for one in members if one not in orphan.over))
        known = f"{len(orphan.over)} of its {len(members)} guardians say that its owner is silent"
        self._answer(orphan, f"{orphan.register.task_id} is not taken over: {known}, and not {silent}")

    def _answer(self, orphan: _Orphan, reason: str, result: Any = None) -> None:
        asked, orphan.asked = orphan.asked, None
        if asked is not None:
            tell(asked.root, GuardianAnswers(asked.request, reason, result))
