"""Searches the guardians' core exhaustively: an owner, agents that want its task, and three guardians, within bounds.

The network is the set of all messages ever sent: each may be delivered at any time, any number of times, or never.
Guardians crash and restart between any two effects. Time is an order of ends: a permit counts from the sending of a
KEEP, a lease from its arrival, and is longer. So where a lease ends, every permit has ended whose KEEP was sent before
the lease began; nothing else is known of time.

Promises: S1 at most one agent acts; S3 an agent that takes the task goes on from all that more than half of the
guardians had.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from itertools import combinations, product
from types import ModuleType
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.mesh.guarding import guardian_core
from pancakes.mesh.guarding.guard_messages import CheckpointBody, CheckpointId, KeepLease, LeaseKept, Pledge, SeizeTask
from pancakes.mesh.guarding.guardian_core import AnswerAsker, GuardRegister, Lease, LeaseOver, SetLease, WriteRegister
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.record import TaskId

TASK: Final = TaskId("a", "Task")
MEMBERS: Final = tuple(GuardianId(name, "j") for name in "xyz")
NAMES: Final = "abc"
"""The owner first, and those that want its task."""
EPOCHS: Final = tuple(Epoch(1 + index, name) for index, name in enumerate(NAMES))


class GuardianBounds(msgspec.Struct, frozen=True):
    """What may happen in one history, and how often.

    Attributes:
        takers: so many agents want the task.
        beats: so often the owner asks for leases; those that take the task ask once.
        acts: so often the task acts, in all.
        crashes: so often a guardian crashes.
        yields: whether an owner may stop for good, and say so.
    """

    takers: int = 1
    beats: int = 2
    acts: int = 1
    crashes: int = 0
    yields: bool = False


class Claimant(msgspec.Struct, frozen=True):
    """An agent that has the task, or wants it.

    Attributes:
        stage: "idle", "seizes", "owns" or "gone".
        beat: how often it has asked for leases.
        permit: the newest beat that it acts by; 0: it does not act.
        expired: no beat up to this gives a permit any more.
        states: what the task was at each of its checkpoints.
    """

    stage: str = "idle"
    beat: int = 0
    permit: int = 0
    expired: int = 0
    states: tuple[int, ...] = ()


class GuardianState(msgspec.Struct, frozen=True):
    """A guardian.

    Attributes:
        register: what is on its disk.
        lease: its lease.
        mark: how often each claimant had asked when that began.
        kept: its answers to owners: the owner, the beat and the number of the checkpoint.
        pledged: its pledges: the taker, the checkpoint, and what the task was then.
    """

    register: GuardRegister = GuardRegister(TASK)
    lease: Lease = Lease()
    mark: tuple[int, ...] = ()
    kept: frozenset[tuple[Epoch, int, int]] = frozenset()
    pledged: frozenset[tuple[Epoch, CheckpointId, int]] = frozenset()


class GuardedWorld(msgspec.Struct, frozen=True):
    """What there is.

    Attributes:
        claimants: the agents that have the task, or want it.
        guardians: the guardians, in the order in which they are the same world as in any other.
        sent: what claimants have sent, each to all guardians.
        acked: the newest state of the task that more than half of the guardians had.
        crashes: how often a guardian has crashed.
    """

    claimants: tuple[Claimant, ...]
    guardians: tuple[GuardianState, ...]
    sent: frozenset[Any] = frozenset()
    acked: int = 0
    crashes: int = 0


class BrokenPromise(Exception):
    """A promise is broken."""


class GuardianSearch:
    """One search.

    Args:
        bounds: what may happen.
        core: the guardians' core, or a variant of it.
    """

    def __init__(self, bounds: GuardianBounds, core: ModuleType = guardian_core) -> None:
        self.bounds = bounds
        self._core: Any = core
        self.met: Counter[str] = Counter()
        self.worlds = 0

    def run(self) -> tuple[str, list[str]]:
        """Returns the promise that is broken, empty: none is, and the shortest history that breaks it."""
        claimants = (Claimant("owns", states=(0,)), *(Claimant() for _ in range(self.bounds.takers)))
        first = GuardedWorld(claimants, (GuardianState(mark=(0,) * len(claimants)),) * len(MEMBERS))
        seen: dict[GuardedWorld, tuple[GuardedWorld | None, str]] = {first: (None, "")}
        waiting = deque([first])
        while waiting:
            world = waiting.popleft()
            try:
                for what, reached in self._steps(world):
                    following = _plain(reached)
                    if following not in seen:
                        seen[following] = (world, what)
                        self._check(following)
                        waiting.append(following)
            except BrokenPromise as broken:
                return str(broken), _history(seen, world)
        self.worlds = len(seen)
        return "", []

    def _check(self, world: GuardedWorld) -> None:
        acting = [NAMES[index] for index, it in enumerate(world.claimants) if it.permit]
        if len(acting) > 1:
            raise BrokenPromise(f"S1: {' and '.join(acting)} act")
        for name in acting:
            self.met[f"{name} acts"] += 1

    def _steps(self, world: GuardedWorld) -> Iterator[tuple[str, GuardedWorld]]:
        for index, claimant in enumerate(world.claimants):
            for what, following in self._of_claimant(world, index, claimant):
                yield f"{NAMES[index]} {what}", following
        for index, guardian in enumerate(world.guardians):
            if guardian in world.guardians[:index]:
                continue
            for message in world.sent:
                for following in self._told(world, index, message):
                    yield f"a guardian gets {type(message).__name__} of {message.epoch}", following
            if guardian.lease.epoch is not None and all(
                not it.permit or it.permit > mark for it, mark in zip(world.claimants, guardian.mark, strict=True)
            ):
                past = tuple(
                    replace(it, expired=max(it.expired, mark))
                    for it, mark in zip(world.claimants, guardian.mark, strict=True)
                )
                over = LeaseOver(guardian.lease.number)
                for following in self._told(replace(world, claimants=past), index, over):
                    yield "a lease ends", following
            if world.crashes < self.bounds.crashes:
                self.met["a guardian restarts"] += 1
                again = replace(world, crashes=world.crashes + 1)
                yield "a guardian restarts", self._restarted(again, index, guardian.register)

    # Claimants -------------------------------------------------------------------------------------------------

    def _of_claimant(self, world: GuardedWorld, index: int, it: Claimant) -> Iterator[tuple[str, GuardedWorld]]:
        epoch = EPOCHS[index]
        if it.stage == "idle":
            yields = [NO_EPOCH]
            if world.claimants[0].stage == "gone":
                self.met["a task is given up, and taken"] += 1
                yields.append(EPOCHS[0])
            for one in yields:
                seize = SeizeTask(TASK, "t", epoch, one, Guards(EPOCHS[0], 0, (MEMBERS,)))
                yield "begins to take the task", _sends(_with(world, index, replace(it, stage="seizes")), seize)
        if it.stage == "seizes":
            yield from self._takes_over(world, index, it)
        if it.stage != "owns":
            return
        if it.beat < (self.bounds.beats if index == 0 else 1):
            checkpoint, body = CheckpointId(epoch, len(it.states) - 1), CheckpointBody(bytes(it.states[-1:]))
            guards = Guards(epoch, 0, (MEMBERS,))
            keep = KeepLease(TASK, "t", epoch, it.beat + 1, 1.0, checkpoint, guards, body)
            yield "asks for leases", _sends(_with(world, index, replace(it, beat=it.beat + 1)), keep)
        for beat in range(max(it.permit, it.expired) + 1, it.beat + 1):
            if _have(world, epoch, beat, -1):
                yield f"may act by beat {beat}", _with(world, index, replace(it, permit=beat))
        for no, state in enumerate(it.states):
            if state > world.acked and _have(world, epoch, 0, no):
                self.met["a checkpoint is held by more than half"] += 1
                yield f"acknowledges {state}", replace(world, acked=state)
        if it.permit:
            if it.states[-1] < self.bounds.acts:
                yield "acts", _with(world, index, replace(it, states=(*it.states, it.states[-1] + 1)))
            still = replace(it, permit=0, expired=max(it.expired, it.permit))
            yield "has no permit any more", _with(world, index, still)
        if self.bounds.yields and index == 0:
            yield "stops for good", _with(world, index, replace(it, stage="gone", permit=0))

    def _takes_over(self, world: GuardedWorld, index: int, it: Claimant) -> Iterator[tuple[str, GuardedWorld]]:
        theirs = [[pledge for pledge in one.pledged if pledge[0] == EPOCHS[index]] for one in world.guardians]
        for pair in combinations(theirs, 2):
            for pledges in product(*pair):
                _, _, state = max(pledges, key=lambda pledge: pledge[1])
                if state < world.acked:
                    raise BrokenPromise(f"S3: {NAMES[index]} goes on from {state}, and {world.acked} was acknowledged")
                self.met[f"{NAMES[index]} takes over"] += 1
                yield "takes over", _with(world, index, replace(it, stage="owns", states=(state,)))

    # Guardians -------------------------------------------------------------------------------------------------

    def _told(self, world: GuardedWorld, to: int, event: Any) -> Iterator[GuardedWorld]:
        guardian = world.guardians[to]
        effects = self._core.handle(MEMBERS[to], guardian.register, guardian.lease, event)
        for cut in range(1, len(effects) + 1):
            after = self._after(world, to, effects[:cut])
            if cut == len(effects):
                yield after
            elif world.crashes < self.bounds.crashes:
                crashed = replace(after, crashes=after.crashes + 1)
                yield self._restarted(crashed, to, crashed.guardians[to].register)

    def _after(self, world: GuardedWorld, to: int, effects: list[Any]) -> GuardedWorld:
        guardian = world.guardians[to]
        for effect in effects:
            match effect:
                case WriteRegister(register):
                    guardian = replace(guardian, register=register)
                case SetLease(lease, _):
                    guardian = replace(guardian, lease=lease, mark=tuple(it.beat for it in world.claimants))
                case AnswerAsker(LeaseKept() as kept):
                    guardian = replace(guardian, kept=guardian.kept | {(kept.epoch, kept.beat, kept.no)})
                case AnswerAsker(Pledge() as pledge):
                    state = pledge.body.snapshot[0] if pledge.body is not None else 0
                    said = (pledge.epoch, pledge.checkpoint, state)
                    guardian = replace(guardian, pledged=guardian.pledged | {said})
        return replace(world, guardians=(*world.guardians[:to], guardian, *world.guardians[to + 1 :]))

    def _restarted(self, world: GuardedWorld, to: int, register: GuardRegister) -> GuardedWorld:
        before = world.guardians[to]
        blank = GuardianState(register, mark=before.mark, kept=before.kept, pledged=before.pledged)
        guardians = (*world.guardians[:to], blank, *world.guardians[to + 1 :])
        return self._after(replace(world, guardians=guardians), to, self._core.recover(register))


def _plain(world: GuardedWorld) -> GuardedWorld:
    """Returns a world without what makes no difference any more."""
    expired = [it.expired for it in world.claimants]
    plain = []
    for guardian in world.guardians:
        # Leases are not numbered: timers that come late are the actor's to forget.
        lease = Lease(guardian.lease.epoch)
        late = zip(guardian.mark, expired, strict=True)
        mark = tuple(one if lease.epoch is not None and one > past else 0 for one, past in late)
        plain.append(replace(guardian, lease=lease, mark=mark, kept=_newest_of(guardian.kept)))
    return replace(world, guardians=tuple(sorted(plain, key=hash)))


def _newest_of(kept: frozenset[tuple[Epoch, int, int]]) -> frozenset[tuple[Epoch, int, int]]:
    """Returns the answers that say more than another one of the same guardian."""
    return frozenset(
        one
        for one in kept
        if not any(it != one and it[0] == one[0] and it[1] >= one[1] and it[2] >= one[2] for it in kept)
    )


def _with(world: GuardedWorld, index: int, claimant: Claimant) -> GuardedWorld:
    return replace(world, claimants=(*world.claimants[:index], claimant, *world.claimants[index + 1 :]))


def _have(world: GuardedWorld, epoch: Epoch, beat: int, no: int) -> bool:
    """Returns whether more than half of the guardians have answered an owner at least so much."""
    have = [any(it[0] == epoch and it[1] >= beat and it[2] >= no for it in one.kept) for one in world.guardians]
    return 2 * sum(have) > len(MEMBERS)


def _sends(world: GuardedWorld, message: Any) -> GuardedWorld:
    return replace(world, sent=world.sent | {message})


def _history(seen: dict[GuardedWorld, tuple[GuardedWorld | None, str]], world: GuardedWorld | None) -> list[str]:
    told: list[str] = []
    while world is not None:
        world, what = seen[world]
        told.append(what)
    return told[::-1]
