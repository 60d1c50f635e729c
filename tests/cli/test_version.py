"""The output of `--version`: the version, and the commit if it is not a release."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from cli.processes import Rig

from pancakes import __version__
from pancakes.tools.cli.version import version_text


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return the folder of a package in a clone with one commit."""
    package = tmp_path / "pancakes"
    package.mkdir()
    (package / "task.py").touch()
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "one"]):
        git(tmp_path, *command)
    return package


def git(root: Path, *arguments: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    return subprocess.run(["git", "-C", str(root), *who, *arguments], check=True, capture_output=True, text=True).stdout


def test_version_of_a_clone_names_its_commit_and_changes(package: Path):
    commit = git(package, "rev-parse", "--short=12", "HEAD").strip()
    assert version_text(package) == f"{__version__}, not released: commit {commit}"
    (package / "task.py").write_text("x = 1\n")
    assert version_text(package) == f"{__version__}, not released: commit {commit} with changes"

    git(package, "checkout", "-q", "task.py")
    git(package, "tag", f"v{__version__}")
    assert version_text(package) == __version__, "a release is its version"


def test_version_of_a_wheel_names_its_commit(tmp_path: Path):
    assert version_text(tmp_path) == __version__
    (tmp_path / "commit.txt").write_text("0123456789ab\n")
    assert version_text(tmp_path) == f"{__version__}, not released: commit 0123456789ab"


def test_both_commands_have_version(rig: Rig):
    assert rig.pancakes("--version").stdout == f"pancakes, version {version_text()}\n"
    done = rig.run("-m", "pancakes.tools.cli.agent_command", "--version", whole=True)
    assert done.everything() == f"pancakes-agent, version {version_text()}" and done.ended() == 0
