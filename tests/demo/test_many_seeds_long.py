"""`pancakes demo NAME --virtual --seeds` with missions that take longer, and on a terminal."""

from __future__ import annotations

from pathlib import Path

import pytest
from demo.many_missions import check_same_bytes, demo
from demo.terminal import Terminal

PASSED = 0


@pytest.mark.parametrize(
    ("name", "seconds", "folders"), [("rescue", 125.0, ("",)), ("energy", 20.0, ("plain", "thresholds", "feedback"))]
)
def test_seeds_of_longer_demos_give_the_same_bytes(name, seconds, folders, tmp_path: Path):
    check_same_bytes(name, seconds, folders, tmp_path)


def test_seeds_pass_if_all_missions_pass(tmp_path: Path):
    shown = demo("encirclement", "--virtual", "--seeds", "1", "--headless", "--out", tmp_path)
    assert shown.exit_code == PASSED
    assert "PASS             1   1" in shown.stdout and "run again" not in shown.stdout
    assert shown.stderr == "seed 1: PASS\n"


def test_seeds_progress_bar_counts_and_vanishes(tmp_path: Path):
    arguments = ("--seeds", "1-3", "--jobs", "1", "--duration", "20", "--out", str(tmp_path / "out"))
    with Terminal(40, 100, "demo", "encirclement", "--virtual", *arguments) as terminal:
        screens = terminal.screens_until("run again: pancakes demo encirclement --virtual --seed 3")
    assert any("1/3 1 failed" in screen for screen in screens)
    assert "/3" not in screens[-1] and "FAIL             3   1-3" in screens[-1]
