"""The link cut at the steps of a migration that matter most; `scripts/torture cuts` cuts it at all of them."""

from __future__ import annotations

from torture.cuts import FATES, Cutter

CASES = (("prepare", FATES[3]), ("promise", FATES[0]), ("promise", FATES[2]), ("known", FATES[3]))


def test_fault_cuts_end_as_the_protocol_says() -> None:
    """In one test, all at once: they wait for time-outs most of the time."""
    faults = {(case.step, case.fate): case.faults for case in Cutter().run(CASES, 4)}
    assert faults == dict.fromkeys(CASES, ())
