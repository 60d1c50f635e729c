"""A journal on a disk that is small, or full: a file system of its own, in a name space that the test makes."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ENTER = ("unshare", "--map-root-user", "--mount")
HEAD = """
import os, sys
from pathlib import Path
from pancakes.journal import FileJournal, JournalEntry, JournalError

disk = Path(sys.argv[1])
state = disk / "state"

def entry(key, size, byte=b"x"):
    return JournalEntry("task", key, byte * size)

def fill():
    with open(disk / "filler", "wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass
"""


@pytest.fixture
def small_disk(tmp_path: Path):
    """Run a program that has a disk of 6 MiB; it gets its path."""
    if shutil.which("unshare") is None or subprocess.run([*ENTER, "true"], capture_output=True).returncode:
        pytest.skip("this machine lets no user make a name space with a file system of its own")

    def run(program: str) -> str:
        (tmp_path / "program.py").write_text(HEAD + program)
        disk = tmp_path / "disk"
        disk.mkdir()
        mounted = f'mount -t tmpfs -o size=6m none "{disk}" && exec "{sys.executable}" "{tmp_path}/program.py" "{disk}"'
        ended = subprocess.run([*ENTER, "sh", "-c", mounted], capture_output=True, text=True)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    return run


def test_journal_is_bounded_by_the_room_of_its_disk(small_disk):
    """60 MB go through a disk of 6: one task's checkpoints and an account now and then."""
    said = small_disk("""
journal = FileJournal(state)
for number in range(3000):
    journal.write([entry("a/Count", 20_000, b"%d" % (number % 10))])
    if number % 500 == 0:
        journal.write([entry(f"account{number}", 100)])
again = FileJournal.__new__(FileJournal)  # the first one is left as a kill leaves it
os.close(journal._lock)
again.__init__(state)
print(again.read("task", "a/Count").data[:1], len(again.entries("task")), again.boot)
""")
    assert said == "b'9' 7 2\n"


def test_journal_opens_on_a_full_disk_and_goes_on_when_there_is_room(small_disk):
    said = small_disk("""
if not os.fork():
    journal = FileJournal(state)
    for number in range(200):
        journal.write([entry("a/Count", 5_000, b"%d" % (number % 10)), entry("a/Other", 10)])
    fill()
    os._exit(0)  # killed
os.wait()
for boot in (2, 3, 4):
    if not os.fork():
        journal = FileJournal(state)
        print(journal.boot, journal.read("task", "a/Count").data[:1], journal.set_aside)
        fill()
        try:
            for number in range(100):
                journal.write([entry("a/Count", 5_000, b"n")])
        except JournalError as error:
            print(error)
        if boot == 4:
            (disk / "filler").unlink()
            journal.write([entry("a/Count", 5_000, b"n")])
        sys.stdout.flush()
        os._exit(0)
    os.wait()
print(FileJournal(state).read("task", "a/Count").data[:1])
""").splitlines()
    disk = said[1].partition("(")[2].partition(")")[0]
    full = f"the journal cannot write: No space left on device ({disk})"
    assert said == ["2 b'9' ()", full, "3 b'9' ()", full, "4 b'9' ()", full, "b'n'"]


def test_journal_is_not_made_on_a_full_disk(small_disk):
    said = small_disk("""
fill()
try:
    FileJournal(state)
except JournalError as error:
    print(error)
""")
    assert "cannot be used: No space left on device; make room on its disk" in said
