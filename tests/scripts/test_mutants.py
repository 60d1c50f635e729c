"""`scripts/mutants` finds the tests that may notice a mutant, and judges whether one does."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILE = "area/sums.py"
TEXT = """\
LIMIT: int | None = 3


def double(number: int) -> int:
    return (
        number
        * 2
    )


def count(up_to: int) -> int:
    found = 0
    while found < up_to:
        found += 1
    return found
"""
TESTS = """\
from area.sums import count, double


def test_doubles():
    assert double(2) == 4


def test_counts():
    assert count(3) == 3
"""


@pytest.fixture(scope="module")
def mutants() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mutants", ROOT / "scripts" / "lib" / "mutants.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutants"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def tree(mutants, tmp_path):
    """Make a copy of a small project, with a time limit for its tests."""
    project = tmp_path / "project"
    for name, text in {FILE: TEXT, "area/__init__.py": "", "test_sums.py": TESTS, "setup.cfg": ""}.items():
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        (project / name).write_text(text)
    subprocess.run(["git", "init", "-q", str(project)], check=True)
    place = tmp_path / "place"
    place.mkdir()
    return lambda patience_s=60.0: mutants.Tree(project, place, patience_s)


def mutant_of(mutants, line: int, old: str, new: str):
    assert old in TEXT
    return mutants.Mutant(FILE, line, line, TEXT, TEXT.replace(old, new))


def trace_of(mutants, test: str, seconds: float, *lines: int):
    return mutants.Trace(test, seconds, {FILE: set(lines)} if lines else {})


def test_mutant_is_killed_by_a_failing_test(mutants, tree):
    tests = [trace_of(mutants, "test_sums.py::test_doubles", 0.0, 5)]
    copy = tree()
    assert copy.verdict(mutant_of(mutants, 7, "* 2", "* 3"), tests) == mutants.KILLED
    assert copy.verdict(mutant_of(mutants, 7, "* 2", "+ 2"), tests) == mutants.SURVIVES
    assert (copy.root / FILE).read_text() == TEXT


def test_endless_mutant_is_killed(mutants, tree):
    tests = [trace_of(mutants, "test_sums.py::test_counts", 0.0, 12)]
    endless = mutant_of(mutants, 14, "found += 1", "found -= 1")
    assert tree(patience_s=5.0).verdict(endless, tests) == mutants.TOO_LONG


def test_trace_has_the_lines_of_each_test(mutants, tree):
    pytest.importorskip("coverage")
    traces, failed = tree().trace("test_sums.py", [FILE])
    lines = {trace.test: trace.lines[FILE] for trace in traces}
    assert not failed
    assert lines["test_sums.py::test_doubles"] & {5, 6, 7} and 13 not in lines["test_sums.py::test_doubles"]
    assert {12, 13, 14, 15} <= lines["test_sums.py::test_counts"]


def test_tests_of_a_mutant_come_quickest_first(mutants):
    slow, quick = trace_of(mutants, "slow", 2.0, 5, 6), trace_of(mutants, "quick", 1.0, 5)
    other = trace_of(mutants, "other", 0.0, 12)
    assert mutants.tests_for(mutant_of(mutants, 7, "* 2", "* 3"), [slow, quick, other]) == [quick, slow]


def test_module_line_belongs_to_all_tests_of_the_module(mutants):
    one, two, none = trace_of(mutants, "one", 2.0, 5), trace_of(mutants, "two", 1.0, 12), trace_of(mutants, "none", 0.0)
    assert mutants.tests_for(mutant_of(mutants, 1, "= 3", "= 4"), [one, two, none]) == [two, one]


def test_line_run_at_import_belongs_to_all_tests(mutants):
    first, second = trace_of(mutants, "first", 2.0, 1, 5), trace_of(mutants, "second", 1.0, 12)
    assert mutants.tests_for(mutant_of(mutants, 1, "= 3", "= 4"), [first, second]) == [second, first]


def test_module_line_belongs_to_tests_that_name_the_module(mutants):
    assert mutants.names_module("tests/kernel/test_mailbox.py::test", "pancakes/kernel/pykka_actor.py")
    assert not mutants.names_module("tests/kernel/test_mailbox.py::test", "pancakes/kernel/timer.py")
    assert not mutants.names_module("no_such_file.py::test", "pancakes/kernel/pykka_actor.py")


def test_equal_mutant_is_recognised_by_its_lines(mutants):
    equal = mutants.Equal(FILE, "found = 0", "found = 0.0", "they are equal numbers")
    assert equal.is_of(mutant_of(mutants, 12, "found = 0", "found = 0.0"))
    assert not equal.is_of(mutant_of(mutants, 12, "found = 0", "found = 1"))


def test_annotations_are_not_mutated(mutants):
    assert mutants.left_to_mypy("def f(x: int | None) -> bool: ...") == [((1, 24), (1, 28)), ((1, 9), (1, 19))]
    assert mutants.left_to_mypy(TEXT)[0] == ((1, 7), (1, 17))
    assert mutants.left_to_mypy("class A(Struct, frozen=True): ...") == [((1, 23), (1, 27))]


def test_mutants_are_drawn_by_their_seed(mutants, tree):
    pytest.importorskip("cosmic_ray")
    root = tree().root
    drawn = [mutants.draw(root, [FILE], 5, mutants.random.Random(seed)) for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]
    assert len({mutant.after for mutant in drawn[0]}) == 5
    assert all("int | None" in mutant.after for mutants_ in drawn for mutant in mutants_)
