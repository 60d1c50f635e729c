"""A program that the tests' fork server starts is as one that a new Python starts."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from harness.programs import AGENT, Program, close_server, pancakes, run

PATIENCE_S = 30.0
CONFIG = f'schema = 1\n[agent]\nname = "a"\nfleet = "programs-{os.getpid()}"\nstate_dir = ""\n'
"""Two workers of a test run have no agents of one name in one fleet: the second would find its place taken."""
both = pytest.mark.parametrize("true_start", [False, True], ids=["forked", "true start"])


def agent(folder: Path, true_start: bool, text: str = CONFIG, **options: object) -> tuple[Program, int]:
    """Starts an agent; returns it, and the end of a pipe from which one can read when it is ready."""
    (folder / "a.toml").write_text(text)
    ready, tell_ready = os.pipe()
    environment = {**os.environ, "PANCAKES_RUNTIME_DIR": str(folder / "runtime")}
    process = Program(
        [sys.executable, "-m", AGENT, "--config", "a.toml", f"--ready-fd={tell_ready}"],
        true_start=true_start,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=folder,
        env=environment,
        pass_fds=(tell_ready,),
        **options,
    )
    os.close(tell_ready)
    return process, ready


def end(process: Program, ready: int) -> str:
    """Kills a process; returns all that it said."""
    process.kill()
    said, _ = process.communicate(timeout=PATIENCE_S)
    os.close(ready)
    return said


@both
def test_program_is_a_child_with_its_folder_environment_and_command(tmp_path: Path, true_start: bool) -> None:
    process, ready = agent(tmp_path, true_start)
    try:
        assert os.read(ready, 64).startswith(b"ready")
        found = psutil.Process(process.pid)
        assert found.ppid() == os.getpid() and found.cwd() == str(tmp_path)
        assert found.cmdline()[:4] == [sys.executable, "-m", AGENT, "--config"]
        until_s = time.monotonic() + PATIENCE_S
        while not list((tmp_path / "runtime").glob(f"*.{process.pid}.json")):  # it comes shortly after "ready"
            assert time.monotonic() < until_s, "it does not use the runtime directory of its environment"
    finally:
        end(process, ready)


@both
def test_program_shares_the_session_unless_it_is_given_its_own(tmp_path: Path, true_start: bool) -> None:
    process, ready = agent(tmp_path, true_start, process_group=0)
    assert os.read(ready, 64) and os.getpgid(process.pid) == process.pid and os.getsid(process.pid) == os.getsid(0)
    end(process, ready)
    process, ready = agent(tmp_path, true_start, start_new_session=True)
    assert os.read(ready, 64) and os.getsid(process.pid) == process.pid
    end(process, ready)


@both
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 0), (signal.SIGKILL, -9)])
def test_program_ends_by_a_signal_with_its_code(tmp_path: Path, true_start: bool, number: int, code: int) -> None:
    process, ready = agent(tmp_path, true_start)
    assert os.read(ready, 64) and process.poll() is None
    process.send_signal(number)
    assert process.wait(PATIENCE_S) == code
    assert "Traceback" not in end(process, ready)


@both
def test_program_that_cannot_run_has_its_exit_code_and_words(tmp_path: Path, true_start: bool) -> None:
    process, ready = agent(tmp_path, true_start, "schema = 1\n[agent]\nnam = 1\n")
    assert process.wait(PATIENCE_S) == 4 and "a.toml" in end(process, ready)
    unknown = run(pancakes("no-such-verb"), timeout_s=PATIENCE_S, true_start=true_start)
    assert (unknown.returncode, unknown.stdout) == (2, "") and "no-such-verb" in unknown.stderr


@both
def test_program_reads_its_standard_input(tmp_path: Path, true_start: bool) -> None:
    command = pancakes("param", "load", "nobody/Task", "-", "--timeout", "0.1")
    empty = {**os.environ, "PANCAKES_RUNTIME_DIR": str(tmp_path)}
    done = run(command, timeout_s=PATIENCE_S, true_start=true_start, given="= no TOML", env=empty)
    assert done.returncode == 4 and "standard input" in done.stderr


@both
def test_program_knows_that_it_runs_on_a_terminal(true_start: bool) -> None:
    ours, theirs = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key != "NO_COLOR"} | {"TERM": "xterm"}
    with Program(
        pancakes("--version"), true_start=true_start, stdin=theirs, stdout=theirs, stderr=theirs, env=environment
    ) as process:
        assert process.wait(PATIENCE_S) == 0
    os.close(theirs)
    assert b"pancakes" in os.read(ours, 4096)
    os.close(ours)


def test_forked_program_refuses_another_start_of_python() -> None:
    with pytest.raises(AssertionError, match="PYTHONHASHSEED"):
        run(pancakes("--version"), timeout_s=PATIENCE_S, env={**os.environ, "PYTHONHASHSEED": "7"})


def test_forked_program_goes_on_without_its_server(tmp_path: Path) -> None:
    process, ready = agent(tmp_path, true_start=False)
    assert os.read(ready, 64)
    close_server()
    assert process.poll() is None
    process.terminate()
    assert process.wait(PATIENCE_S) == 0
    end(process, ready)
