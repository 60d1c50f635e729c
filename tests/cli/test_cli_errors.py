"""Errors become sentences and exit codes, in one place."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pancakes.errors import ConfigError, ControlRefusedError, Fault, PancakesError, UnreachableError
from pancakes.tools.cli.exit_codes import sentences


def ended_with(error: BaseException, capsys: pytest.CaptureFixture[str]) -> tuple[object, str]:
    """Return the exit code and the output of a command that raises an error."""

    @sentences()
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as ended:
        command()
    return ended.value.code, capsys.readouterr().err


def test_error_is_a_sentence_and_an_exit_code(capsys: pytest.CaptureFixture[str]):
    faults = ConfigError([Fault("a.toml:3", "x", "bad"), Fault("a.toml:4", "y", "worse")])
    for error, code, said in (
        (ControlRefusedError("a is busy"), 1, "a is busy\n"),
        (PancakesError("the port is in use"), 1, "the port is in use\n"),
        (UnreachableError("nobody is there"), 3, "nobody is there\n"),
        (faults, 4, "a.toml:3: x: bad\na.toml:4: y: worse\n"),
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "runs/summary.json"),
            1,
            "cannot write runs/summary.json: No space left on device\n",
        ),
        (
            ModuleNotFoundError("No module named 'mcap.reader'", name="mcap.reader"),
            1,
            "this needs mcap: pip install 'pancakes-agents[record]'\n",
        ),
    ):
        assert ended_with(error, capsys) == (code, said)


def test_defect_is_a_sentence_unless_a_traceback_is_requested(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("PANCAKES_TRACEBACK", raising=False)
    code, said = ended_with(KeyError("wheel"), capsys)
    assert code == 1 and said.startswith("a defect in Pancakes or in a plug-in: KeyError: 'wheel'")
    assert "Traceback" not in said

    monkeypatch.setenv("PANCAKES_TRACEBACK", "1")
    with pytest.raises(KeyError):
        ended_with(KeyError("wheel"), capsys)


def verb_into(output: int, *verb: str) -> tuple[int, bytes]:
    """Run a verb with its output to a file; return its exit code and its standard error."""
    # Buffered, as in a terminal: otherwise no output is left to be written at the end of the process.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    ended = subprocess.run(
        [sys.executable, "-m", *verb], stdout=output, stderr=subprocess.PIPE, env=environment, check=False
    )
    return ended.returncode, ended.stderr


@pytest.fixture
def checked(tmp_path: Path) -> tuple[str, ...]:
    config = tmp_path / "a.toml"
    config.write_text('schema = 1\n[agent]\nname = "a"\n')
    return "pancakes.tools.cli.agent_command", "--config", str(config), "--check"


LIST = ("pancakes.tools.cli.main", "plugin", "list")
HELP = ("pancakes.tools.cli.main", "--help")


def test_verb_without_a_reader_exits_with_141(checked: tuple[str, ...]):
    reader, writer = os.pipe()
    os.close(reader)
    try:
        for verb in (LIST, (*LIST, "--format", "json"), checked, HELP):
            assert verb_into(writer, *verb) == (141, b""), verb
    finally:
        os.close(writer)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no device that is always full")
def test_full_disk_ends_a_verb_with_a_sentence(checked: tuple[str, ...]):
    with open("/dev/full", "wb") as full:
        for verb in (LIST, (*LIST, "--format", "json"), checked, HELP):
            said = b"cannot write the output: No space left on device\n"
            assert verb_into(full.fileno(), *verb) == (1, said), verb


def test_file_name_that_is_not_utf8_can_be_checked(checked: tuple[str, ...]):
    odd = checked[2].encode() + b"\xff"
    os.rename(checked[2], odd)
    ended = subprocess.run(
        [sys.executable, "-m", *checked[:2], odd, checked[3]],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert b"is sound" in ended.stdout
