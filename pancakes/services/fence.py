"""Fences: an actuator obeys no command under an older epoch than the highest that it has seen of a task.

A task that was migrated or taken over has a higher epoch, so a copy that is still alive elsewhere cannot move a
wheel. The marks are on disk before a command under a new epoch is obeyed: otherwise an agent that is started again
would obey an old copy. Before a fence is raised, other agents are asked which one has the task
(`pancakes.services.fence_rule` decides). All of `ActuatorFence` runs in the actuator's task.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec

from pancakes.control import SetFence
from pancakes.durable.answers import fact_of
from pancakes.durable.messages import REGISTRAR, WhoHas
from pancakes.durable.record import Record, TaskId
from pancakes.durable.store import MigrationReports, Records
from pancakes.errors import MigrationError, PancakesError
from pancakes.journal import Disk, RecordTable
from pancakes.kernel.actor import ActorCore
from pancakes.migration import MigrationReport
from pancakes.packet import NETWORK, Fence, Packet, agent_of, join
from pancakes.services.fence_rule import (
    AskAgent,
    ClaimRefused,
    EpochClaim,
    Mark,
    May,
    PresentOwner,
    TaskAt,
    Verdict,
    answered,
    judged,
    present_owner,
    task_at,
)
from pancakes.util import codecs

KIND = "fence"


class Fences:
    """All marks of one agent. Only an actuator's own task reads and writes its marks, in any thread.

    One journal entry for each actuator holds its marks of all tasks.

    Args:
        disk: what they are kept on.
    """

    def __init__(self, disk: Disk) -> None:
        def malformed(actuator: str, why: str) -> None:
            disk.unread.append(f"the journal's fence of the actuator {actuator} is not used: {why}")

        self._marks = RecordTable(disk, KIND, codecs.decoder(dict[str, Mark]), malformed)

    def of(self, actuator: str) -> Mapping[str, Mark]:
        """Return what an actuator has seen, by task, on disk or about to be."""
        return self._marks.newest.get(actuator, {})

    def highest(self, actuator: str, task_id: str) -> Mark | None:
        """Return the highest epoch that the actuator has seen of a task, on disk or about to be; None: none."""
        return self.of(actuator).get(task_id)

    def obeys(self, actuator: str, fence: Fence) -> bool:
        """Return whether a command under `fence` may be obeyed: its epoch is on disk, and none higher."""
        mark = self._marks.on_disk.get(actuator, {}).get(fence.task_id)
        return mark is not None and (mark.n, mark.minter) == tuple(fence.epoch)

    def write(
        self, actuator: str, task_id: str, mark: Mark, then: Callable[[], None], failed: Callable[[str], None]
    ) -> None:
        """Begin to write down what an actuator has seen of a task. Never waits.

        Args:
            actuator: the actuator's name.
            task_id: the task.
            mark: what it has seen.
            then: called, in the store's thread, when it is on disk for good.
            failed: called instead, with the reason, where it could not be written.
        """
        self._marks.write(actuator, {**self.of(actuator), task_id: mark}, then, failed)


ANSWER_S: Final = 1.0
"""So long other agents have to say where a task is, in host time."""
AGAIN_S: Final = 1.0
"""An agent whose claim was refused makes no other for this time, in host time: each one costs questions and a line."""
SET_RIGHT: Final = "`pancakes task recover` shows which agent has it, and sets that right"

Done = Callable[[str, Mapping[str, Any]], None]
"""Takes why something was not done (empty: it was done), and what is known of it."""


class FencesOfAgent(msgspec.Struct, frozen=True):
    """What the fences of an agent rest on.

    Attributes:
        fences: their marks.
        records: what is known of tasks here.
        ledgers: the account of what was done about them.
    """

    fences: Fences
    records: Records
    ledgers: MigrationReports


class _Pending(msgspec.Struct):
    """The newest command of an agent under an epoch that is new, and what is being done about that.

    Attributes:
        claim: the epoch, and the agent.
        packet: the command.
        since_s: since when it waits, in mission time.
        peer: the agent that is asked which one has the task; empty: the epoch is being written down.
        asked: how many agents have been asked.
        until_s: how long that one has to answer, in host time.
    """

    claim: EpochClaim
    packet: Packet
    since_s: float
    peer: str = ""
    asked: int = 0
    until_s: float = 0.0


class _Setting(msgspec.Struct):
    """All connected agents are asked whether they have a task."""

    body: SetFence
    by: str
    done: Done
    answers: dict[str, TaskAt | None]


class ActuatorFence:
    """Lets the newest command of each agent under a new epoch wait until that is on disk. In the actuator's task.

    Args:
        task: the actuator's task, which speaks and waits for it.
        shared: what all fences of the agent rest on.
        good_for_s: how long a command may wait, in mission time.
        obey: carries out a command that has waited.
        refuse: takes a command that has waited for nothing, and why.
        hold: brings the actuator to its safe hold; takes why.
    """

    def __init__(
        self,
        task: ActorCore,
        shared: FencesOfAgent,
        good_for_s: float,
        obey: Callable[[Packet], None],
        refuse: Callable[[Packet, str], None],
        hold: Callable[[str], None],
    ) -> None:
        self._task = task
        self._marks = shared.fences
        self._records = shared.records
        self._ledgers = shared.ledgers
        self._good_for_s = good_for_s
        self._obey = obey
        self._refuse = refuse
        self._hold = hold
        self._pending: dict[str, _Pending] = {}  # by the agent that a command comes from
        self._again_s: dict[str, float] = {}  # when an agent may make another claim, in host time
        self._setting: _Setting | None = None

    def passed(self, packet: Packet) -> str:
        """Return why the sender of a command has no right to it any more; empty: it may have."""
        fence = packet.fence
        if fence is None:
            return ""
        mark = self._marks.highest(self._task.name, fence.task_id)
        if mark is None or tuple(fence.epoch) >= (mark.n, mark.minter):
            return ""
        return f"epoch {fence.epoch[0]} of {fence.task_id} has passed, {mark.n} has been seen"

    def stands(self, packet: Packet) -> bool:
        """Return whether a command may be obeyed now. Else it waits, or is refused."""
        fence = packet.fence
        if fence is None or self._marks.obeys(self._task.name, fence):
            return True
        # For how long it is good changes with each command, and says nothing of which agent has the task.
        claim = EpochClaim(Fence(fence.task_id, fence.epoch), agent_of(packet.source))
        now_s = self._task.kernel.host.now()
        pending = self._pending.get(claim.peer)
        if pending is not None and pending.claim == claim:
            pending.packet, pending.since_s = packet, self._task.now()
            if pending.peer and now_s >= pending.until_s:
                self._give_up(claim.peer, f"{pending.peer} does not say where it gave {fence.task_id}; {SET_RIGHT}")
        elif now_s >= self._again_s.get(claim.peer, 0.0):
            # Those that were not answered, and whose agents have sent nothing since.
            old = [it for it, other in self._pending.items() if other.peer and now_s >= other.until_s + AGAIN_S]
            for it in old:
                del self._pending[it]
            self._pending[claim.peer] = _Pending(claim, packet, self._task.now())
            marks, record = self._marks.of(self._task.name), self._record(fence.task_id)
            self._decide(claim.peer, judged(self._task.agent, claim, marks, record, self._linked()))
        return False

    def drop(self) -> None:
        """Forget the commands that wait, but not what is being done about their epochs."""
        for pending in self._pending.values():
            pending.since_s = -math.inf

    def told(self, packet: Packet) -> None:
        """An agent says which one has tasks."""
        facts = {fact.task_id: fact for fact in packet.body.facts}
        for task_id in packet.body.task_ids:
            by = agent_of(packet.source)
            self._told(by, task_at(str(task_id), by, facts.get(task_id)))

    def _told(self, by: str, at: TaskAt) -> None:
        for peer, pending in list(self._pending.items()):
            if (pending.peer, pending.claim.fence.task_id) == (by, at.task_id):
                self._decide(peer, answered(pending.claim, pending.asked, by, at, self._linked()))
        setting = self._setting
        if setting is not None and setting.body.task_id == at.task_id and by in setting.answers:
            setting.answers[by] = at
            if None not in setting.answers.values():
                self._settle()

    def _decide(self, peer: str, verdict: Verdict) -> None:
        pending = self._pending[peer]
        match verdict:
            case May():
                self._raise(pending)
            case AskAgent(other):
                pending.peer, pending.asked = other, pending.asked + 1
                pending.until_s = self._task.kernel.host.now() + ANSWER_S
                self._ask(other, pending.claim.fence.task_id)
            case ClaimRefused(reason):
                self._give_up(peer, f"{reason}; {SET_RIGHT}")

    def _raise(self, pending: _Pending) -> None:
        task, claim = self._task, pending.claim
        if passed := self.passed(pending.packet):  # while others were asked
            self._give_up(claim.peer, passed)
            return
        pending.peer = ""
        n, minter = claim.fence.epoch
        self._marks.write(
            task.name,
            claim.fence.task_id,
            Mark(n, minter, claim.peer),
            lambda: task.call(lambda: self._written(claim, "")),
            lambda why_not: task.call(lambda: self._written(claim, why_not)),
        )

    def _written(self, claim: EpochClaim, why_not: str) -> None:
        """An epoch is on disk, or is not: what has waited for it is obeyed, if it still may be."""
        pending = self._pending.get(claim.peer)
        if pending is None or pending.claim != claim:
            return  # a later one is being written
        if why_not:  # the next command tries again
            self._give_up(claim.peer, f"its epoch is not on disk: {why_not}", again=True)
            return
        del self._pending[claim.peer]
        if self._task.now() - pending.since_s < self._good_for_s:
            self._obey(pending.packet)

    def _give_up(self, peer: str, reason: str, again: bool = False) -> None:
        pending = self._pending.pop(peer)
        if not again:
            now_s = self._task.kernel.host.now()
            # Terminals come under ever new names.
            self._again_s = {it: again_s for it, again_s in self._again_s.items() if again_s > now_s}
            self._again_s[peer] = now_s + AGAIN_S
        self._refuse(pending.packet, reason)

    # By a person -----------------------------------------------------------------------------------------------

    def set(self, body: SetFence, by: str, done: Done) -> None:
        """Set the mark of a task to the epoch under which it runs now, wherever that is.

        Args:
            body: what was asked for.
            by: the address of the asker.
            done: called once it is done, or refused.
        """
        if self._setting is not None:
            done(f"the fence of {self._task.address} is being set already", {})
            return
        setting = self._setting = _Setting(body, by, done, dict.fromkeys(self._linked()))
        for peer in setting.answers:
            self._ask(peer, body.task_id)
        if not setting.answers:
            self._settle()
            return
        self._task.after_host(ANSWER_S, lambda: self._settle() if self._setting is setting else None)

    def _settle(self) -> None:
        setting, self._setting = self._setting, None
        assert setting is not None
        task, body = self._task, setting.body
        record = self._record(body.task_id)
        own = task_at(body.task_id, task.agent, fact_of(record) if record is not None and not record.unborn else None)
        found = present_owner(task.agent, body.task_id, own, setting.answers)
        if isinstance(found, ClaimRefused):
            setting.done(found.reason, {})
            return
        before = self._marks.highest(task.name, body.task_id)
        result = {
            "actuator": task.address,
            "task_id": body.task_id,
            "owner": found.name,
            "before": f"{before.n}@{before.minter}" if before is not None else None,
            "now": f"{found.mark.n}@{found.mark.minter}",
        }
        if body.dry_run:
            setting.done("", result)
            return
        self._hold("its fence is set")
        self._marks.write(
            task.name,
            body.task_id,
            found.mark,
            lambda: task.call(lambda: self._set(setting, found, result)),
            lambda why_not: task.call(lambda: setting.done(f"the fence is not on disk: {why_not}", {})),
        )

    def _set(self, setting: _Setting, owner: PresentOwner, result: dict[str, Any]) -> None:
        before = result["before"] or "nothing"
        reason = f"the fence of {result['actuator']} was at {before}, and is at {result['now']} now"
        account = MigrationReport(setting.body.task_id, self._task.agent, setting.by, "", "fenced", owner.name, (), 0.0)
        self._ledgers.add(account, reason, self._task.now())
        setting.done("", result)

    # Others ----------------------------------------------------------------------------------------------------

    def _record(self, task_id: str) -> Record | None:
        try:
            return self._records.get(TaskId.parse(task_id))
        except MigrationError:
            return None

    def _linked(self) -> list[str]:
        return [link["name"] for link in self._task.kernel.links() if link["role"] != "client"]

    def _ask(self, peer: str, task_id: str) -> None:
        try:
            self._task.publish(NETWORK, WhoHas((TaskId.parse(task_id),)), to=join(peer, REGISTRAR))
        except PancakesError as error:
            self._task.log("debug", f"{peer} was not asked about {task_id}: {error}")
