"""The link cut at more steps of a migration."""

from __future__ import annotations

from torture.cuts import FATES, STEPS, Cutter

CASES = [(step, fate) for step in [*STEPS][-4:] for fate in FATES[-2:]] + [("bid", FATES[1]), ("prepare", FATES[0])]


def test_fault_cuts_end_as_the_protocol_says() -> None:
    faults = {(case.step, case.fate): case.faults for case in Cutter().run(CASES, 5)}
    assert faults == dict.fromkeys(CASES, ())
