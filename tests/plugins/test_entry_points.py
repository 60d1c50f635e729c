"""Entry points are found wherever `importlib.metadata` finds them, and mean the same."""

import importlib.metadata
import zipfile
from pathlib import Path

import pytest

from pancakes.entry_points import distributions, header, load, points
from pancakes.plugins import GROUPS, Plugins

METADATA = "Metadata-Version: 2.1\nName: far-tasks\nVersion: 3.1\nSummary: a: b\n\nName: not-this\n"


def test_all_that_importlib_finds_is_found():
    theirs = {
        (point.group, point.name, point.value)
        for group in GROUPS
        for point in importlib.metadata.entry_points(group=group)
    }

    plugins = Plugins()
    ours = {(group, it.name, it.place) for group in GROUPS for it in plugins.offered(group)}

    assert ours == theirs
    assert ours


def test_names_and_versions_are_those_of_importlib():
    ours = {header(read, "Name"): header(read, "Version") for _, read in distributions()}

    assert ours == {it.metadata["Name"]: it.version for it in importlib.metadata.distributions()}


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

    assert str(problem).endswith("torn-1.dist-info cannot be read: ValueError: its metadata has no Name")


def test_comments_spaces_and_extras_are_allowed():
    text = "# by hand\n\n[ pancakes.tasks ]\n a.B = a.b : B.C [fast]\n[other]\nx=y\n"

    assert list(points(text)) == [("pancakes.tasks", "a.B", "a.b : B.C [fast]"), ("other", "x", "y")]
    assert load("pathlib : Path.home [fast]") == Path.home
    assert load("pathlib").__name__ == "pathlib"
