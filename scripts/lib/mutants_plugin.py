"""The part of scripts/mutants inside pytest: order the tests, or record the lines that each of them runs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

_ORDERS = json.loads(Path(os.environ["MUTANTS"]).read_text())
_SOURCES = [os.path.abspath(it) for it in _ORDERS.get("MUTANTS_SOURCES", "").split(":") if it]
_COVERAGE = None
_SECONDS: dict[str, float] = {}
_FAILED: list[str] = []

if _SOURCES:
    import coverage

    _COVERAGE = coverage.Coverage(data_file=None, include=_SOURCES)
    # A file of tests may run no line of the area.
    _COVERAGE.set_option("run:disable_warnings", ["no-data-collected"])
    _COVERAGE.start()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Select the requested tests, in the requested order."""
    if "MUTANTS_ORDER" in _ORDERS:
        place = {name: number for number, name in enumerate(json.loads(_ORDERS["MUTANTS_ORDER"]))}
        items[:] = sorted((it for it in items if it.nodeid in place), key=lambda it: place[it.nodeid])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Record the lines that run from now on under this test."""
    if _COVERAGE is not None:
        _COVERAGE.switch_context(item.nodeid)
    return (yield)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Record how long a test took, and whether it passed."""
    _SECONDS[report.nodeid] = _SECONDS.get(report.nodeid, 0.0) + report.duration
    if not report.passed:
        _FAILED.append(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write the notes."""
    if _COVERAGE is None:
        return
    _COVERAGE.stop()
    data, here = _COVERAGE.get_data(), os.getcwd()
    notes = {
        "passed": {name: seconds for name, seconds in _SECONDS.items() if name not in _FAILED},
        "failed": list(dict.fromkeys(_FAILED)),
        "lines": {os.path.relpath(file, here): data.contexts_by_lineno(file) for file in data.measured_files()},
    }
    Path(_ORDERS["MUTANTS_NOTES"]).write_text(json.dumps(notes))
