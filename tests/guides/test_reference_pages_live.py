"""The pages for those who look something up: their programs run, and print what the page says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from cli.processes import Rig
from harness.guide import ROOT, Example, example, examples, run_guide

PAGE = "docs/cheat-sheet.md"
WATCH = """
from dataclasses import dataclass

from pancakes import Task


class Watch(Task):
    @dataclass
    class Settings:
        busy_above: float = 1.0
"""
LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 10\n'


def python(begin: str) -> Example:
    return next(it for it in examples(PAGE) if it.language == "python" and begin in it.text)


def test_ros2_users_see_what_the_listener_heard(tmp_path: Path):
    run_guide(ROOT / "docs" / "ros2-users.md", tmp_path)


def test_cheat_sheet_task_passes_its_own_test():
    names: dict[str, Any] = {}
    for block in (python("class Patrol"), python("def test_")):
        exec(compile(block.text, str(block), "exec", dont_inherit=True), names)
    names["test_it_reports_each_second"]()


def test_cheat_sheet_script_migrates_and_listens(tmp_path: Path):
    rig = Rig(tmp_path)
    rig.install("watch", "[pancakes.tasks]\nwatch.Watch = plugin_watch:Watch\n", WATCH)
    try:
        rig.ready("left", LOAD + '[task.Watch]\ntype = "watch.Watch"\n')
        rig.ready("right", LOAD, agent='peers = ["local://left"]')
        script = example(PAGE, "from pancakes import Client")
        ended = subprocess.run(
            [sys.executable, "-c", script.text], env=rig.environment, capture_output=True, text=True, timeout=60.0
        )
        assert ended.returncode == 0, ended.stderr
        *tasks, winner, load = ended.stdout.splitlines()
        assert "left/client/Watch running" in tasks and winner == "right" and 0.0 <= float(load) <= 1.0
    finally:
        rig.close()


def test_concepts_and_readme_have_pictures_that_are_there():
    """In the SVGs nothing is loaded from elsewhere, and both schemes have their colours."""
    for name in ("concepts", "migration"):
        text = (ROOT / "docs" / "images" / f"{name}.svg").read_text(encoding="utf-8")
        assert "prefers-color-scheme: dark" in text and text.count("http") == text.count("http://www.w3.org/2000/svg")
