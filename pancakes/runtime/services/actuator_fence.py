"""The fence of one actuator: which commands of tasks that move it lets pass, and who is asked before it is raised."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec

from pancakes.control import SetFence
from pancakes.errors import MigrationError, PancakesError
from pancakes.mesh.migration.ledger import Ledger
from pancakes.mesh.migration.record import Record, TaskId
from pancakes.mesh.migration.whereabouts import TaskAt, WhereIs, whereabouts
from pancakes.packet import NETWORK, Packet, agent_of, join
from pancakes.runtime.hosting.courier_messages import COURIER
from pancakes.runtime.hosting.ledgers import Ledgers
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.services.fence_rule import (
    Ask,
    Claim,
    Mark,
    May,
    Owner,
    Refused,
    Verdict,
    answered,
    judged,
    present_owner,
)
from pancakes.runtime.services.fences import Fences

ANSWER_S: Final = 1.0
"""So long other agents have to say where a task is, in host time."""
SET_RIGHT: Final = "pancakes task fence shows who has it, and sets that right"

Done = Callable[[str, Mapping[str, Any]], None]
"""Takes why something was not done, empty: it was, and what is to be known of it."""


class FencesOfAgent(msgspec.Struct, frozen=True):
    """What the fences of an agent rest on.

    Attributes:
        fences: their marks.
        records: what is known of tasks here.
        ledgers: the account of what was done about them.
    """

    fences: Fences
    records: Records
    ledgers: Ledgers


class _Search(msgspec.Struct):
    """Agents are asked, one after the other, to whom they gave a task."""

    claim: Claim
    peer: str
    asked: int
    until_s: float


class _Setting(msgspec.Struct):
    """All connected agents are asked whether they have a task."""

    body: SetFence
    by: str
    done: Done
    answers: dict[str, TaskAt | None]


class ActuatorFence:
    """Lets the newest command under a new epoch wait until that is on disk. In the actuator's task.

    Args:
        task: the actuator's task, which speaks and waits for it.
        shared: what all fences of the agent rest on.
        good_for_s: so long a command may wait, in mission time.
        obey: carries out a command that has waited.
        refuse: takes a command that has waited for nothing, and why.
        hold: brings the actuator to its safe hold; takes why.
    """

    def __init__(
        self,
        task: Component,
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
        self._writing: Claim | None = None
        self._waiting: tuple[Packet, float] | None = None  # and since when
        self._search: _Search | None = None
        self._setting: _Setting | None = None

    def passed(self, packet: Packet) -> str:
        """Returns why the sender of a command has no right to it any more; empty: it may have."""
        fence = packet.fence
        if fence is None:
            return ""
        mark = self._marks.highest(self._task.name, fence.task_id)
        if mark is None or tuple(fence.epoch) >= (mark.n, mark.minter):
            return ""
        return f"epoch {fence.epoch[0]} of {fence.task_id} has passed, {mark.n} has been seen"

    def stands(self, packet: Packet) -> bool:
        """Returns whether a command may be obeyed now. Else it waits, or is refused."""
        fence = packet.fence
        if fence is None or self._marks.holds(self._task.name, fence):
            return True
        self._waiting = (packet, self._task.now())
        claim = Claim(fence, agent_of(packet.source))
        if self._writing == claim:
            return False
        search, now_s = self._search, self._task.kernel.host.now()
        if search is not None and search.claim == claim and now_s < search.until_s:
            return False
        if search is not None and search.claim == claim:
            self._decide(claim, 0, Refused(f"{search.peer} does not say to whom it gave {fence.task_id}"))
            return False
        mark = self._marks.highest(self._task.name, fence.task_id)
        agent = self._task.agent
        self._decide(claim, 0, judged(agent, claim, mark, self._record(fence.task_id), self._linked()))
        return False

    def drop(self) -> None:
        """Forgets the command that waits."""
        self._waiting = None

    def told(self, packet: Packet) -> None:
        """An agent says who has a task."""
        by, at = agent_of(packet.source), packet.body
        search, setting = self._search, self._setting
        if search is not None and (search.peer, search.claim.fence.task_id) == (by, at.task_id):
            self._decide(search.claim, search.asked, answered(search.claim, search.asked, by, at, self._linked()))
        if setting is not None and setting.body.task_id == at.task_id and by in setting.answers:
            setting.answers[by] = at
            if None not in setting.answers.values():
                self._settle()

    def _decide(self, claim: Claim, asked: int, verdict: Verdict) -> None:
        self._search = None
        match verdict:
            case May():
                self._raise(claim)
            case Ask(peer):
                self._search = _Search(claim, peer, asked + 1, self._task.kernel.host.now() + ANSWER_S)
                self._ask(peer, claim.fence.task_id)
            case Refused(reason):
                self._give_up(f"{reason}; {SET_RIGHT}")

    def _raise(self, claim: Claim) -> None:
        self._writing = claim
        task, fence = self._task, claim.fence
        n, minter = fence.epoch
        self._marks.write(
            task.name,
            fence.task_id,
            Mark(n, minter, "" if claim.peer == task.agent else claim.peer),
            lambda: task.call(lambda: self._written(claim, "")),
            lambda why_not: task.call(lambda: self._written(claim, why_not)),
        )

    def _written(self, claim: Claim, why_not: str) -> None:
        """An epoch is on disk, or is not: what has waited for it is obeyed, if it still may be."""
        if self._writing != claim:
            return  # a later one is being written
        self._writing = None  # where it failed, the next command tries again
        if why_not:
            self._give_up(f"its epoch is not on disk: {why_not}")
            return
        waiting, self._waiting = self._waiting, None
        if waiting is not None and self._task.now() - waiting[1] < self._good_for_s:
            self._obey(waiting[0])

    def _give_up(self, reason: str) -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._refuse(waiting[0], reason)

    # By a person -----------------------------------------------------------------------------------------------

    def set(self, body: SetFence, by: str, done: Done) -> None:
        """Sets the mark of a task to the epoch under which it runs now, wherever that is.

        Args:
            body: what was asked for.
            by: who asked.
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
        own = whereabouts(task.agent, body.task_id, self._record(body.task_id))
        found = present_owner(task.agent, body.task_id, own, setting.answers)
        if isinstance(found, Refused):
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
        self._search = self._writing = None
        self._marks.write(
            task.name,
            body.task_id,
            found.mark,
            lambda: task.call(lambda: self._set(setting, found, result)),
            lambda why_not: task.call(lambda: setting.done(f"the fence is not on disk: {why_not}", {})),
        )

    def _set(self, setting: _Setting, owner: Owner, result: dict[str, Any]) -> None:
        reason = (
            f"the fence of {result['actuator']} was at {result['before'] or 'nothing'}, and is at {result['now']} now"
        )
        account = Ledger(setting.body.task_id, self._task.agent, setting.by, "", "fenced", owner.name, (), 0.0)
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
            self._task.publish(NETWORK, WhereIs(task_id), to=join(peer, COURIER))
        except PancakesError as error:
            self._task.log("debug", f"{peer} was not asked about {task_id}: {error}")
