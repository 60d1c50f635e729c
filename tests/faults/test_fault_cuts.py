"""The link cut where it matters most; all steps are cut by `scripts/torture cuts`."""

from __future__ import annotations

from torture.cuts import FATES, STEPS, Cutter

CASES = [(step, fate) for step in STEPS[-4:] for fate in FATES[-2:]] + [("reserve", FATES[1]), ("commit", FATES[0])]


def test_each_cut_ends_as_the_protocol_says() -> None:
    """In one test, all at once: they wait for time-outs most of the time."""
    faults = {(case.step, case.fate): case.faults for case in Cutter().run(CASES, 5)}
    assert faults == dict.fromkeys(CASES, ())
