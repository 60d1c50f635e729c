"""Broken variants of the cores of guarded tasks, each of which the search must convict."""

from __future__ import annotations

from types import ModuleType
from typing import Final

import msgspec
from model.edited import edited
from model.guarded_parts import Rules, Scenario
from model.guarded_scenarios import DEEP, SUITE

from pancakes.durable import guarding, handoff

Edit = tuple[ModuleType, str, str]

TAKER: Final = Scenario("a taker", takers="B", crashes="")
CRASH: Final = Scenario("a taker, and a guardian crashes", takers="B", crashes="C")
PACKET: Final = SUITE["what was replicated"]
PACKET_CRASH: Final = Scenario("what was replicated, and a guardian crashes", takers="C", packets=1, crashes="B")
LATE_PACKET: Final = Scenario("what was replicated, and comes late", takers="B", packets=1, own=2, crashes="")
TWO: Final = SUITE["two takers"]
MOVE: Final = Scenario("a hand-off, and its source crashes", owner="B", takers="", moves="A", numbers=2, crashes="B")
MOVE_CALM: Final = Scenario("a hand-off", owner="B", takers="", moves="A", numbers=2, crashes="")
MOVE_TAKER: Final = SUITE["a hand-off and a taker"]
LOWER_TAKER: Final = Scenario("a taker below the offer", owner="C", takers="A", moves="B", numbers=2, crashes="")
SWAP: Final = DEEP["guardians replaced, two askings"]
SET_UP: Final = SUITE["the guard set up"]
STOP: Final = SUITE["stopped and started"]
GOODBYE: Final = SUITE["a goodbye"]
GOODBYE_CRASH: Final = Scenario("a goodbye, and a guardian crashes", takers="B", goodbyes=1, crashes="C")
SWAPPED: Final = SUITE["guardians replaced, and not all know"]
ADOPT: Final = SUITE["adopted"]


class GuardedMutant(msgspec.Struct, frozen=True):
    """One broken variant.

    Attributes:
        name: what a hurried author would have done.
        edits: module, text as it stands there once, text instead.
        scenario: the one that convicts it.
        prunes: as in `Rules`.
        tells_copies: as in `Rules`.
    """

    name: str
    edits: tuple[Edit, ...]
    scenario: Scenario = TAKER
    prunes: bool = True
    tells_copies: bool = True

    def make(self) -> Rules:
        """Returns the rules with the edits made.

        Raises:
            LookupError: a text does not stand in its module exactly once.
        """
        of_core = [(old, new) for module, old, new in self.edits if module is handoff]
        of_guards = [(old, new) for module, old, new in self.edits if module is guarding]
        core = edited(handoff, self.name, *of_core) if of_core else handoff
        guardian = edited(guarding, self.name, *of_guards) if of_guards else guarding
        # What an owner and a taker keep stays with their callers, so a variant may have classes of its own.
        both = edited(guarding, self.name, *of_guards, own_classes=True) if of_guards else guarding
        return Rules(core, guardian, both, both, self.tells_copies, self.prunes)


def _mutant(
    name: str, module: ModuleType, old: str, new: str, scenario: Scenario = TAKER, prunes: bool = True
) -> GuardedMutant:
    return GuardedMutant(name, ((module, old, new),), scenario, prunes)


_KEPT: Final = "return [*write, SetLease(granted, keep.lease_s), AnswerAsker(kept)]"
_PLEDGED: Final = (
    "return [WriteRegister(new), SetLease(replace(lease, epoch=None), 0.0), _pledge(me, new, seize.epoch)]"
)

MUTANTS: Final = (
    # A guardian.
    _mutant(
        "a guardian pledges itself while its lease runs",
        guarding,
        "if lease.epoch is not None:",
        "if False:",
    ),
    _mutant("a guardian gives no lease for what it keeps", guarding, _KEPT, "return [*write, AnswerAsker(kept)]"),
    _mutant(
        "a guardian says KEPT before it is on disk",
        guarding,
        _KEPT,
        "return [SetLease(granted, keep.lease_s), AnswerAsker(kept), *write]",
        PACKET_CRASH,
    ),
    _mutant(
        "a guardian says PLEDGE before it is on disk",
        guarding,
        _PLEDGED,
        "return [_pledge(me, new, seize.epoch), WriteRegister(new), SetLease(replace(lease, epoch=None), 0.0)]",
        PACKET_CRASH,
    ),
    _mutant(
        "a guardian does not write down its promise",
        guarding,
        _PLEDGED,
        "return [SetLease(replace(lease, epoch=None), 0.0), _pledge(me, new, seize.epoch)]",
    ),
    _mutant(
        "a guardian that has restarted pledges itself at once",
        guarding,
        "    return [SetLease(Lease(register.promised, 1, boot=boot), register.lease_s)]",
        "    return []",
        CRASH,
    ),
    _mutant(
        "a guardian keeps for an owner whose epoch has passed",
        guarding,
        "if keep.epoch < register.promised:",
        "if False:",
    ),
    _mutant(
        "a guardian promises itself to a lower epoch",
        guarding,
        "if seize.epoch <= register.promised:",
        "if False:",
        TWO,
    ),
    _mutant(
        "a pledge tells of no checkpoint",
        guarding,
        "held = register.checkpoint, register.guards, register.body",
        "held = NO_CHECKPOINT, register.guards, CheckpointBody(bytes(1))",
        PACKET,
    ),
    _mutant(
        "an old checkpoint takes the place of a newer one",
        guarding,
        "if keep.body is not None and keep.checkpoint > register.checkpoint:",
        "if keep.body is not None:",
        LATE_PACKET,
    ),
    _mutant(
        "old guards take the place of newer ones",
        guarding,
        "guards=newest(register.guards, keep.guards),",
        "guards=keep.guards,",
        SWAPPED,
        prunes=False,
    ),
    _mutant(
        "a guardian that is to join, and knows nothing, pledges nothing",
        guarding,
        "if not register.guards.sets and me not in seize.guards.members():",
        "if not register.guards.sets:",
        SET_UP,
    ),
    _mutant("a goodbye ends a lease that was granted since", guarding, " and said.beat >= lease.beat", "", GOODBYE),
    _mutant(
        "a goodbye to a former life of a guardian ends its lease",
        guarding,
        " and said.boot == lease.boot",
        "",
        GOODBYE_CRASH,
    ),
    _mutant(
        "a KEEP that comes late makes a lease an old one",
        guarding,
        "beat = max(lease.beat, keep.beat) if lease.epoch == keep.epoch else keep.beat",
        "beat = keep.beat",
        GOODBYE,
    ),
    # An owner.
    _mutant(
        "one guardian gives a permit",
        guarding,
        "if guards.has_quorum(_named(known, beat))), 0)",
        "if _named(known, beat)), 0)",
    ),
    _mutant(
        "what one guardian has is acknowledged",
        guarding,
        "(no for no in numbers if guards.has_quorum({one.guardian for one in self.answers if one.no >= no})), -1",
        "iter(numbers), -1",
        PACKET,
    ),
    _mutant("what is on the owner's disk is acknowledged", guarding, "if at.no <= no]", "]", PACKET),
    _mutant(
        "an owner that a guardian has left waits for ever for one that is gone",
        guarding,
        " and not self._is_silent(it)",
        "",
        TWO,
    ),
    _mutant(
        "a guardian is not told what is wanted of the task",
        guarding,
        "CheckpointBody(record.snapshot, record.wanted) if with_body",
        "CheckpointBody(record.snapshot) if with_body",
        STOP,
    ),
    # A taker.
    _mutant(
        "a taker is content with one pledge",
        guarding,
        "not self.guards.has_quorum(self.pledged)",
        "not self.pledged",
        PACKET,
    ),
    _mutant(
        "a taker goes on from the first checkpoint that it is told of",
        guarding,
        "if answer.body is not None and answer.checkpoint > seizing.checkpoint:",
        "if answer.body is not None and seizing.body is None:",
        PACKET,
    ),
    _mutant(
        "a taker counts the guardians that it knew",
        guarding,
        "guards=newest(seizing.guards, answer.guards)",
        "guards=seizing.guards",
        SWAPPED,
    ),
    # The record of the task.
    _mutant(
        "guardians are replaced without the consent of the old ones",
        handoff,
        "record.guards.version + 1, event.sets)",
        "record.guards.version + 1, event.sets[-1:])",
        SWAP,
    ),
    _mutant(
        "a checkpoint has the number of the one before",
        handoff,
        "no=before.no if alike else before.no + 1",
        "no=before.no",
        PACKET,
    ),
    _mutant(
        "a stop is no new checkpoint",
        handoff,
        "alike = (before.snapshot, before.wanted) == (record.snapshot, record.wanted)",
        "alike = before.snapshot == record.snapshot",
        STOP,
    ),
    _mutant("a task that was stopped runs where it is taken over", handoff, "        wanted=event.wanted,\n", "", STOP),
    _mutant(
        "an owner that is passed does not give the task up",
        handoff,
        "if record.phase is not Phase.OWNER or permit or event.epoch <= record.epoch:",
        "if True:",
    ),
    _mutant(
        "a permit does not start the task",
        handoff,
        "return [Remember(Volatile(running=True)), start]",
        "return [Remember(Volatile(running=True))]",
    ),
    # Copies of disks.
    GuardedMutant("a copy of a guardian's disk is believed", (), SUITE["the disk of a guardian copied"], True, False),
    # A hand-off. What its source does too early is no harm here, as its guardians let two act at no time: the search of
    # hand-offs without guardians convicts it.
    _mutant("a destination runs without the guardians", handoff, "if message.guards.sets:", "if False:", MOVE_TAKER),
    _mutant(
        "a destination drops what it is offered at the word of any owner",
        handoff,
        "if event.epoch <= record.offer:",
        "if False:",
        MOVE_CALM,
    ),
    _mutant(
        "an adoption has the next epoch that is free here",
        handoff,
        "max(event.jump, MORE_THAN_MOVES)",
        "event.jump",
        ADOPT,
    ),
)
