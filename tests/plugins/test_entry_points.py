"""Entry points are found in all places in which Python finds distributions."""

import zipfile
from pathlib import Path

import pytest

from pancakes.util.plugins import Plugins

METADATA = "Metadata-Version: 2.1\nName: far-tasks\nVersion: 3.1\nSummary: a: b\n\nName: not-this\n"


def test_one_that_was_installed_by_an_old_setuptools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    info = tmp_path / "far_tasks.egg-info"
    info.mkdir()
    (info / "PKG-INFO").write_text(METADATA)
    (info / "entry_points.txt").write_text("[pancakes.tasks]\nfar.Path = pathlib:Path\n")
    monkeypatch.syspath_prepend(tmp_path)

    assert Plugins().version("pancakes.tasks", "far.Path") == ("far-tasks", "3.1")


def test_one_in_a_zip_archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    archive = tmp_path / "all.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("far_tasks-3.1.dist-info/METADATA", METADATA)
        file.writestr("far_tasks-3.1.dist-info/entry_points.txt", "[pancakes.tasks]\nfar.Far = far_module:Far\n")
        file.writestr("far_module.py", "class Far: pass\n")
    monkeypatch.syspath_prepend(archive)
    plugins = Plugins()

    assert plugins.version("pancakes.tasks", "far.Far") == ("far-tasks", "3.1")
    assert plugins.get("pancakes.tasks", "far.Far").__name__ == "Far"
    assert "tcp" in plugins.names("pancakes.transports"), "and those in directories as well"


def test_one_without_a_name_is_reported_and_harms_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    info = tmp_path / "torn-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Version: 1\n\nName: torn\n")
    (info / "entry_points.txt").write_text("[pancakes.tasks]\ntorn.Path = pathlib:Path\n")
    monkeypatch.syspath_prepend(tmp_path)

    (problem,) = Plugins().unreadable()

    assert str(problem).startswith(f"the entry points of a distribution in {tmp_path} cannot be read: ValueError")
    assert "its metadata has no Name" in str(problem)
