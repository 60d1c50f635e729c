"""Errors become sentences and exit codes, in one place."""

import errno
import os
import subprocess
import sys

import pytest

from pancakes.cli.errors import sentences
from pancakes.errors import ConfigError, ControlRefused, Fault, PancakesError, Unreachable


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ControlRefused("a is busy"), 1, "a is busy\n"),
        (PancakesError("the port is in use"), 1, "the port is in use\n"),
        (Unreachable("nobody is there"), 3, "nobody is there\n"),
        (
            ConfigError([Fault("a.toml:3", "x", "bad"), Fault("a.toml:4", "y", "worse")]),
            4,
            "a.toml:3: x: bad\na.toml:4: y: worse\n",
        ),
    ],
)
def test_an_error_that_was_meant(error: PancakesError, code: int, said: str, capsys: pytest.CaptureFixture[str]):
    @sentences
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as ended:
        command()
    assert ended.value.code == code
    assert capsys.readouterr().err == said


def test_a_defect_is_a_sentence_too(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    @sentences
    def command() -> None:
        raise KeyError("wheel")

    monkeypatch.delenv("PANCAKES_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as ended:
        command()
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("a defect in Pancakes or in a plug-in: KeyError: 'wheel'")
    assert "Traceback" not in said

    monkeypatch.setenv("PANCAKES_TRACEBACK", "1")
    with pytest.raises(KeyError):
        command()


def test_a_full_disk_is_no_defect(capsys: pytest.CaptureFixture[str]):
    @sentences
    def command() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "runs/summary.json")

    with pytest.raises(SystemExit) as ended:
        command()
    assert ended.value.code == 1
    assert capsys.readouterr().err == "cannot write runs/summary.json: No space left on device\n"


def test_an_extra_that_is_not_installed_is_named(capsys: pytest.CaptureFixture[str]):
    @sentences
    def command() -> None:
        raise ModuleNotFoundError("No module named 'mcap.reader'", name="mcap.reader")

    with pytest.raises(SystemExit) as ended:
        command()
    assert ended.value.code == 1
    assert capsys.readouterr().err == "this needs mcap: pip install 'pancakes-agents[record]'\n"


@pytest.mark.parametrize("format_", ["table", "json"])
def test_who_reads_no_more_ends_a_verb_without_a_word(format_: str):
    reader, writer = os.pipe()
    os.close(reader)

    verb = [sys.executable, "-m", "pancakes.cli.main", "plugin", "list", "--format", format_]
    ended = subprocess.run(verb, stdout=writer, stderr=subprocess.PIPE, check=False)

    os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, b"")
