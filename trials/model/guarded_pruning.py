"""Which messages can change nothing more, whatever happens: the search of guarded tasks leaves them out."""

from __future__ import annotations

from collections.abc import Iterator

from model.guarded_parts import OWNED, Farewell, Message, Party, Word
from model.guarded_steps import GuardedSteps
from msgspec.structs import replace

from pancakes.durable.messages import (
    Abort,
    Activated,
    Commit,
    KeepLease,
    LeaseKept,
    Pledge,
    Prepared,
    SeizeTask,
    Transfer,
)
from pancakes.durable.record import Epoch, GuardianId, Phase

_MOST_KNOWN = 400_000


class Pruning:
    """Works on the messages of one search.

    Args:
        steps: the steps of its agents.
    """

    def __init__(self, steps: GuardedSteps) -> None:
        self._steps = steps
        self._pruned: dict[tuple[int, tuple[int, ...]], int] = {}
        self._lapsed: dict[int, int] = {}
        self._members: dict[int, frozenset[GuardianId]] = {}

    def each(self, net: int) -> Iterator[tuple[int, Message]]:
        """Yields the messages, each with its bit."""
        messages = self._steps.messages
        while net:
            low = net & -net
            net ^= low
            yield low, messages[low.bit_length() - 1]

    def lapsed(self, net: int) -> int:
        """Returns the messages once the oldest asking has lapsed."""
        out = 0
        for low, message in self.each(net):
            new = self._lapsed.get(low)
            if new is None:
                if isinstance(message, Farewell):
                    word = replace(message.message, beat=max(0, message.message.beat - 1))
                    new = self._steps.bit(Farewell(message.to, word))
                elif isinstance(message, KeepLease | LeaseKept):
                    new = self._steps.bit(replace(message, beat=max(0, message.beat - 1)))
                else:
                    new = low
                self._lapsed[low] = new
            out |= new
        return out

    def of_former_life(self, net: int, name: str) -> int:
        """Returns the messages once a guardian has begun a new life."""
        out = 0
        for low, message in self.each(net):
            if isinstance(message, Farewell) and message.to.agent == name:
                low = self._steps.bit(Farewell(message.to, replace(message.message, boot=0)))
            out |= low
        return out

    def pruned(self, net: int, parties: tuple[int, ...]) -> int:
        """Returns the messages that can still change something."""
        if not self._steps.rules.prunes:
            return net
        key = (net, parties)
        found = self._pruned.get(key)
        if found is None:
            if len(self._pruned) > _MOST_KNOWN:
                self._pruned.clear()
            found = self._pruned[key] = self._alive(net, [self._steps.parties[number] for number in parties])
        return found

    def _alive(self, net: int, parties: list[Party]) -> int:
        owners = {it.record.epoch: it for it in parties if it.record.phase in OWNED}
        seizing = {it.taking.epoch for it in parties if it.taking is not None}
        best: dict[tuple[Epoch, GuardianId], list[tuple[int, LeaseKept]]] = {}
        out = 0
        for low, message in self.each(net):
            match message:
                case LeaseKept():
                    owner = owners.get(message.epoch)
                    if owner is not None and self._says(owner, message):
                        self._keep_best(best, low, message)
                    continue
                case Pledge() if message.epoch not in seizing:
                    continue
                case Farewell() if self._is_vain(message, parties):
                    continue
            out |= low
        for kept in best.values():
            for low, _ in kept:
                out |= low
        for low, message in self.each(out):
            match message:
                case KeepLease() if self._keep_is_dead(message, parties, best, owners):
                    out ^= low
                case SeizeTask() if self._seize_is_dead(message, parties, seizing, out):
                    out ^= low
                case Word() if self._word_is_dead(message, parties, out):
                    out ^= low
        return out

    @staticmethod
    def _says(owner: Party, kept: LeaseKept) -> bool:
        """Returns whether an answer may say something to the owner: it may hear the like with its next asking."""
        record = owner.record
        waits = owner.owed or len(record.guards.sets) > 1 or kept.no > record.no
        return kept.beat > 0 or bool(waits)

    @staticmethod
    def _keep_best(
        best: dict[tuple[Epoch, GuardianId], list[tuple[int, LeaseKept]]], low: int, message: LeaseKept
    ) -> None:
        rest = best.setdefault((message.epoch, message.guardian), [])
        for other_low, other in rest[:]:
            if other.beat >= message.beat and other.no >= message.no and other.version >= message.version:
                return
            if other.beat <= message.beat and other.no <= message.no and other.version <= message.version:
                rest.remove((other_low, other))
        rest.append((low, message))

    def _is_vain(self, word: Farewell, parties: list[Party]) -> bool:
        at = next(at for at, name in enumerate(self._steps.names) if name == word.to.agent)
        party, said = parties[at], word.message
        return self._steps.me(at, party) != word.to or party.register.promised > said.epoch

    def _keep_is_dead(
        self,
        keep: KeepLease,
        parties: list[Party],
        best: dict[tuple[Epoch, GuardianId], list[tuple[int, LeaseKept]]],
        owners: dict[Epoch, Party],
    ) -> bool:
        members = keep.guards.members()
        for at, party in enumerate(parties):
            me = self._steps.me(at, party)
            register, lease = party.register, party.lease
            if me not in members or keep.epoch < register.promised:
                continue
            known = (
                register.promised == keep.epoch
                and (register.checkpoint >= keep.checkpoint or keep.body is None)
                and register.guards.stamp >= keep.guards.stamp
            )
            granted = lease.epoch == keep.epoch and party.until >= keep.beat and lease.beat >= keep.beat
            if not (known and (granted or keep.beat == 0)):
                return False
            owner = owners.get(keep.epoch)
            if owner is None:
                continue
            no = register.checkpoint.no if register.checkpoint.epoch == keep.epoch else -1
            version = register.guards.version if register.guards.epoch == keep.epoch else -1
            said = best.get((keep.epoch, me), ())
            if any(it.beat >= keep.beat and it.no >= no and it.version >= version for _, it in said):
                continue
            if keep.beat > 0 or owner.owed or len(owner.record.guards.sets) > 1 or no > owner.record.no:
                return False
        return True

    def _seize_is_dead(self, seize: SeizeTask, parties: list[Party], seizing: set[Epoch], net: int) -> bool:
        members = seize.guards.members()
        for at, party in enumerate(parties):
            me = self._steps.me(at, party)
            register = party.register
            if me not in members or register.promised > seize.epoch:
                continue
            if register.promised < seize.epoch:
                return False
            if seize.epoch not in seizing or max(register.guards.epoch, register.checkpoint.epoch) >= seize.epoch:
                continue
            held = register.checkpoint, register.guards, register.body
            pledge = Pledge(register.task_id, seize.epoch, me, *held)
            if not net & self._steps.bit(pledge):
                return False
        return True

    def _word_is_dead(self, word: Word, parties: list[Party], net: int) -> bool:
        names, message = self._steps.names, word.message
        source, to = parties[names.index(word.source)].record, parties[names.index(word.to)].record
        match message:
            case Transfer():
                return to.seen >= message.offer and (to.phase is not Phase.PREPARED or to.offer != message.offer)
            case Prepared():
                gone = source.phase is not Phase.PREPARED or source.offer != message.offer
                return gone and to.offer != message.offer
            case Commit():
                waits = source.phase is Phase.COMMITTED and source.offer == message.offer
                return not waits and to.seen >= message.offer and to.offer != message.offer
            case Activated():
                return to.phase is not Phase.COMMITTED or to.offer != message.offer
            case Abort():
                return to.seen >= message.offer and to.offer != message.offer
        return False
