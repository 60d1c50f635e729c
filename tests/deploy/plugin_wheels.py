"""Wheels for tests: that of this clone, and those of a small plug-in."""

from __future__ import annotations

import base64
import hashlib
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

REQUIRES = "Requires-Dist: pancakes-agents\n"
ROOT = Path(__file__).resolve().parents[2]
MODULE = """
from dataclasses import dataclass

from pancakes.task import Task, Tick, every

VERSION = "{version}"


class Walk(Task):
    @dataclass
    class Settings:
        broken: bool = False

    @dataclass
    class State:
        steps: int = 0

    settings: Settings
    state: State

    @every(hz=10)
    def step(self, tick: Tick) -> None:
        if self.settings.broken:
            raise ValueError("it has no legs")
        self.state.steps += 1
        if self.state.steps % 5 == 1:
            self.log("info", f"step {self.state.steps} of version {VERSION}")
"""


def clone_wheel(folder: Path) -> Path:
    """Build the wheel of this clone as it is."""
    copy = folder / "source"
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        copy.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, copy)
    shutil.copytree(ROOT / "pancakes", copy / "pancakes", ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(copy)], check=True, stdin=subprocess.DEVNULL)
    (wheel,) = folder.glob("pancakes_agents-*.whl")
    return wheel


def plugin_wheel(folder: Path, version: str, module: str = MODULE) -> Path:
    """Write the wheel of a plug-in that has the task `yard.Walk`, which `module` may define otherwise."""
    folder.mkdir(exist_ok=True)
    path = folder / f"yard-{version}-py3-none-any.whl"
    information = f"yard-{version}.dist-info"
    files = {
        "yard_walk.py": module.replace("{version}", version),
        f"{information}/METADATA": f"Metadata-Version: 2.1\nName: yard\nVersion: {version}\n{REQUIRES}",
        f"{information}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{information}/entry_points.txt": "[pancakes.tasks]\nyard.Walk = yard_walk:Walk\n",
    }
    record = "".join(f"{name},{_digest(text)},{len(text)}\n" for name, text in files.items())
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, f"{information}/RECORD": f"{record}{information}/RECORD,,\n"}.items():
            archive.writestr(name, text)
    return path


def _digest(text: str) -> str:
    return "sha256=" + base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b"=").decode()
