"""The demos of distributions that were built and installed: nothing of the clone is in reach, nor is it needed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DEMOS = ("encirclement", "endless", "energy", "intruder", "pioneer", "rescue", "robotarium", "sensor-field")
LIVE_ONLY = "ros2"
NOT_SOURCES = shutil.ignore_patterns("*.egg-info", "build", "__pycache__")
Pancakes = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the project and its plug-ins as their wheels bring them."""
    clone = tmp_path_factory.mktemp("clone")
    for name in ("pancakes", "plugins", "configs"):
        shutil.copytree(ROOT / name, clone / name, symlinks=True, ignore=NOT_SOURCES)
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, clone / name)
    site = tmp_path_factory.mktemp("site")
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-compile",
        "--no-build-isolation",
        "--no-index",
    ]
    plugins = [str(path.parent) for path in sorted(clone.glob("plugins/*/setup.cfg"))]
    assert len(plugins) == 7
    subprocess.run([*pip, "--target", str(site), str(clone), *plugins], check=True, cwd=clone)
    shutil.rmtree(clone)
    return site


@pytest.fixture
def pancakes(installed: Path, tmp_path: Path) -> Pancakes:
    """Runs `pancakes` as it was installed, in an empty folder."""
    environment = {**os.environ, "PYTHONPATH": str(installed), "PANCAKES_RUNTIME_DIR": str(tmp_path / "run")}
    folder = tmp_path / "empty"
    folder.mkdir()

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pancakes.tools.cli.main", *arguments]
        return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=60)

    return run


def test_wheels_bring_demos_that_run(pancakes: Pancakes, tmp_path: Path) -> None:
    """One demo of each distribution runs in an empty folder, and all are listed."""
    listed = pancakes("demo", "--list")
    assert {*DEMOS, LIVE_ONLY} <= {line.split()[0] for line in listed.stdout.splitlines()}, listed.stderr
    for demo in ("rescue", "robotarium", "sensor-field"):
        out = tmp_path / demo
        result = pancakes("demo", demo, "--virtual", "--duration", "2", "--out", str(out))
        assert "verdict: " in result.stdout, result.stderr
        assert (out / "summary.json").is_file()


def test_wheels_bring_sound_configurations(pancakes: Pancakes, installed: Path) -> None:
    folders = [str(path) for path in installed.glob("*/configs/*")]
    assert {Path(folder).name for folder in folders} == {*DEMOS, LIVE_ONLY}

    result = pancakes("config", "check", *folders)

    assert result.returncode == 0, result.stderr
