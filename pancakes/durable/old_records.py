"""Reads what versions before the register have left on disk about tasks. Pure.

They kept a record of each task that an agent hosted (`record`), and a register of each task that it guarded (`guard`).
Both are read into the `Record` of today; the entries stay on disk until the task writes for the first time. A fleet
changes over at once: agents of such a version do not speak with those of this one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import msgspec
from msgspec.structs import replace

from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import BLANK, NO_EPOCH, NOBODY, Epoch, Identity, Register, Wanted
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED

GUARD: Final = "guard"
FIRST_OFFER: Final = 1
"""The number of the write that offers a task, in what was under way."""

_Epoch = tuple[int, str]
_Member = tuple[str, ...]
"""The name of the agent, the id of its journal, and which copy of that it has."""


class _Guards(msgspec.Struct, frozen=True):
    epoch: _Epoch = (0, "")
    version: int = 0
    sets: tuple[tuple[_Member, ...], ...] = ()


class _OldRecord(msgspec.Struct, frozen=True):
    task_id: TaskId
    phase: str
    epoch: _Epoch = (0, "")
    seen: _Epoch = (0, "")
    offer: _Epoch = (0, "")
    peer: str = ""
    wanted: str = "running"
    snapshot: bytes = b""
    sequel: bytes = b""
    service: str = ""
    guards: _Guards = _Guards()
    no: int = 0
    copy: str = ""


class _Body(msgspec.Struct, frozen=True):
    snapshot: bytes
    wanted: str = "running"


class _OldRegister(msgspec.Struct, frozen=True):
    task_id: TaskId
    type: str = ""
    promised: _Epoch = (0, "")
    checkpoint: tuple[_Epoch, int] = ((0, ""), 0)
    body: _Body | None = None
    guards: _Guards = _Guards()
    lease_s: float = 5.0


class _OldGuard(msgspec.Struct, frozen=True):
    register: _OldRegister
    copy: str = ""


_RECORD = codecs.decoder(_OldRecord)
_GUARD = codecs.decoder(_OldGuard)


class OldRecords:
    """Reads the records of an agent that an earlier version has written.

    Args:
        guards: what it has on disk as a guardian, encoded.
        me: the agent as an owner and member of tasks.
        journals: the id of the journal that each other agent had last, by name.
    """

    def __init__(self, guards: Iterable[bytes], me: Identity, journals: Mapping[str, str]) -> None:
        self._me = me
        self._journals = journals
        self._guards: dict[TaskId, _OldRegister] = {}
        for data in guards:
            try:
                found = _GUARD(data)
            except MALFORMED:  # it promised something that is not known: as with a disk that was lost
                continue
            if found.copy == me.copy:
                self._guards[found.register.task_id] = found.register

    def record(self, data: bytes) -> Record:
        """Return the record of a task.

        Raises:
            Exception: one of `MALFORMED`: the bytes are none.
        """
        old = _RECORD(data)
        guard = self._guards.get(old.task_id)
        type_name, lease_s = (guard.type, guard.lease_s) if guard is not None else ("", 5.0)
        register, sequel = self._register(old), old.sequel if old.phase in ("committed", "released") else b""
        record = Record(old.task_id, register, self._me, old.service, type_name, lease_s, sequel)
        if guard is None or register.owner == self._me:
            promised = self._epoch(guard.promised) if guard is not None else NO_EPOCH
            return replace(record, register=register._replace(promised=max(register.promised, promised)))
        member = self._member(guard)
        return replace(record, register=member) if member.stamp > register.stamp else record

    def guarded(self, known: Iterable[TaskId]) -> list[Record]:
        """Return the records of tasks that this agent only guarded."""
        others = set(self._guards) - set(known)
        found = [self._guards[task_id] for task_id in sorted(others)]
        return [Record(it.task_id, self._member(it), self._me, "", it.type, it.lease_s) for it in found]

    def _register(self, old: _OldRecord) -> Register:
        own = Epoch(old.epoch[0] + (old.epoch[1] != self._me.agent and not old.guards.sets), self._me)
        wanted = Wanted(old.wanted)
        match old.phase:
            case "owner" | "frozen":
                sets = self._sets(old.guards) or ((self._me,),)
                state = old.snapshot or None
                return Register(own, old.no, sets, 0, NOBODY, wanted, state, own)
            case "committed":
                heir, epoch = self._agent(old.peer), Epoch(max(0, old.offer[0] - 1), self._me)
                promised = Epoch(old.offer[0], heir, FIRST_OFFER)
                return Register(epoch, FIRST_OFFER, ((self._me,),), 0, heir, Wanted.RUNNING, old.snapshot, promised)
            case "prepared":
                source = self._agent(old.peer)
                epoch = Epoch(max(0, old.offer[0] - 1), source)
                return Register(epoch, FIRST_OFFER, ((source,),), 0, self._me, Wanted.RUNNING, old.snapshot, epoch)
            case "released" if wanted is Wanted.REMOVED:
                return Register(own, 0, ((self._me,),), 0, NOBODY, wanted, None, own)
            case _ if old.seen[1]:
                epoch = Epoch(old.seen[0], self._agent(old.peer) if old.peer else NOBODY)
                return Register(epoch, -1, (), 0, NOBODY, Wanted.RUNNING, None, epoch)
            case _:
                return BLANK

    def _member(self, old: _OldRegister) -> Register:
        promised = self._epoch(old.promised)
        if not old.guards.sets:  # it was removed
            return Register(promised, 0, ((promised.minter,),), 0, NOBODY, Wanted.REMOVED, None, promised)
        (epoch, no), body = old.checkpoint, old.body
        state, wanted = (body.snapshot, Wanted(body.wanted)) if body is not None else (None, Wanted.RUNNING)
        sets = self._sets(old.guards)
        return Register(self._epoch(epoch, sets), no, sets, 0, NOBODY, wanted, state, self._epoch(old.promised, sets))

    def _sets(self, guards: _Guards) -> tuple[tuple[Identity, ...], ...]:
        return tuple(tuple(Identity(*member) for member in one) for one in guards.sets)

    def _epoch(self, epoch: _Epoch, sets: tuple[tuple[Identity, ...], ...] = ()) -> Epoch:
        n, name = epoch
        if not name:
            return NO_EPOCH
        member = next((it for one in sets for it in one if it.agent == name), None)
        return Epoch(n, member or self._agent(name))

    def _agent(self, name: str) -> Identity:
        return self._me if name == self._me.agent else Identity(name, self._journals.get(name, ""))
