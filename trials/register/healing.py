"""Heal a configuration of disks: a few rounds in which nothing goes wrong, after which one agent acts."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from register.world import (
    DISPUTED,
    REMOVED,
    ROUNDS,
    RUN,
    STOPPED,
    Letter,
    Local,
    Violation,
    World,
    is_vouched,
)

from pancakes.durable.register import (
    NO_EPOCH,
    NOBODY,
    is_quorum,
)
from pancakes.durable.rules import (
    Accepted,
    Ask,
    Beat,
    Call,
    Confirmed,
    Counts,
    Desired,
    GiveUp,
    Grant,
    Known,
    Lease,
    Memory,
    Persist,
    Place,
    Prepare,
    Promise,
    Remember,
    Send,
)

if TYPE_CHECKING:
    from register.search import Search


class Healing:
    """A few rounds in which nothing goes wrong."""

    def __init__(
        self, search: Search, world: World, agents: list[Local], gone: int | None, restarted: bool = True
    ) -> None:
        self.search, self.world, self.gone, self.restarted = search, world, gone, restarted
        self.names = [it.me for it in agents]
        self.here = [index for index in range(len(agents)) if index != gone]
        self.registers = [it.register for it in agents]
        self.draws = [it.redrawn() if restarted else it.draws for it in agents]
        self.memories = [Memory() if restarted else it.memory._replace(permit=0) for it in agents]
        self.leases = [Lease()] * len(agents)
        self.box: deque[Any] = deque()
        self.acked = 0

    def _place(self, index: int) -> Place:
        return self.search.place_of(self._local(index))

    def _local(self, index: int) -> Local:
        return Local(
            self.names[index], self.registers[index], self.memories[index], self.leases[index], self.draws[index]
        )

    def _carry_out(self, index: int, effects: Iterable[Any]) -> None:
        for effect in effects:
            kind = type(effect)
            if kind is Persist:
                self.registers[index] = effect.register
            elif kind is Remember:
                self.memories[index] = effect.memory
            elif kind is Grant:
                self.leases[index] = effect.lease
            elif kind is Send:
                self.box.append(effect.message)
            elif kind is Counts and effect.register.state is not None:
                self.acked = max(self.acked, effect.register.state.upto)
            elif kind is Ask and self._is_confirmed(index, effect.message):
                self._feed(index, Confirmed(effect.message))

    def _is_confirmed(self, index: int, message: Any) -> bool:
        if type(message) is Prepare:
            return message.epoch.minter in self.names
        registers = {self.names[it]: self.registers[it] for it in self.here}
        return is_vouched(self.names[index], self.registers[index], self.leases[index], message, registers)

    def _feed(self, index: int, event: Any) -> None:
        self._carry_out(index, self.search.effects_of(self._local(index), event))

    def _acting(self) -> list[int]:
        desired = self.search.rules.desired
        return [it for it in self.here if desired(self.names[it], self.registers[it], self.memories[it]) is Desired.RUN]

    def run(self) -> None:
        """Run the rounds.

        Raises:
            Violation: nobody acts afterwards, for no reason, or two do.
        """
        world = self.world
        for index in self.here if self.restarted else ():
            self._carry_out(index, self.search.rules.recover(self._place(index), 0))
            self.leases[index] = Lease()
        calm = 0
        for number in range(1, ROUNDS + 1):
            self._talk(number)
            acting = self._acting()
            if len(acting) > 1 and number > 3:
                raise Violation(f"S1, after it has healed: {self._standing()}")
            is_calm = len(acting) == 1 and (not self._in_doubt(acting) or world.lost)
            calm = calm + 1 if is_calm else 0
            for seq in range(1, self.search.s.letters + 1) if len(acting) == 1 else ():
                self._feed(acting[0], Letter(seq))
            if calm >= 3 and (self.acked == self.search.s.letters or world.lost):
                if self.registers[acting[0]].epoch <= world.removed:
                    raise Violation("S6: a removed task came back while it healed")
                return
            self._pass(number, acting)
        why = self._why_none()
        if not why:
            who = self.names[self.gone] if self.gone is not None else "nobody"
            raise Violation(f"L1: not one acts after {ROUNDS} rounds, with {who} gone: {self._standing()}")
        self.search.waits[why] += 1

    def _talk(self, number: int) -> None:
        """Let timers fire and deliver all messages."""
        for index in self.here:
            self._feed(index, Beat(number))
            self._carry_out(index, self.search.rules.resend(self._place(index)))
            if self._place(index).writes:
                self.box.append(Known(self.names[index], self.registers[index].summary()))
        for _ in range(400):
            if not self.box:
                return
            message = self.box.popleft()
            for index in self.here:
                if type(message) in (Accepted, Promise) and message.epoch.minter != self.names[index]:
                    continue
                before = self.registers[index].epoch
                self._feed(index, message)
                if self.registers[index].owner == self.names[index] and self.registers[index].epoch != before:
                    self._feed(index, Beat(number))

    def _in_doubt(self, acting: list[int]) -> bool:
        for index in self.here:
            me, register = self.names[index], self.registers[index]
            if index in acting or register.state is None or register.wanted is DISPUTED:
                continue
            if me in (register.owner, register.heir) and (register.unguarded or me not in register.members):
                return True
        return False

    def _pass(self, number: int, acting: list[int]) -> None:
        """Let time pass: leases lapse, offers are given up, and guardians call an agent."""
        for index in self.here:
            if self.memories[index].permit and self.memories[index].permit != number:
                self.memories[index] = self.memories[index]._replace(permit=0)
            if self.leases[index].beat != number:
                self.leases[index] = Lease()
            if self.registers[index].owner == self.names[index] and self.registers[index].heir != NOBODY and number > 1:
                self._feed(index, GiveUp())
        if number <= 2 or acting:
            return
        index = self.here[number % len(self.here)]
        newest = max((self.registers[it] for it in self.here), key=lambda it: it.stamp)
        if not newest.unguarded and newest.wanted is RUN:
            free = {self.names[it] for it in self.here if not self.leases[it].beat}
            if is_quorum(newest.sets, free):
                self._feed(index, Call(max(self.registers[it].promised for it in self.here), newest.sets))

    def _why_none(self) -> str:
        """Return why it is right that nobody acts; empty: it is not."""
        world, here = self.world, {self.names[it] for it in self.here}
        pairs = [(me, it) for me, it in zip(self.names, self.registers, strict=True) if me in here]
        if any(it.wanted is DISPUTED for me, it in pairs if it.owner == me and it.promised <= it.epoch):
            return "disputed: a person decides"
        newest = max((it for _, it in pairs), key=lambda it: (it.stamp, it.wanted is not RUN))
        if newest.wanted in (STOPPED, REMOVED):
            return str(newest.wanted.value)
        if world.removed != NO_EPOCH:
            return "removed"
        liar = self.search.liar
        if liar != NOBODY and any(it.promised.minter == liar or it.heir == liar for _, it in pairs):
            return "given to the liar"
        for me, it in pairs:
            if world.lost and it.state is not None and me in (it.owner, it.heir):
                other = it.promised.minter if it.owner == me else it.owner
                owners = [me for me, it in zip(self.names, self.registers, strict=True) if it.state is not None]
                if other not in here or other not in owners:
                    return "in doubt, the other's disk is lost or old: a person decides"
        if world.lost and not any(it.state is not None and me in (it.owner, it.heir) for me, it in pairs):
            return "lost with its disk: a person decides"
        if world.lost and not any(is_quorum(it.sets, here) for it in self.registers if it.stamp == newest.stamp):
            return "most members lost: a person decides"
        return ""

    def _standing(self) -> str:
        return " ".join(
            f"{me.agent}{me.journal}={it.epoch}/{it.no}:{it.wanted.value}{'' if it.state is not None else '-'}"
            f"(p{it.promised})"
            for me, it in zip(self.names, self.registers, strict=True)
        )
