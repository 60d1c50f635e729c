"""One search, made in a process of its own, and what came of it."""

from __future__ import annotations

import time
from dataclasses import dataclass

from model.mutants import MUTANTS
from model.parts import Bounds
from model.search import Result, Search


@dataclass(frozen=True)
class Job:
    """One search: of the product's core within bounds, or of a mutant."""

    bounds: Bounds
    mutant: str = ""

    @property
    def name(self) -> str:
        """What it is called on the command line and in figures."""
        return self.mutant or str(self.bounds)


@dataclass(frozen=True)
class Report:
    """What came of it.

    Attributes:
        result: what the search found; None where it could not be made.
        fault: why it could not be made; empty where it could.
    """

    job: Job
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
        """Whether it came out as it must: no violation in all there is, or a mutant convicted."""
        if self.result is None:
            return False
        if self.job.mutant:
            return bool(self.result.violation)
        return self.result.complete and not self.result.violation


def carry_out(job: Job) -> Report:
    """Makes one search."""
    began_s = time.monotonic()
    try:
        result = search(job)
    except LookupError as error:
        return Report(job, None, time.monotonic() - began_s, str(error.args[0]))
    return Report(job, result, time.monotonic() - began_s)


def search(job: Job) -> Result:
    """Makes one search.

    Raises:
        LookupError: a mutant's edit does not match the source exactly once.
    """
    if not job.mutant:
        return Search(job.bounds).run()
    mutant = next(mutant for mutant in MUTANTS if mutant.name == job.mutant)
    return Search(job.bounds, mutant.make(), strict=False).run()
