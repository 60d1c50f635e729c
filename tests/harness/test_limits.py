"""A test that takes too long fails with the stacks of all threads, alone and under xdist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

TESTS = Path(__file__).parents[1]

CONFTEST = """
pytest_plugins = ["harness.limits"]


def pytest_configure():
    from harness import limits

    limits.AGAIN_S = 2.0
    limits.NET_S = 1.0
"""

HANGS = """
import itertools
import threading

import hypothesis
import pytest
from harness.limits import cpu_limit_s
from hypothesis import strategies as st

gate = threading.Event()
burnt = threading.Event()


def burn():
    while not burnt.is_set():
        pass


def bystand():
    gate.wait()


@pytest.fixture(autouse=True)
def begin():
    burnt.clear()
    gate.clear()


@pytest.fixture
def bystander():
    thread = threading.Thread(target=bystand, name="bystander", daemon=True)
    thread.start()
    yield
    gate.set()


@pytest.mark.cpu_limit(0.3)
def test_cpu(bystander):
    burn()


@pytest.mark.cpu_limit(0.3)
def test_cpu_of_a_thread():
    threading.Thread(target=burn, daemon=True).start()
    try:
        while True:
            threading.Event().wait(0.1)
    finally:
        burnt.set()


@pytest.mark.cpu_limit(0.3)
@hypothesis.given(st.integers())
@hypothesis.settings(deadline=None)
def test_cpu_of_an_example(number):
    burn()


@pytest.mark.timeout(1)
def test_wall(bystander):
    threading.Event().wait()


@pytest.fixture
def slow_to_end():
    yield
    burn()


@pytest.mark.cpu_limit(0.3)
def test_cpu_of_a_fixture(slow_to_end):
    pass


def swallow():
    try:
        burn()
    except BaseException:
        pass


@pytest.mark.cpu_limit(0.3)
def test_swallowed():
    swallow()
    swallow()


@pytest.mark.cpu_limit(0.3)
def test_misleading():
    swallow()
    assert False, "bytes differ"


@pytest.mark.cpu_limit(0.3)
@pytest.mark.timeout(600)
def test_waiting_is_no_work():
    assert not threading.Event().wait(0.5)


@pytest.mark.cpu_limit(60)
class TestNearestMarker:
    def test_of_the_class(self, request):
        assert cpu_limit_s(request.node) == 60.0

    @pytest.mark.cpu_limit(5.5)
    def test_of_its_own(self, request):
        assert cpu_limit_s(request.node) == 5.5


def test_without_limits(request):
    assert cpu_limit_s(request.node) == 0.0
"""

STUCK = """
import itertools

import pytest


def stuck_in_c():
    sum(itertools.repeat(0))  # never comes back to Python, where a signal's handler could run


@pytest.mark.timeout(1)
def test_stuck():
    stuck_in_c()


@pytest.mark.timeout(1)
def test_fine():
    pass


@pytest.fixture
def stuck_at_the_end():
    yield
    stuck_in_c()


@pytest.mark.timeout(1)
def test_stuck_after_it_failed(stuck_at_the_end):
    assert False
"""


@pytest.fixture
def pytest_of(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch):
    """Runs pytest in a process of its own with the plug-in."""
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(TESTS))

    def run(source: str, *options: str) -> pytest.RunResult:
        pytester.makeconftest(CONFTEST)
        pytester.makepyfile(test_inner=source)
        return pytester.runpytest_subprocess("-W", "error", "-p", "no:cacheprovider", *options, timeout=300)

    return run


@pytest.mark.parametrize("options", [(), ("-n", "2")], ids=["alone", "xdist"])
def test_over_limit_fails_with_stacks(pytest_of, options):
    result = pytest_of(HANGS, *options)
    result.assert_outcomes(failed=6, passed=5, errors=1)
    parts = re.split(r"^_{3,} (.+) _{3,}$", result.stdout.str(), flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    for name, section in sections.items():
        assert ("more than 1 s" if name == "test_wall" else "more than 0.3 s of CPU time") in section, name
        assert "Stack of MainThread:" in section and ("in burn" in section or name == "test_wall"), name
    for name in ("test_cpu", "test_wall"):
        assert "Stack of bystander:" in sections[name] and "in bystand" in sections[name]
    assert "threading.Event().wait()" in sections["test_wall"].partition("Stack of MainThread")[2]
    assert "went on" in sections["test_swallowed"] and "bytes differ" in sections["test_misleading"]


@pytest.mark.parametrize("options", [(), ("-n", "1")], ids=["alone", "xdist"])
@pytest.mark.parametrize("test", ["test_stuck", "test_stuck_after_it_failed"])
def test_hang_in_c_ends_the_process_with_stacks(pytest_of, options, test):
    result = pytest_of(STUCK, *options, "-k", f"{test} or test_fine")
    assert result.ret == 1
    result.stderr.fnmatch_lines(["Timeout (*)!", "*in stuck_in_c"])
    if options:
        result.stdout.fnmatch_lines(["*crashed while running*test_inner.py::test_stuck*"])
        assert result.parseoutcomes()["passed"] == 1
