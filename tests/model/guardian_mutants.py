"""Broken variants of the guardians' core, each with the bounds of the search that must convict it."""

from __future__ import annotations

from typing import Final

import msgspec
from model.edited import edited
from model.guardian_search import GuardianBounds, GuardianSearch

from pancakes.mesh.guarding import guardian_core

QUICK: Final = GuardianBounds(beats=1)
CRASH: Final = GuardianBounds(beats=1, crashes=1)
TWO: Final = GuardianBounds(takers=2, beats=1)
YIELDS: Final = GuardianBounds(beats=1, yields=True)
BEATS: Final = GuardianBounds()
SUITE: Final = (QUICK, CRASH, TWO, YIELDS, BEATS)
TWO_YIELD: Final = GuardianBounds(takers=2, beats=1, yields=True)


class GuardianMutant(msgspec.Struct, frozen=True):
    """One broken variant.

    Attributes:
        story: what a hurried author would have done.
        old: text as it stands in the core, once.
        new: text instead.
        bounds: the bounds of the search that convicts it.
    """

    story: str
    old: str
    new: str
    bounds: GuardianBounds = QUICK

    def search(self) -> GuardianSearch:
        """Returns the search of this variant."""
        core = edited(guardian_core, self.story, self.old, self.new)
        return GuardianSearch(self.bounds, core)


MUTANTS: Final = (
    GuardianMutant(
        "a guardian pledges itself while its lease runs",
        "if lease.epoch is not None and lease.epoch > seize.yields:",
        "if False:",
    ),
    GuardianMutant(
        "an owner that stops for good ends the leases of all",
        "lease.epoch > seize.yields:",
        "seize.yields == NO_EPOCH:",
        TWO_YIELD,
    ),
    GuardianMutant(
        "a guardian gives no lease for what it keeps",
        "return [*write, SetLease(Lease(keep.epoch, lease.number + 1), keep.lease_s), AnswerAsker(kept)]",
        "return [*write, AnswerAsker(kept)]",
    ),
    GuardianMutant(
        "a guardian says that it keeps before it is on disk",
        "return [*write, SetLease(Lease(keep.epoch, lease.number + 1), keep.lease_s), AnswerAsker(kept)]",
        "return [SetLease(Lease(keep.epoch, lease.number + 1), keep.lease_s), AnswerAsker(kept), *write]",
        CRASH,
    ),
    GuardianMutant(
        "a guardian pledges itself before that is on disk",
        "return [WriteRegister(new), SetLease(replace(lease, epoch=None), 0.0), _pledge(me, new, seize.epoch)]",
        "return [_pledge(me, new, seize.epoch), WriteRegister(new), SetLease(replace(lease, epoch=None), 0.0)]",
        CRASH,
    ),
    GuardianMutant(
        "a guardian does not write down its pledge",
        "return [WriteRegister(new), SetLease(replace(lease, epoch=None), 0.0), _pledge(me, new, seize.epoch)]",
        "return [SetLease(replace(lease, epoch=None), 0.0), _pledge(me, new, seize.epoch)]",
    ),
    GuardianMutant(
        "a guardian that has restarted pledges itself at once",
        "return [SetLease(Lease(register.promised, 1), register.lease_s)]",
        "return []",
        CRASH,
    ),
    GuardianMutant(
        "a guardian goes on keeping for an owner whose epoch has passed",
        "if keep.epoch < register.promised:",
        "if False:",
    ),
    GuardianMutant(
        "a pledge tells of no checkpoint",
        "held = register.checkpoint, register.guards, register.body",
        "held = NO_CHECKPOINT, register.guards, None",
        BEATS,
    ),
    GuardianMutant(
        "an old checkpoint takes the place of a newer one",
        "if keep.body is not None and keep.checkpoint > register.checkpoint:",
        "if keep.body is not None:",
        BEATS,
    ),
    GuardianMutant(
        "a checkpoint that has not come counts as kept",
        "no = new.checkpoint.no if new.checkpoint.epoch == keep.epoch else -1",
        "no = 9",
        BEATS,
    ),
)
