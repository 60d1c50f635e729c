"""The runtime directory: what agents write there, and what is believed of it."""

import os
from pathlib import Path

import pytest

from pancakes.errors import PancakesError
from pancakes.runtime_dir import Entry, entries, register, runtime_dir

ENTRY = Entry("a", "default", "agent", "tcp://127.0.0.1:7401", 42)


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path / "runtime"
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(directory))
    return directory


def test_an_entry_stands_until_it_is_removed(directory: Path):
    registration = register(ENTRY)
    assert entries() == [ENTRY]

    registration.remove()
    registration.remove()
    assert entries() == []
    assert list(directory.iterdir()) == []


def test_two_agents_of_one_name_have_an_entry_each(directory: Path):
    other = Entry("a", "other", "agent", "", 43)
    registrations = [register(other), register(ENTRY)]

    assert entries() == [ENTRY, other]
    for registration in registrations:
        registration.remove()


def test_the_entry_of_a_dead_agent_is_cleared_away(directory: Path):
    # Even where its number belongs to a living process today: only the lock says who lives.
    register(ENTRY).remove()
    (directory / f"b.{os.getpid()}.json").write_text('{"name": "b"}')
    (directory / "c.7.json.tmp").write_text("{")

    assert entries() == []
    assert list(directory.iterdir()) == []


def test_other_files_are_left_alone(directory: Path):
    register(ENTRY).remove()
    (directory / "notes.txt").write_text("mine")

    assert entries() == []
    assert (directory / "notes.txt").exists()


def test_it_is_for_the_user_alone(directory: Path):
    register(ENTRY).remove()
    assert directory.stat().st_mode & 0o777 == 0o700

    directory.chmod(0o755)
    with pytest.raises(PancakesError, match=r"is open to other users \(mode 755, not 700\)"):
        register(ENTRY)
    with pytest.raises(PancakesError, match="is open to other users"):
        entries()


def test_the_directory_of_somebody_else_is_refused(directory: Path, monkeypatch: pytest.MonkeyPatch):
    register(ENTRY).remove()
    monkeypatch.setattr(os, "getuid", lambda: directory.stat().st_uid + 1)

    with pytest.raises(PancakesError, match="belongs to another user"):
        entries()


def test_a_link_in_its_place_is_refused(directory: Path, tmp_path: Path):
    target = tmp_path / "elsewhere"
    target.mkdir(mode=0o700)
    directory.symlink_to(target)

    with pytest.raises(PancakesError, match="is no directory"):
        register(ENTRY)


def test_where_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("PANCAKES_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime_dir() == tmp_path / "pancakes"

    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert runtime_dir() == Path(f"/tmp/pancakes-{os.getuid()}")
