"""`pancakes keys` on one machine: it overwrites no key, and refuses keys that do not fit."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig, pancakes
from click.testing import CliRunner

from pancakes.client.session import FleetAccess
from pancakes.errors import PancakesError
from pancakes.security import key_store
from pancakes.security.authority import Authority
from pancakes.security.key_store import KEY
from pancakes.tools.cli.verbs.keys import keys
from pancakes.util.clock import MonotonicClock

Run = Callable[..., str]
"""Takes the words of a command; returns what it prints. Its refusal is an exception."""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    for variable in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "PANCAKES_RUNTIME_DIR"):
        monkeypatch.setenv(variable, str(tmp_path / variable))

    def ran(*arguments: str | Path) -> str:
        result = CliRunner().invoke(keys, list(map(str, arguments)), catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    ran("init", "garage", "--me", "alice", "--no-password")
    return ran


def test_fleet_init_refuses_an_existing_fleet(run: Run):
    key = (key_store.fleets() / "garage" / "authority.key").read_bytes()
    with pytest.raises(PancakesError, match="the fleet garage exists already, in"):
        run("init", "garage", "--no-password")
    assert (key_store.fleets() / "garage" / "authority.key").read_bytes() == key


def test_one_of_several_fleets_must_be_named(run: Run):
    run("init", "barn", "--no-password", "--me", "alice")
    with pytest.raises(
        PancakesError, match=r"several fleets were founded here: choose one with --fleet \(barn, garage\)"
    ):
        run("list")
    assert "operator" in run("list", "--fleet", "barn")
    with pytest.raises(PancakesError, match="the fleet shed was not founded here"):
        run("list", "--fleet", "shed")


def test_fleet_enrol_refuses_a_used_name(run: Run, tmp_path: Path):
    run("enrol", "r1", "--out", tmp_path / "r1")
    before = (tmp_path / "r1" / KEY).read_bytes()
    with pytest.raises(PancakesError, match="agent/r1 belongs to the fleet garage already"):
        run("enrol", "r1", "--out", tmp_path / "other")
    with pytest.raises(PancakesError, match="the folder .*r1 is not empty"):
        run("enrol", "r2", "--out", tmp_path / "r1")
    assert (tmp_path / "r1" / KEY).read_bytes() == before and not (tmp_path / "other").exists()


def test_fleet_join_refuses_an_unfit_folder(run: Run, tmp_path: Path):
    run("enrol", "r1", "--out", tmp_path / "r1")
    Authority.founded("garage", tmp_path / "elsewhere").enrol_with_key("agent", "r1").write(tmp_path / "theirs")
    shutil.copy(tmp_path / "theirs" / KEY, tmp_path / "r1" / KEY)
    with pytest.raises(PancakesError, match="the authority of that fleet has not signed its certificate"):
        run("join", tmp_path / "r1")
    (tmp_path / "r1" / "fleet.pem").unlink()
    with pytest.raises(PancakesError, match="r1 is not a folder of pancakes keys enrol: No such file"):
        run("join", tmp_path / "r1")
    assert key_store.keys_of_agent("garage", "r1") is None


def test_fleet_join_keeps_the_keys_of_another_person(run: Run, tmp_path: Path):
    run("enrol", "bob", "--role", "observer", "--out", tmp_path / "bob")
    own = (key_store.folder_of_person("garage") / KEY).read_bytes()
    with pytest.raises(PancakesError, match="you are alice of the fleet garage already: remove .*me first"):
        run("join", tmp_path / "bob")
    assert (key_store.folder_of_person("garage") / KEY).read_bytes() == own
    run("enrol", "r1", "--out", tmp_path / "r1")
    assert "This machine is r1 of the fleet garage" in run("join", tmp_path / "r1")


def test_fleet_revoke_leaves_no_rights(run: Run, tmp_path: Path):
    run("enrol", "bob", "--role", "observer", "--out", tmp_path / "bob")
    assert run("can", "bob", "look", "a").startswith("yes: ")
    with pytest.raises(PancakesError, match="no agent has the roster 2 yet"):
        run("revoke", "bob", "left", "--yes")
    with pytest.raises(PancakesError, match="no: observer/bob was revoked: left"):
        run("can", "bob", "look", "a")
    with pytest.raises(PancakesError, match="no agent has the roster 3 yet"):
        run("revoke", "alice", "laptop stolen", "--yes")
    with pytest.raises(
        PancakesError, match=r"your keys for the fleet garage cannot be used .* was revoked \(roster 3\)"
    ):
        FleetAccess.to("garage", MonotonicClock())


@pytest.mark.parametrize("reason", ["", " \n"])
def test_fleet_revoke_without_a_reason_is_refused(run: Run, tmp_path: Path, reason: str):
    run("enrol", "r1", "--out", tmp_path / "r1")
    with pytest.raises(AssertionError, match="must say why"):
        run("revoke", "r1", reason, "--yes")
    with pytest.raises(PancakesError, match="no agent has the roster 2 yet"):
        run("revoke", "r1", "lost\nin the field", "--yes")
    with pytest.raises(PancakesError, match="no: agent/r1 was revoked: lost in the field"):
        run("can", "r1", "look", "a")


@pytest.mark.parametrize("host", ["a b", "10.0.0.5:7490", "tcp://10.0.0.5", "[fe80::zz]"])
def test_fleet_enrol_refuses_an_address_that_nobody_reaches(run: Run, host: str):
    with pytest.raises(AssertionError, match="is not the address of a machine"):
        run("enrol", "r1", "--host", host, "--timeout", "1ms")


@pytest.mark.parametrize("host", ["10.0.0.5", "robot1.local", "fe80::1", "[fe80::1]"])
def test_fleet_enrol_takes_each_kind_of_address(run: Run, host: str):
    with pytest.raises(PancakesError, match="no machine has joined in time"):
        run("enrol", "r1", "--host", host, "--port", "0", "--timeout", "1ms")


def test_fleet_sign_notices_an_old_copy_of_the_authority(rig: Rig):
    rig.ready("a")
    folder = rig.keys.authority("test").folder
    old = (folder / "register.json").read_bytes()
    for _ in range(2):
        assert rig.pancakes("keys", "sign", "--fleet", "test").returncode == 0
    (folder / "register.json").write_bytes(old)
    told = rig.pancakes("keys", "sign", "--fleet", "test")
    assert "a has the roster 3 already, and refuses lower numbers: this folder is an old copy" in told.stderr


def test_password_is_read_without_a_terminal(rig: Rig):
    def init(given: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            pancakes("keys", "init", "barn", "--me", "alice", "--format", "json"),
            input=given,
            capture_output=True,
            text=True,
            check=False,
            start_new_session=True,
            env=rig.environment | {"XDG_DATA_HOME": str(rig.directory / "data")},
        )

    refused = init("\n")
    assert refused.returncode == 1 and "Give it as a line of standard input" in refused.stderr
    founded = init("a secret\n")
    assert (founded.returncode, founded.stderr) == (0, ""), "getpass would warn of an echo"
    folder = Path(json.loads(founded.stdout)[0]["folder"])
    Authority(folder, b"a secret")
    with pytest.raises(PancakesError):
        Authority(folder, b"another one")


def state_of(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder, with their contents."""
    return {str(it.relative_to(folder)): it.read_bytes() for it in folder.rglob("*") if it.is_file()}


def test_fleet_dry_runs_change_nothing_and_ask_for_no_password(run: Run, tmp_path: Path):
    run("enrol", "r1", "--out", tmp_path / "r1")
    before = state_of(tmp_path)
    code = "192.168.1.10:7490/HJOV-ZBJL-JECU-QFLF-4IQ3-JB24-L5EC-OS6P-LNXE-YAVB"
    for words, part in (
        (("init", "barn", "--me", "alice"), "The fleet barn would be in "),
        (("enrol", "r2"), "agent r2 of the fleet garage would be issued to r2, when it presents the code"),
        (("enrol", "r2", "--out", tmp_path / "r2"), f"would be issued to a folder {tmp_path}/r2"),
        (("renew", "alice"), "operator alice of the fleet garage"),
        (("join", tmp_path / "r1"), "The keys of agent r1 of the fleet garage would be in "),
        (("join", code), "The machine at 192.168.1.10:7490 would be asked"),
        (("sign",), "The roster 2 of the fleet garage would be signed"),
        (("allow", "r1", "command"), "dry run"),
        (("revoke", "r1", "lost"), "dry run"),
    ):
        assert part in run(*words, "--dry-run")
        (row,) = json.loads(run(*words, "--dry-run", "--format", "json"))
        assert row["done"] == "dry run"
    with pytest.raises(PancakesError, match="agent/r1 belongs to the fleet garage already"):
        run("enrol", "r1", "--dry-run")
    with pytest.raises(PancakesError, match="has no r9"):
        run("renew", "r9", "--dry-run")
    assert state_of(tmp_path) == before


def test_fleet_verbs_answer_in_json(run: Run, tmp_path: Path):
    def row(*words: str | Path) -> dict[str, Any]:
        (found,) = json.loads(run(*words, "--format", "json"))
        return found

    assert row("init", "barn", "--me", "alice", "--no-password")["done"] == "founded"
    of_barn = ("--fleet", "barn")
    assert row("enrol", "r1", "--out", tmp_path / "r1", *of_barn)["folder"] == str(tmp_path / "r1")
    assert row("join", tmp_path / "r1")["name"] == "r1"
    assert row("renew", "alice", *of_barn)["done"] == "renewed"
    assert row("can", "alice", "end", "r1", *of_barn)["right"] == "end"
