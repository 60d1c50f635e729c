"""The rules of registers, searched in all scenarios, and each broken variant convicted: minutes."""

from __future__ import annotations

import pytest
from register.mutants import MUTANTS
from register.scenarios import LIARS, SUITE
from register.search import Search


@pytest.mark.parametrize("scenario", [*SUITE, *LIARS], ids=lambda it: it.title)
def test_scenario_keeps_all_promises(scenario):
    found = Search(scenario).run()
    assert found.verdict == "ok", "\n".join((found.verdict, *found.trace))


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda it: it.name)
def test_broken_variant_is_convicted(mutant):
    _, found = mutant.convict()
    assert found.verdict[:2] in ("S1", "S2", "S3", "S4", "S5", "S6", "S7", "L1") and found.trace
