"""Copies of what was kept of each version, and of what the present one would keep."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from kept.make import DATA, HERE, make

VERSIONS = sorted(it.name for it in DATA.iterdir())


class Kept:
    """What was kept of one version, copied to where a test may change it.

    Attributes:
        folder: the copy.
        expected: what was written down of it when it was kept.
        is_new: whether this version made it.
    """

    def __init__(self, source: Path, folder: Path) -> None:
        self.folder = shutil.copytree(source, folder)
        self.is_new = source.name == "now"
        # Of modes git remembers only whether a file can be run.
        for path in folder.rglob("*"):
            path.chmod(0o700 if path.is_dir() else 0o600)
        self.expected: dict[str, Any] = json.loads((folder / "expected.json").read_text())


@pytest.fixture(scope="session")
def made_now(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the present version would keep."""
    folder = tmp_path_factory.mktemp("kept") / "now"
    make(folder)
    return folder


@pytest.fixture(params=[*VERSIONS, "now"])
def kept(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Kept:
    """A copy of what was kept of each version; its tasks are installed, and relative paths lead to the copy."""
    source = request.getfixturevalue("made_now") if request.param == "now" else DATA / request.param
    found = Kept(source, tmp_path / "kept")
    monkeypatch.syspath_prepend(str(HERE / "installed"))
    monkeypatch.chdir(found.folder)
    return found
