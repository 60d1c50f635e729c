"""The tutorial of the plug-in, as it is written."""

from __future__ import annotations

from pathlib import Path

from harness.guide import ROOT, run_guide


def test_pi_tutorial_works_as_written(tmp_path: Path) -> None:
    run_guide(ROOT / "plugins" / "pancakes-pi" / "README.md", tmp_path)
