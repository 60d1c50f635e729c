"""The secret of a page is kept for the next start at the same port, privately."""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path

import pytest

from pancakes.tools.web.page_secret import OLDEST_S, secret_of


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "runtime"))
    return tmp_path / "runtime"


def test_secret_is_the_same_after_a_restart(runtime: Path):
    known = secret_of(7480, control=False)
    assert len(known) >= 32 and secret_of(7480, control=False) == known
    assert secret_of(7481, control=False) != known
    assert secret_of(7480, control=True) != known
    assert stat.S_IMODE((runtime / "view-7480.token").stat().st_mode) == 0o600


def test_secret_that_others_could_know_is_replaced(runtime: Path, tmp_path: Path):
    file = runtime / "view-7480.token"
    known = secret_of(7480, control=False)
    file.chmod(0o644)
    changed = secret_of(7480, control=False)
    assert changed != known and stat.S_IMODE(file.stat().st_mode) == 0o600
    for odd in (b"", b"short", b"\xff" * 40, b"x" * 90):
        file.write_bytes(odd)
        assert secret_of(7480, control=False).encode() != odd
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("x" * 40)
    file.unlink()
    file.symlink_to(elsewhere)
    assert secret_of(7480, control=False) != "x" * 40


def test_old_secret_is_replaced(runtime: Path):
    known = secret_of(7480, control=False)
    past = time.time() - OLDEST_S - 10.0
    os.utime(runtime / "view-7480.token", (past, past))
    assert secret_of(7480, control=False) != known


def test_secret_that_cannot_be_kept_differs_each_time(runtime: Path):
    runtime.write_text("no folder")
    assert secret_of(7480, control=False) != secret_of(7480, control=False)
