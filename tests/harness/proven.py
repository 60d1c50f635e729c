"""Which of the dear tests passed for the files as they are: `tests/proven.json`, which `scripts/test --all` writes.

A subject is a part of the product with dear tests of its own: the protocols of durable tasks, which are searched at
full bounds, or a bridge to a program that others wrote. As long as none of its files changes there is nothing to find
out, so `.ci/run` leaves these tests out.
"""

from __future__ import annotations

import hashlib
import json
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "tests" / "proven.json"

SUBJECTS: dict[str, tuple[str, ...]] = {
    "durable tasks": (
        "pancakes/durable",
        "pancakes/supervision/lifecycle*.py",
        "pancakes/supervision/restart.py",
        "trials/register",
        "tests/life/*_full.py",
        "tests/register/*_full.py",
    ),
    "ROS 2": ("plugins/pancakes-ros2", "tests/ros2"),
    "Zenoh": ("plugins/pancakes-zenoh", "tests/zenoh_links"),
    "systemd": ("pancakes/tools/cli/systemd_unit.py", "pancakes/tools/cli/agent_process.py", "tests/systemd_vm"),
    "gpsd": ("plugins/pancakes-pi", "tests/pi"),
}
"""Each subject with its files: paths below the root, or patterns."""


def files_of(subject: str) -> list[Path]:
    """Returns the files of a subject, in order, without what tools leave there."""
    found: set[Path] = set()
    for place in SUBJECTS[subject]:
        for path in ROOT.glob(place):
            found.update(path.rglob("*") if path.is_dir() else [path])
    made = ("__pycache__", ".egg-info", "build")
    return sorted(it for it in found if it.is_file() and not any(part.endswith(made) for part in it.parts))


def digest_of(subject: str) -> str:
    """Returns a digest of the files of a subject."""
    whole = hashlib.sha256()
    for path in files_of(subject):
        whole.update(f"{path.relative_to(ROOT)}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return whole.hexdigest()


def subject_of(test_file: Path) -> str | None:
    """Returns the subject that a file of tests belongs to, if any."""
    name = test_file.relative_to(ROOT).as_posix()
    for subject, places in SUBJECTS.items():
        if any(fnmatch(name, place) or fnmatch(name, f"{place}/*") for place in places):
            return subject
    return None


def changed() -> frozenset[str]:
    """Returns the subjects whose files are not as they were when their tests passed."""
    passed = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}
    return frozenset(name for name in SUBJECTS if passed.get(name) != digest_of(name))


class Prover:
    """Sees the outcomes of a whole run, and writes down at its end which subjects passed. A plug-in of pytest."""

    def __init__(self) -> None:
        self._passed: set[str] = set()
        self._failed: set[str] = set()
        self._digests = {name: digest_of(name) for name in SUBJECTS}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        subject = subject_of(ROOT / report.nodeid.partition("::")[0])
        if subject is not None and report.failed:
            self._failed.add(subject)
        elif subject is not None and report.passed and report.when == "call":
            self._passed.add(subject)

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        if exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            return  # it was interrupted, and what did not run has not passed
        before = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}
        now = {name: self._digests[name] for name in self._passed - self._failed}
        after = {name: digest for name, digest in {**before, **now}.items() if name in SUBJECTS}
        FILE.write_text(json.dumps(after, indent=1, sort_keys=True) + "\n", encoding="utf-8")
