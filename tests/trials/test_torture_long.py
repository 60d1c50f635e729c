"""`scripts/torture missions`, by its real command."""

from __future__ import annotations

from typing import Any


def test_torture_missions_of_a_demo_pass(program: Any) -> None:
    ended = program("torture", "missions", "--demo", "intruder", "--seeds", "2", "--jobs", "2")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "2 passed, 0 failed" in ended.stdout
