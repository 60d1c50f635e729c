"""A log file of bounded size, on a real disk and after a real SIGKILL."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pancakes.services.log_file import RotatedFile

LINE = "x" * 99


@pytest.fixture
def path(tmp_path):
    return tmp_path / "logs" / "a.jsonl"


def kept(path: Path) -> list[str]:
    """Returns the names of all files, the one that is written first."""
    return sorted(found.name for found in path.parent.iterdir())


def lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def test_it_never_takes_more_than_its_files_times_their_size(path):
    file = RotatedFile(str(path), 1000, 3)
    for number in range(200):
        file.write(f"{number:03} {LINE}")
    file.close()
    assert kept(path) == ["a.jsonl", "a.jsonl.1", "a.jsonl.2"]
    assert all(found.stat().st_size <= 1000 for found in path.parent.iterdir())
    newest = [int(line[:3]) for name in ("a.jsonl.2", "a.jsonl.1", "a.jsonl") for line in lines(path.parent / name)]
    assert newest == list(range(newest[0], 200))
    assert len(newest) > 18


def test_a_file_that_was_moved_or_removed_meanwhile_is_begun_again_and_told(path):
    moved = []
    file = RotatedFile(str(path), 1000, 3, moved=lambda: moved.append(path.exists()))
    file.write("before")
    path.rename(path.with_name("elsewhere"))
    file.write("after")
    assert (lines(path.with_name("elsewhere")), lines(path), moved) == (["before"], ["after"], [False])
    path.unlink()
    file.write("again")
    path.rename(path.with_name("a"))
    path.write_text("of another program\n")
    file.write("beside it")
    assert (lines(path), len(moved)) == (["of another program", "beside it"], 3)
    for number in range(50):
        file.write(f"{number:03} {LINE}")
    file.close()
    assert len(moved) == 3, "what it puts aside itself is no news"


def test_the_folders_above_it_are_made(path):
    deep = path.parent / "of" / "today" / "a.jsonl"
    file = RotatedFile(str(deep), 1000, 2)
    file.write(LINE)
    file.close()
    assert lines(deep) == [LINE]


def test_it_is_appended_to_and_goes_on_counting(path):
    for number in range(30):
        file = RotatedFile(str(path), 1000, 2)
        file.write(f"{number:03} {LINE}")
        file.close()
    assert kept(path) == ["a.jsonl", "a.jsonl.1"]
    assert lines(path)[-1].startswith("029 ")
    assert all(found.stat().st_size <= 1000 for found in path.parent.iterdir())


def test_a_line_that_is_larger_than_a_file_is_whole(path):
    file = RotatedFile(str(path), 50, 3)
    file.write(f"0 {LINE}")
    assert kept(path) == ["a.jsonl"], "no empty file is put aside for it"
    for number in (1, 2, 3):
        file.write(f"{number} {LINE}")
    file.close()
    assert [lines(path.parent / name) for name in kept(path)] == [[f"3 {LINE}"], [f"2 {LINE}"], [f"1 {LINE}"]]


def test_what_no_encoding_knows_is_written_all_the_same(path):
    file = RotatedFile(str(path), 1000, 2)
    file.write("half a \ud83d smile")
    file.close()
    assert lines(path) == ["half a \\ud83d smile"]


def test_a_line_that_a_crash_has_torn_does_not_spoil_the_next(path):
    path.parent.mkdir()
    path.write_text('{"text": "who")}\n{"text": "tor')
    file = RotatedFile(str(path), 1000, 2)
    file.write('{"text": "whole"}')
    file.close()
    assert lines(path)[1:] == ['{"text": "tor', '{"text": "whole"}']


def test_a_disk_that_is_full_is_an_error_and_the_next_line_may_be_written(path):
    full = RotatedFile("/dev/full", 1000, 2)
    for _ in range(2):
        with pytest.raises(OSError, match="No space left"):
            full.write(LINE)
    full.close()


def test_a_pipe_is_no_log_file_and_keeps_nobody_waiting(path):
    path.parent.mkdir()
    os.mkfifo(path)  # opening it would wait for a reader
    file = RotatedFile(str(path), 1000, 2)
    with pytest.raises(OSError, match="it is a pipe, not a file"):
        file.write("lost")
    path.unlink()
    file.write("kept")
    file.close()
    assert lines(path) == ["kept"]


def test_a_place_that_comes_to_be_is_written(path):
    path.parent.write_text("not a directory")
    file = RotatedFile(str(path), 1000, 2)
    with pytest.raises(OSError, match=r"exists|directory"):
        file.write("lost")
    path.parent.unlink()
    file.write("kept")
    file.close()
    assert lines(path) == ["kept"]


WRITES = """
import sys
from pancakes.services.log_file import RotatedFile

file = RotatedFile(sys.argv[1], 2000, 4)
for number in range(int(sys.argv[2]), 10**9):
    file.write('{"number": %d}' % number)
    if number % 500 == 499:
        print(number, flush=True)
"""


def test_what_was_written_survives_a_sigkill_and_the_next_process_goes_on(path):
    first = 0
    for _ in range(3):
        writer = subprocess.Popen([sys.executable, "-c", WRITES, str(path), str(first)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        told = int(writer.stdout.readline())
        writer.kill()
        writer.communicate()
        names = [name for name in ("a.jsonl.3", "a.jsonl.2", "a.jsonl.1", "a.jsonl") if (path.parent / name).exists()]
        numbers = [json.loads(line)["number"] for name in names for line in lines(path.parent / name)]
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        assert numbers[-1] >= told
        first = numbers[-1] + 1
