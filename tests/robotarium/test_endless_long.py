"""Half an hour of the mission without an end, whole: with a death, and with robots that charge."""

from __future__ import annotations

from pathlib import Path

import pytest
from demo.flights import fly
from robotarium.test_endless_mission import check_endless


@pytest.mark.cpu_limit(200.0)
@pytest.mark.usefixtures("robotarium")
def test_half_an_hour_passes_by_both_judges(tmp_path: Path) -> None:
    flight = fly("endless", 1, tmp_path, faults=False, duration_s=1800.0)
    assert flight.summary["reasons"] == [] and flight.summary["verdict"] == "PASS"
    check_endless(flight)
    assert len(flight.summary["deaths"]) == 1 and flight.summary["charges"] >= 1
