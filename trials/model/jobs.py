"""One search, made in a process of its own, and what came of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Final

from model import guarded_scenarios, hosting_scenarios
from model.guarded_mutants import MUTANTS as GUARDED_MUTANTS
from model.guarded_search import GuardedSearch
from model.hosting_convictions import CONVICTED_IN
from model.hosting_mutants import make
from model.hosting_search import search
from model.mutants import MUTANTS
from model.parts import Bounds
from model.search import Result, Search

MOST_WORLDS: Final = 1_000_000
"""A deep search that finds more is not bounded as it should be."""


@dataclass(frozen=True)
class Job:
    """One search: of the hand-off's core within bounds, or of a mutant."""

    bounds: Bounds
    mutant: str = ""

    @property
    def name(self) -> str:
        """What it is called on the command line and in figures."""
        return self.mutant or str(self.bounds)

    @property
    def heading(self) -> str:
        """What searches of this kind are called."""
        return "broken variants of the core:" if self.mutant else "the core:"

    def search(self) -> Result:
        """Makes the search.

        Raises:
            LookupError: a mutant's edit does not match the source exactly once.
        """
        if not self.mutant:
            return Search(self.bounds).run()
        mutant = next(mutant for mutant in MUTANTS if mutant.name == self.mutant)
        return Search(self.bounds, mutant.make(), strict=False).run()


@dataclass(frozen=True)
class JoinedJob:
    """One search: of the machine that joins a life with its hand-off in a scenario, or of a mutant of that."""

    bounds: str
    mutant: str = ""

    @classmethod
    def of(cls, mutant: str) -> JoinedJob:
        """Returns the search that convicts a mutant."""
        return cls(CONVICTED_IN[mutant], mutant)

    @property
    def name(self) -> str:
        """What it is called on the command line and in figures."""
        return self.mutant or self.bounds

    @property
    def heading(self) -> str:
        """What searches of this kind are called."""
        return "broken variants of the join:" if self.mutant else "a life joined with its hand-off:"

    def search(self) -> Result:
        """Makes the search.

        Raises:
            LookupError: a mutant's edit does not match the source exactly once.
        """
        deep = hosting_scenarios.DEEP.get(self.bounds)
        if deep is not None:
            found = search(deep, at_most=MOST_WORLDS)
        elif self.mutant:
            found = search(hosting_scenarios.SUITE[self.bounds], make(self.mutant))
        else:
            found = search(hosting_scenarios.SUITE[self.bounds])
        return Result(found.violation, found.history, found.worlds, found.steps, found.worlds)


@dataclass(frozen=True)
class GuardedJob:
    """One search: of the cores of guarded tasks in a scenario, or of a mutant of theirs."""

    bounds: str
    mutant: str = ""

    @property
    def name(self) -> str:
        """What it is called on the command line and in figures."""
        return self.mutant or self.bounds

    @property
    def heading(self) -> str:
        """What searches of this kind are called."""
        return "broken variants of guarded tasks:" if self.mutant else "guarded tasks:"

    def search(self) -> Result:
        """Makes the search; a scenario that does not come to what it is there for is a broken promise too.

        Raises:
            LookupError: a mutant's edit does not match the source exactly once.
        """
        if self.mutant:
            mutant = next(mutant for mutant in GUARDED_MUTANTS if mutant.name == self.mutant)
            return GuardedSearch(mutant.scenario, mutant.make()).run()
        deep = self.bounds in guarded_scenarios.DEEP
        scenario = (guarded_scenarios.DEEP if deep else guarded_scenarios.SUITE)[self.bounds]
        search = GuardedSearch(scenario)
        found = search.run()
        missed = search.missed()
        if found.violation or not missed or not found.complete:
            return replace(found, reached=tuple(sorted(search.reached)))
        return replace(found, violation=f"the scenario, which never came to: {', '.join(missed)}")


AnyJob = Job | JoinedJob | GuardedJob


@dataclass(frozen=True)
class Report:
    """What came of it.

    Attributes:
        result: what the search found; None where it could not be made.
        fault: why it could not be made; empty where it could.
    """

    job: AnyJob
    result: Result | None
    wall_s: float
    fault: str = ""

    @property
    def trace(self) -> list[str]:
        """The way to the broken promise, in sentences, the promise last."""
        if self.result is None or not self.result.violation:
            return []
        return [*self.result.trace, f"That breaks {self.result.violation}."]

    @property
    def good(self) -> bool:
        """Whether it came out as it must: no violation in all there is, a deep one cut off or not; or a conviction."""
        if self.result is None:
            return False
        if self.job.mutant:
            return bool(self.result.violation)
        cut_off = isinstance(self.job, GuardedJob) and self.job.bounds in guarded_scenarios.DEEP
        return (self.result.complete or cut_off) and not self.result.violation


def carry_out(job: AnyJob) -> Report:
    """Makes one search."""
    began_s = time.monotonic()
    try:
        result = job.search()
    except LookupError as error:
        return Report(job, None, time.monotonic() - began_s, str(error.args[0]))
    return Report(job, result, time.monotonic() - began_s)
