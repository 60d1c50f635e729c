"""Files and folders that their modes keep from the user: each is refused in a sentence, and nothing falls over.

As root no mode would keep anything from anybody, so all of this runs as another user (`harness.other_user`).
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from harness.other_user import NOBODY, as_other_user, needs_root, reachable_folder, theirs, unreadable, unwritable
from keys_in_test import KeysInTest
from recording.files import pose, written

from pancakes.config import load
from pancakes.errors import ConfigError, PancakesError
from pancakes.journal import FileJournal, JournalError
from pancakes.recording.reader import RecordingReader
from pancakes.security.keys import Keys
from pancakes.testing import threaded_agent
from pancakes.tools.cli.agent_command import agent as pancakes_agent
from pancakes.tools.cli.main import pancakes
from pancakes.util.plugins import Plugins
from pancakes.util.runtime_dir import entries, runtime_dir

for name in (
    "logging.handlers",
    "pancakes.services.log_file",
    "pancakes.tools.cli.verbs.agent",
    "pancakes.tools.cli.verbs.record",
    "pancakes.tools.cli.verbs.replay",
    "pancakes.tools.cli.verbs.rerun",
    "pancakes.tools.cli.verbs.why",
    "pancakes.recording.recorder",
    "pancakes.recording.recording",
    "pancakes.recording.reader",
    "pancakes.tools.replay.replay",
    "pancakes.tools.replay.recorded_run",
    "pancakes.tools.report.command_latency",
):
    importlib.import_module(name)  # the other user may not be able to

CONFIG = 'schema = 1\n[agent]\nname = "a"\n'
QUIET = "[service.log]\nsettings = {{ console = false{} }}\n"


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that the other user can reach, and cannot write."""
    with reachable_folder() as path:
        yield path


def refusal(function: Callable[[], Any], kind: type[Exception] = PancakesError) -> str:
    """Returns the sentence with which something is refused to the other user."""

    def refused() -> str:
        with pytest.raises(kind) as caught:
            function()
        return str(caught.value)

    return as_other_user(refused)


def asked(command: Any, *arguments: str) -> tuple[int, str]:
    """Runs a command as the other user; returns its exit code and what it printed."""

    def run() -> tuple[int, str]:
        result = CliRunner().invoke(command, arguments)
        return result.exit_code, result.output

    return as_other_user(run)


@needs_root
def test_other_user_may_not_read_what_is_ours(place: Path):
    """Not a test of the product, but of what the others stand on."""
    path = place / "file"
    path.write_text("ours")
    unreadable(path)
    assert as_other_user(os.getuid) == NOBODY.pw_uid
    assert "Permission denied" in refusal(path.read_text, OSError)


# Configurations and keys -----------------------------------------------------------------------------------------


@pytest.fixture
def config(place: Path) -> Path:
    path = place / "a.toml"
    path.write_text(CONFIG)
    load(str(path), [], Plugins())
    return path


def test_unreadable_config_is_refused(config: Path):
    unreadable(config)
    assert str(config) in refusal(lambda: load(str(config), [], Plugins()), ConfigError)


def test_unreadable_config_ends_an_agent_with_its_code(config: Path):
    unreadable(config)
    code, said = asked(pancakes_agent, "--config", str(config), "--check")
    assert code == 4 and str(config) in said and "ermission denied" in said


@pytest.fixture
def keys(place: Path) -> Path:
    """The keys of an agent, which belong to the other user."""
    folder = KeysInTest(place / "keys").of_agent("default", "a")
    Keys(folder)  # imports what it needs
    for path in (place / "keys", *(place / "keys").rglob("*")):
        theirs(path, 0o700 if path.is_dir() else 0o600)
    assert as_other_user(lambda: Keys(folder).own.name) == "a"
    return folder


def test_key_that_others_can_read_is_refused(keys: Path):
    theirs(keys / "key.pem", 0o644)
    assert "can be read by others (mode 644)" in refusal(lambda: Keys(keys))


@needs_root
def test_key_of_another_user_is_refused(keys: Path):
    os.chown(keys / "key.pem", 0, 0)
    assert "belongs to another user (uid 0)" in refusal(lambda: Keys(keys))


@pytest.mark.parametrize("file", ["key.pem", "fleet.pem", "roster.json"])
def test_unreadable_key_file_is_refused(keys: Path, file: str):
    (keys / file).chmod(0)
    said = refusal(lambda: Keys(keys))
    assert str(keys / file) in said and "ermission denied" in said


def test_unreachable_folder_with_keys_is_refused(keys: Path):
    keys.chmod(0)
    assert "ermission denied" in refusal(lambda: Keys(keys))


# The state and the runtime directory -----------------------------------------------------------------------------


def test_state_directory_that_cannot_be_made_is_refused(place: Path):
    state = unwritable(place / "states") / "a"
    assert f"the state directory {state} cannot be used" in refusal(lambda: FileJournal(state), JournalError)


@needs_root
def test_state_directory_of_another_user_is_refused(place: Path):
    state = unwritable(place / "a")
    assert "belongs to the user root (0)" in refusal(lambda: FileJournal(state), JournalError)


def test_state_directory_without_the_right_to_write_is_refused(place: Path):
    state = place / "a"
    state.mkdir()
    theirs(state, 0o500)
    assert f"the state directory {state} cannot be used" in refusal(lambda: FileJournal(state), JournalError)


@pytest.mark.parametrize("file", ["identity.identity.rec", "lock", "mark"])
def test_state_directory_with_an_unreadable_file_is_refused(place: Path, file: str):
    state = place / "a"
    FileJournal(state).close()
    for path in (state, *state.iterdir()):
        theirs(path, 0o700 if path.is_dir() else 0o600)
    (state / file).chmod(0)
    assert f"the state directory {state} cannot be used" in refusal(lambda: FileJournal(state), JournalError)


@needs_root
def test_runtime_directory_of_another_user_is_refused(place: Path, monkeypatch: pytest.MonkeyPatch):
    directory = place / "pancakes"
    directory.mkdir(mode=0o700)
    monkeypatch.delenv("PANCAKES_RUNTIME_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place))
    assert as_other_user(runtime_dir) == directory
    assert "belongs to another user (uid 0)" in refusal(entries)


def test_runtime_directory_that_cannot_be_looked_into_is_refused(place: Path, monkeypatch: pytest.MonkeyPatch):
    directory = place / "run"
    directory.mkdir()
    unreadable(directory)
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(directory))
    said = refusal(entries)
    assert str(directory) in said and "ermission denied" in said
    code, said = asked(pancakes, "agent", "list")
    assert code == 1 and str(directory) in said


# Recordings and logs ---------------------------------------------------------------------------------------------


def test_unreadable_recording_is_refused(place: Path):
    path = place / "a.mcap"
    written(path, [pose(0), pose(1)])
    unreadable(path)
    for verb in (("record", "info"), ("why",), ("rerun",), ("replay", "--dry-run")):
        more = ["Task"] if verb == ("rerun",) else []
        code, said = asked(pancakes, *verb, str(path), *more)
        assert code == 2 and "is not readable" in said, verb
    said = refusal(lambda: list(RecordingReader(path).entries()))
    assert f"{path} cannot be read: Permission denied" in said


def agent_says(text: str, wanted: str, place: Path, *asks: Any) -> list[str]:
    """Runs an agent as the other user; returns its replies, and waits until it has said `wanted` on its log."""
    state = place / "state"
    state.mkdir()
    theirs(state, 0o700)

    def run() -> list[str]:
        with threaded_agent("a", text, state_dir=state) as agent:
            replies = [agent.ask(ask).reason for ask in asks]
            agent.wait_until(lambda: any(wanted in line for level in LEVELS for line in agent.lines(level)))
            return [*replies, *agent.running("client")]

    return as_other_user(run)


LEVELS = ("warning", "error")


def test_log_file_that_cannot_be_written_is_told_and_the_agent_runs(place: Path):
    file = unwritable(place / "logs") / "a.jsonl"
    agent_says(QUIET.format(f', file = "{file}"'), f"the log file {file} cannot be written: Permission denied", place)
    assert not file.exists()


def test_recording_that_cannot_be_written_is_told_and_the_agent_runs(place: Path):
    file = unwritable(place / "recordings") / "a.mcap"
    text = f'[record]\npath = "{file}"\n' + QUIET.format("")
    agent_says(text, f"{file}", place)
    assert not file.exists()
