"""The tutorial of the plug-in, as it is written."""

from __future__ import annotations

from pathlib import Path

from harness.guide import ROOT, run_guide


def test_the_tutorial_works_as_it_is_written(tmp_path: Path) -> None:
    run_guide(ROOT / "plugins" / "pancakes-pi" / "README.md", tmp_path)
