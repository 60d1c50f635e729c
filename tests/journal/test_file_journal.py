"""What a journal in a directory does with the operating system."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pancakes.journal import FileJournal, JournalEntry, JournalError, JournalLostError

SCAN = JournalEntry("task", "agent1/ScanTarget", b"x")


def test_the_directory_is_for_its_owner_alone(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "robots" / "agent1")
    journal.write([SCAN])

    assert journal.directory.stat().st_mode & 0o777 == 0o700
    assert all(path.stat().st_mode & 0o077 == 0 for path in journal.directory.iterdir())


def test_each_new_journal_has_an_id_of_its_own(tmp_path: Path) -> None:
    assert FileJournal(tmp_path / "a").uuid != FileJournal(tmp_path / "b").uuid


def test_another_process_is_refused_with_a_sentence(tmp_path: Path) -> None:
    holder = FileJournal(tmp_path)
    code = (
        "import sys, pathlib\n"
        "from pancakes.journal import FileJournal, JournalError\n"
        "try: FileJournal(pathlib.Path(sys.argv[1]))\n"
        "except JournalError as error: print(error)\n"
    )

    said = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True).stdout

    assert said == f"the state directory {tmp_path} is in use by another agent (process {os.getpid()})\n"
    holder.close()


def test_a_process_that_was_killed_leaves_no_lock_and_no_half_entry(tmp_path: Path) -> None:
    # It dies between writing the temporary file and renaming it.
    code = (
        "import os, sys, pathlib, signal\n"
        "from pancakes.journal import JournalEntry, FileJournal\n"
        "journal = FileJournal(pathlib.Path(sys.argv[1]), 'first')\n"
        "journal.write([JournalEntry('task', 'agent1/ScanTarget', b'old')])\n"
        "os.replace = lambda *names, **directories: os.kill(os.getpid(), signal.SIGKILL)\n"
        "journal.close()\n"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path], check=False)
    assert [path.name for path in tmp_path.glob("*.tmp")] == ["task.agent1%2FScanTarget.rec.tmp"]

    journal = FileJournal(tmp_path)

    assert [entry.data for entry in journal.entries("task")] == [b"old"]
    assert list(tmp_path.glob("*.tmp")) == []
    assert journal.set_aside == ()


def test_the_order_of_system_calls_that_the_survival_of_an_entry_rests_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = FileJournal(tmp_path)
    calls: list[str] = []
    fsync, replace, unlink = os.fsync, os.replace, os.unlink

    def spy_fsync(handle: int) -> None:
        calls.append(f"fsync {Path(os.readlink(f'/proc/self/fd/{handle}')).name}")
        fsync(handle)

    def spy_replace(old: Path, new: Path, **directories: int) -> None:
        calls.append(f"rename {Path(new).name}")
        replace(old, new, **directories)

    def spy_unlink(name: Path, **directories: int) -> None:
        calls.append(f"remove {Path(name).name}")
        unlink(name, **directories)

    monkeypatch.setattr(os, "fsync", spy_fsync)
    monkeypatch.setattr(os, "replace", spy_replace)
    monkeypatch.setattr(os, "unlink", spy_unlink)
    journal.write([JournalEntry("task", "a", b""), JournalEntry("task", "b", b"")])
    # The file, and its name, before `write` returns.
    assert calls == ["fsync journal.wal", f"fsync {tmp_path.name}"]
    calls.clear()

    journal.close()

    # All files, then their names, then the directory; what was written ahead is needed up to then.
    assert calls == [
        "fsync task.a.rec.tmp",
        "fsync task.b.rec.tmp",
        "rename task.a.rec",
        "rename task.b.rec",
        f"fsync {tmp_path.name}",
        "remove journal.wal",
        f"fsync {tmp_path.name}",
    ]


def test_a_full_disk_is_an_error_that_names_the_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = FileJournal(tmp_path)
    journal.write([SCAN])

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(JournalError, match=f"cannot write: No space left on device .{tmp_path}.$"):
        journal.write([JournalEntry("task", SCAN.key, b"y")])

    assert journal.entries("task") == [SCAN]


def test_a_file_in_the_directory_s_place_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("")
    with pytest.raises(JournalError, match="cannot be used: File exists"):
        FileJournal(tmp_path / "state")


def test_files_of_others_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    FileJournal(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


# Whose the directory must be, and whether it is still there ---------------------------------------------------------


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o1777])
def test_a_directory_that_others_can_write_is_refused_with_what_to_do(tmp_path: Path, mode: int) -> None:
    tmp_path.chmod(mode)

    with pytest.raises(
        JournalError, match=rf"can be written by other users \(mode {mode:04o}\).*: chmod go-w {tmp_path}$"
    ):
        FileJournal(tmp_path)

    tmp_path.chmod(mode & ~0o022)
    FileJournal(tmp_path).close()


def test_a_directory_of_another_user_is_refused_with_what_to_do(tmp_path: Path) -> None:
    theirs = Path("/")
    if os.geteuid() == 0:
        theirs = tmp_path
        os.chown(theirs, 65534, 65534)

    with pytest.raises(
        JournalError, match=f"{theirs} belongs to the user .*: chown -R {os.geteuid()} {theirs}, or name"
    ):
        FileJournal(theirs)


def test_a_symbolic_link_is_followed_and_told(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    link.symlink_to(target)
    with pytest.raises(JournalError, match=f"{link} is a symbolic link to {target}: make it"):
        FileJournal(link)
    target.mkdir(mode=0o700)

    journal = FileJournal(link)

    assert journal.remarks == (f"the state directory {link} is a symbolic link: {target} is used",)
    journal.write([SCAN])
    journal.check()
    link.unlink()
    with pytest.raises(JournalLostError, match=f"{link} was removed or replaced"):
        journal.check()


def test_nothing_is_written_into_a_directory_that_has_taken_the_place_of_the_one_that_was_opened(
    tmp_path: Path,
) -> None:
    first = FileJournal(tmp_path / "state", "first")
    (tmp_path / "state").rename(tmp_path / "old")
    second = FileJournal(tmp_path / "state", "second")

    with pytest.raises(JournalLostError, match="was removed or replaced while the agent ran"):
        first.write([SCAN])

    assert not list((tmp_path / "state").glob("task.*"))
    second.write([SCAN])
    second.check()


def test_a_lock_that_was_removed_is_noticed(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path)
    (tmp_path / "lock").unlink()
    with pytest.raises(JournalLostError, match="was removed while the agent ran"):
        journal.check()


def test_a_link_that_leads_to_itself_is_a_sentence(tmp_path):
    link = tmp_path / "state"
    link.symlink_to(link)
    with pytest.raises(JournalError, match="is a symbolic link to"):
        FileJournal(link)


def test_a_directory_that_is_moved_is_the_original_and_a_copy_is_told(tmp_path: Path) -> None:
    FileJournal(tmp_path / "state").close()
    (tmp_path / "state").rename(tmp_path / "moved")
    moved = FileJournal(tmp_path / "moved")
    moved.close()
    assert (moved.copy, moved.remarks) == ("", ())

    shutil.copytree(tmp_path / "moved", tmp_path / "copy")
    copy = FileJournal(tmp_path / "copy")
    copy.close()
    (said,) = copy.remarks
    assert str(tmp_path / "copy") in said and "is a copy" in said
    again = FileJournal(tmp_path / "copy")
    again.close()
    assert (again.copy, again.remarks) == (copy.copy, ())
