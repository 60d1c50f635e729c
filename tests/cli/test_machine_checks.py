"""`pancakes doctor` on the machine: faults of libraries, plug-ins, folders and disks."""

import os
import resource
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pancakes.journal import FileJournal, JournalEntry
from pancakes.journal.file_journal import WRITE_AHEAD
from pancakes.tools.cli.verbs.agent_checks import Finding
from pancakes.tools.cli.verbs.machine_checks import (
    check_files,
    check_plugins,
    check_python,
    check_runtime_dir,
    check_sockets,
    check_state_dirs,
)
from pancakes.util.plugins import Plugins
from pancakes.util.runtime_dir import VARIABLE


def levels(findings: Iterator[Finding] | list[Finding]) -> list[tuple[str, str]]:
    return [(finding.level, finding.about) for finding in findings]


def test_machine_check_of_versions(monkeypatch: pytest.MonkeyPatch):
    for version, bounds, good in (
        ("4.5.0", ">=4.5,<5", True),
        ("4.10", ">=4.5", True),
        ("5.0.1", ">=4.5,<5", False),
        ("4.4.9", ">=4.5,<5", False),
        ("5.0rc1", ">=4.5", True),
        ("9", "", True),
    ):
        monkeypatch.setattr("importlib.metadata.requires", lambda name, bounds=bounds: [f"pykka{bounds}"])
        monkeypatch.setattr("importlib.metadata.version", lambda name, version=version: version)
        assert all(it.level == "ok" for it in check_python()) is good, (version, bounds)


def test_machine_check_reports_a_missing_library(monkeypatch: pytest.MonkeyPatch):
    needs = ["msgpack>=99", "no-such-library>=1", "pytest>=999 ; extra == 'test'"]
    monkeypatch.setattr("importlib.metadata.requires", lambda name: needs)

    found = list(check_python())

    assert [(it.level, it.text.partition(" ")[0]) for it in found] == [
        ("error", "msgpack"),
        ("error", "no-such-library"),
        ("ok", "Python"),
    ]
    assert found[0].advice == "pip install 'msgpack>=99'"


def test_machine_check_reports_a_broken_plugin():
    class Broken(Plugins):
        def get(self, group: str, name: str) -> Any:
            from pancakes.errors import PluginError

            if name == "host.load":
                raise PluginError("the driver 'host.load' cannot be loaded")
            return super().get(group, name)

    found = list(check_plugins(Broken()))

    assert (found[0].level, found[0].text) == ("error", "the driver 'host.load' cannot be loaded")
    assert "pancakes-agents" in found[0].advice


def test_machine_check_of_the_runtime_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    directory = tmp_path / "runtime"
    monkeypatch.setenv(VARIABLE, str(directory))
    assert levels(check_runtime_dir()) == [("ok", "runtime directory")]  # it is not there
    directory.mkdir(mode=0o755)
    (finding,) = check_runtime_dir()
    assert finding.level == "error"
    assert f"chmod 700 {directory}" in finding.advice
    directory.chmod(0o700)
    assert levels(check_runtime_dir()) == [("ok", "runtime directory")]


def test_machine_check_of_socket_directories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "runtime"))
    assert levels(check_sockets()) == [], "no agent has listened yet"
    fleet = tmp_path / "runtime" / "local" / "garage"
    fleet.mkdir(parents=True, mode=0o700)
    fleet.parent.chmod(0o750)
    assert levels(check_sockets()) == [("ok", "local sockets")]
    (fleet / "a.sock").write_text("")
    (finding,) = check_sockets()
    assert (finding.level, finding.text) == (
        "warning",
        f"{fleet / 'a.sock'} is not a socket, so no agent can listen there",
    )
    fleet.chmod(0o755)
    (finding,) = check_sockets()
    assert finding.level == "error" and f"{fleet} is open to other users" in finding.text
    assert finding.advice.endswith(f"chmod 700 {fleet}")
    fleet.parent.chmod(0o755)
    assert levels(check_sockets()) == [("error", "local sockets")] * 2


def written(tmp_path: Path, entry: JournalEntry) -> FileJournal:
    """Return a journal with an entry that has its own file."""
    journal = FileJournal(tmp_path / "state" / "fleet" / "a")
    journal.write([entry])
    journal.close()
    return FileJournal(journal.directory)


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[FileJournal]:
    journal = written(tmp_path, JournalEntry("task", "a/Scan", b"state"))
    yield journal
    journal.close()


def test_machine_check_shows_the_user_of_a_state_directory(tmp_path: Path, journal: FileJournal):
    first, second = check_state_dirs(tmp_path / "state")
    assert first.text.endswith(f"MiB are free in {tmp_path / 'state'}")
    assert second.text == f"{journal.directory} is in use by process {os.getpid()}"
    journal.close()
    assert list(check_state_dirs(tmp_path / "state"))[1].text == f"{journal.directory} is not in use"


def test_machine_check_finds_damaged_entries(tmp_path: Path, journal: FileJournal):
    (torn,) = journal.directory.glob("task.*")
    torn.write_bytes(torn.read_bytes()[:-3])

    _, finding = check_state_dirs(tmp_path / "state")

    assert finding.level == "error"
    assert f"{torn.name} is torn or damaged" in finding.text

    torn.rename(torn.with_name(torn.name + ".bad"))
    _, finding = check_state_dirs(tmp_path / "state")
    assert (finding.level, torn.name + ".bad" in finding.text) == ("warning", True), "it was set aside"

    torn.with_name(torn.name + ".bad").unlink()
    for data in (b"1", b"2"):
        journal.write([JournalEntry("record", "a/Scan", data)])
    ahead = journal.directory / WRITE_AHEAD
    ahead.write_bytes(b"?" + ahead.read_bytes()[1:])
    _, finding = check_state_dirs(tmp_path / "state")
    assert finding.level == "error" and f"{WRITE_AHEAD} is damaged" in finding.text


def test_machine_check_of_a_lost_record_asks_for_a_decision(tmp_path: Path):
    journal = written(tmp_path, JournalEntry("record", "a/Scan", b""))
    (record,) = journal.directory.glob("record.*")
    record.rename(record.with_name(record.name + ".2.bad"))

    _, finding = check_state_dirs(tmp_path / "state")

    assert finding.level == "warning" and "pancakes task recover" in finding.advice
    journal.write([JournalEntry("record", "a/Scan", b"")])
    _, finding = check_state_dirs(tmp_path / "state")
    assert finding.advice == "remove them: none is needed any more"
    journal.close()


def test_machine_check_of_a_state_directory_open_to_others(tmp_path: Path, journal: FileJournal):
    journal.directory.chmod(0o770)
    _, finding = check_state_dirs(tmp_path / "state")
    assert finding.level == "error" and f"chmod go-w {journal.directory}" in finding.text


def test_machine_check_of_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    usage = namedtuple("usage", "total used free")
    for free_mib, level in ((10, "error"), (100, "warning"), (10_000, "ok")):
        monkeypatch.setattr("shutil.disk_usage", lambda path, free_mib=free_mib: usage(0, 0, free_mib * 2**20))
        assert levels(check_state_dirs(tmp_path)) == [(level, "state")]


def test_machine_check_of_the_number_of_open_files():
    assert next(check_files((64, 4096))).level == "warning"
    assert next(check_files((64, 4096))).advice == "raise it: ulimit -n 1024"
    assert next(check_files((1024, 4096))).level == "ok"
    assert next(check_files((resource.RLIM_INFINITY, resource.RLIM_INFINITY))).level == "ok"
