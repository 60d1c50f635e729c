"""The runtime directory: what agents write there, and which entries are trusted."""

import fcntl
import json
import os
import shutil
import socket
import stat
import time
from pathlib import Path

import pytest
from cli.processes import PATIENCE_S, Rig

from pancakes.errors import PancakesError
from pancakes.util.runtime_dir import Registration, RunningAgent, entries, is_locked, runtime_dir

ENTRY = RunningAgent("a", "default", "agent", ("tcp://127.0.0.1:7401",), 42)


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path / "runtime"
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(directory))
    return directory


def test_runtime_dir_entry_exists_until_removed(directory: Path):
    registration = Registration(ENTRY)
    assert entries() == [ENTRY]

    registration.remove()
    registration.remove()
    assert entries() == []
    assert list(directory.iterdir()) == []


def test_runtime_dir_entry_is_rewritten_in_a_new_directory(directory: Path):
    registration = Registration(ENTRY)
    assert not registration.renew()
    session = directory.rename(directory.with_name("ended"))
    directory.touch()
    assert not registration.renew(), "the directory cannot be made now"
    directory.unlink()
    assert registration.renew()
    assert entries() == [ENTRY]
    assert not registration.renew()

    registration.remove()
    assert entries() == []
    assert not registration.renew()
    with open(next(session.iterdir()), "rb") as before:
        assert not is_locked(before), "nothing of the entry before is kept open"


def test_runtime_dir_has_an_entry_per_process(directory: Path):
    other = RunningAgent("a", "other", "agent", (), 43)
    registrations = [Registration(other), Registration(ENTRY)]

    assert entries() == [ENTRY, other]
    for registration in registrations:
        registration.remove()


def test_runtime_dir_is_cleared_of_dead_agents_only(directory: Path):
    # Even where its number belongs to a living process today: only the lock says who lives.
    Registration(ENTRY).remove()
    (directory / f"b.{os.getpid()}.json").write_text('{"name": "b"}')
    (directory / "c.7.json.tmp").write_text("{")
    os.utime(directory / "c.7.json.tmp", (0.0, 0.0))
    (directory / "notes.txt").write_text("mine")

    assert entries() == []
    assert list(directory.iterdir()) == [directory / "notes.txt"]


def test_unfinished_entry_is_kept(directory: Path, monkeypatch: pytest.MonkeyPatch):
    lock = fcntl.flock

    def looked_at_first(handle: int, operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        assert entries() == []
        lock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", looked_at_first)
    Registration(ENTRY)
    assert entries() == [ENTRY]


def test_runtime_dir_is_for_its_user_only(directory: Path):
    Registration(ENTRY).remove()
    assert directory.stat().st_mode & 0o777 == 0o700

    directory.chmod(0o755)
    with pytest.raises(PancakesError, match=r"is open to other users \(mode 755, not 700, or 750 for one group\)"):
        Registration(ENTRY)
    with pytest.raises(PancakesError, match="is open to other users"):
        entries()


def test_runtime_dir_of_another_user_is_refused_unless_named(directory: Path, monkeypatch: pytest.MonkeyPatch):
    Registration(ENTRY)
    stranger = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: stranger)
    assert entries() == [ENTRY], "the agents of a system service, for a person who was told where they are"

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(directory.parent))
    monkeypatch.delenv("PANCAKES_RUNTIME_DIR")
    directory.rename(directory.with_name("pancakes"))
    with pytest.raises(PancakesError, match="belongs to another user"):
        entries()


def test_runtime_dir_must_not_be_a_link(directory: Path, tmp_path: Path):
    target = tmp_path / "elsewhere"
    target.mkdir(mode=0o700)
    directory.symlink_to(target)

    with pytest.raises(PancakesError, match="is not a directory"):
        Registration(ENTRY)


def test_runtime_dir_default_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("PANCAKES_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime_dir() == tmp_path / "pancakes"

    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert runtime_dir() == Path(f"/tmp/pancakes-{os.getuid()}")


# Foreign content -----------------------------------------------------------------------------------------------


def a_directory(path: Path) -> None:
    path.mkdir()


def a_named_pipe(path: Path) -> None:
    os.mkfifo(path)


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        # The path of a socket must be short.
        here = os.getcwd()
        os.chdir(path.parent)
        try:
            made.bind(path.name)
        finally:
            os.chdir(here)


def a_symbolic_link_to_nothing(path: Path) -> None:
    path.symlink_to("nowhere")


def a_link_to_a_device_without_end(path: Path) -> None:
    path.symlink_to("/dev/zero")


def a_huge_file(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


def broken_json(path: Path) -> None:
    path.write_text('{"name": "a", ')


def no_text(path: Path) -> None:
    path.write_bytes(b"\xff\xfe\x00")


def an_unreadable_file(path: Path) -> None:
    path.write_text("[]")
    path.chmod(0)


def a_file_in_use_that_says_something_else(path: Path) -> None:
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)  # until the end of the tests
    os.write(handle, b'{"name": 1}')
    fcntl.flock(handle, fcntl.LOCK_EX)


def a_file_in_use_that_is_nested_deep(path: Path) -> None:
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    os.write(handle, b'{"x": ' + b"[" * 60_000)
    fcntl.flock(handle, fcntl.LOCK_EX)


ODD = [
    a_directory,
    a_named_pipe,
    a_socket,
    a_symbolic_link_to_nothing,
    a_link_to_a_device_without_end,
    a_huge_file,
    broken_json,
    no_text,
    an_unreadable_file,
    a_file_in_use_that_says_something_else,
    a_file_in_use_that_is_nested_deep,
]


def test_runtime_dir_ignores_foreign_content(directory: Path, capfd):
    registration = Registration(ENTRY)
    for make in ODD:
        odd = directory / f"{make.__name__}.json"
        make(odd)
        assert entries() == [ENTRY]
        (warning,) = capfd.readouterr().err.splitlines()
        assert warning.startswith(f"warning: {odd} ") and warning.endswith("; ignored")
        assert os.path.lexists(odd)
        assert entries() == [ENTRY]
        assert capfd.readouterr().err == "", "it is said once"

    a_named_pipe(directory / "b.7.json")
    a_directory(directory / "b.8.json.tmp")
    (directory / "\x1b]0;owned\x07.json").mkdir()
    assert entries() == [ENTRY]
    said = capfd.readouterr().err
    assert "b.7.json is a named pipe" in said and "b.8.json.tmp is a directory" in said
    assert "\\x1b]0;owned\\x07.json" in said and said.replace("\n", "").isprintable()
    registration.remove()


def test_runtime_dir_ignores_a_file_of_another_user(directory: Path, monkeypatch: pytest.MonkeyPatch, capfd):
    registration = Registration(ENTRY)
    (directory / "b.7.json").write_text("{}")
    mine, lstat = os.getuid(), os.lstat

    def of_another(path, *args, **others):
        status = list(lstat(path, *args, **others))
        status[stat.ST_UID] = mine + 1 if str(path).endswith("b.7.json") else mine
        return os.stat_result(status)

    monkeypatch.setattr(os, "lstat", of_another)  # only root can give a file away
    assert entries() == [ENTRY]
    assert f"b.7.json is a file of another user (uid {mine + 1})" in capfd.readouterr().err
    assert (directory / "b.7.json").exists()
    registration.remove()


def test_runtime_dir_entry_that_becomes_a_link_is_not_followed(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
):
    Registration(ENTRY).remove()
    entry, elsewhere, lstat = directory / "b.7.json", tmp_path / "elsewhere", os.lstat
    entry.write_text("{}")
    elsewhere.write_text("{}")

    def then_a_link(path):
        status = lstat(path)
        if path == entry and stat.S_ISREG(status.st_mode):
            entry.unlink()
            entry.symlink_to(elsewhere)
        return status

    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(os, "lstat", then_a_link)
        assert entries() == []
    assert "b.7.json cannot be read: too many levels of symbolic links" in capfd.readouterr().err
    assert entry.is_symlink(), "it is left as it is"


def test_runtime_dir_reports_odd_entries(directory: Path):
    Registration(ENTRY).remove()
    (directory / "a.42.json").mkdir()

    with pytest.raises(PancakesError, match=r"cannot be used: .*a\.42\.json\S*: is a directory"):
        Registration(ENTRY)
    assert entries() == []


def test_odd_entries_do_not_stop_commands(rig: Rig):
    rig.ready("a")
    a_directory(rig.runtime / "x.json")
    a_named_pipe(rig.runtime / "y.json")
    a_huge_file(rig.runtime / "z.json")

    listed = rig.pancakes("agent", "list", "--format", "json")
    assert (listed.returncode, [row["agent"] for row in json.loads(listed.stdout)]) == (0, ["a"])
    assert [line.split()[1].rpartition("/")[2] for line in listed.stderr.splitlines()] == ["x.json", "y.json", "z.json"]

    looked = rig.pancakes("doctor", "--format", "json")
    about = [row["text"] for row in json.loads(looked.stdout) if row["about"] == "runtime directory"]
    assert [text.rpartition("/")[2] for text in about] == [
        "x.json is a directory, no agent's entry",
        "y.json is a named pipe, no agent's entry",
        f"z.json is a file of {1 << 40} bytes, no agent's entry",
    ]
    assert looked.returncode == 0

    ended = rig.pancakes("down", "a")
    assert ended.returncode == 0


def test_removed_runtime_dir_is_made_again(rig: Rig):
    agent = rig.ready("a")
    shutil.rmtree(rig.runtime)
    agent.hear("`pancakes` finds a again: its entry in the runtime directory was gone")
    until_s = time.monotonic() + PATIENCE_S
    while not (found := list(rig.runtime.glob("local/**/a.sock"))):
        assert time.monotonic() < until_s, "the agent listens nowhere on this machine any more"
    done = rig.pancakes("agent", "info", "a", "--at", f"local://{found[0]}")
    assert done.returncode == 0, done.stderr
    assert [row["agent"] for row in rig.listed("agent", "list")] == ["a"]
