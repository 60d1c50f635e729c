"""What `pancakes fleet` refuses on one machine: no key is overwritten, and none is taken that does not fit."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from cli.processes import Rig
from click.testing import CliRunner

from pancakes.client.fleet_way import FleetWay
from pancakes.errors import PancakesError
from pancakes.mesh.security import key_folders
from pancakes.mesh.security.fleet_office import FleetOffice
from pancakes.mesh.security.key_files import KEY
from pancakes.runtime.clock import MonotonicClock
from pancakes.tools.cli.verbs.fleet import fleet

Run = Callable[..., str]
"""Takes the words of a command; returns what it prints. Its refusal is an exception."""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    for variable in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "PANCAKES_RUNTIME_DIR"):
        monkeypatch.setenv(variable, str(tmp_path / variable))

    def ran(*arguments: str | Path) -> str:
        result = CliRunner().invoke(fleet, list(map(str, arguments)), catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    ran("init", "garage", "--me", "alice", "--no-password")
    return ran


def test_fleet_init_founds_none_in_the_place_of_another(run: Run):
    key = (key_folders.fleets() / "garage" / "authority.key").read_bytes()
    with pytest.raises(PancakesError, match="there is a fleet garage in .* already"):
        run("init", "garage", "--no-password")
    assert (key_folders.fleets() / "garage" / "authority.key").read_bytes() == key


def test_fleet_of_several_must_be_named(run: Run):
    run("init", "barn", "--no-password", "--me", "alice")
    with pytest.raises(
        PancakesError, match=r"several fleets were founded here: say which with --fleet \(barn, garage\)"
    ):
        run("list")
    assert "operator" in run("list", "--fleet", "barn")
    with pytest.raises(PancakesError, match="the fleet shed was not founded here"):
        run("list", "--fleet", "shed")


def test_fleet_enrol_gives_out_a_name_once(run: Run, tmp_path: Path):
    run("enrol", "r1", "--out", tmp_path / "r1")
    before = (tmp_path / "r1" / KEY).read_bytes()
    with pytest.raises(PancakesError, match="agent/r1 belongs to the fleet garage already"):
        run("enrol", "r1", "--out", tmp_path / "other")
    with pytest.raises(PancakesError, match="the folder .*r1 is not empty"):
        run("enrol", "r2", "--out", tmp_path / "r1")
    assert (tmp_path / "r1" / KEY).read_bytes() == before and not (tmp_path / "other").exists()


def test_fleet_join_refuses_a_folder_that_does_not_fit(run: Run, tmp_path: Path):
    run("enrol", "r1", "--out", tmp_path / "r1")
    FleetOffice.founded("garage", tmp_path / "elsewhere").enrol_with_key("agent", "r1").write(tmp_path / "theirs")
    shutil.copy(tmp_path / "theirs" / KEY, tmp_path / "r1" / KEY)
    with pytest.raises(PancakesError, match="the authority of that fleet has not signed its certificate"):
        run("join", tmp_path / "r1")
    (tmp_path / "r1" / "fleet.pem").unlink()
    with pytest.raises(PancakesError, match="r1 is no folder of pancakes fleet enrol: No such file"):
        run("join", tmp_path / "r1")
    assert key_folders.keys_of_agent("garage", "r1") is None


def test_fleet_join_keeps_the_keys_of_another_person(run: Run, tmp_path: Path):
    run("enrol", "bob", "--role", "observer", "--out", tmp_path / "bob")
    own = (key_folders.folder_of_person("garage") / KEY).read_bytes()
    with pytest.raises(PancakesError, match="you are alice of the fleet garage already: remove .*me first"):
        run("join", tmp_path / "bob")
    assert (key_folders.folder_of_person("garage") / KEY).read_bytes() == own
    run("enrol", "r1", "--out", tmp_path / "r1")
    assert "This machine is r1 of the fleet garage" in run("join", tmp_path / "r1")


def test_fleet_revoke_leaves_no_rights(run: Run, tmp_path: Path):
    run("enrol", "bob", "--role", "observer", "--out", tmp_path / "bob")
    assert run("can", "bob", "look", "a").startswith("yes: ")
    with pytest.raises(PancakesError, match="no agent has heard of the roster 2 yet"):
        run("revoke", "bob", "left")
    with pytest.raises(PancakesError, match="no: observer/bob was revoked: left"):
        run("can", "bob", "look", "a")
    with pytest.raises(PancakesError, match="no agent has heard of the roster 3 yet"):
        run("revoke", "alice", "laptop stolen")
    with pytest.raises(
        PancakesError, match=r"your keys for the fleet garage are of no use .* was revoked \(roster 3\)"
    ):
        FleetWay.to("garage", MonotonicClock())


def test_fleet_sign_notices_an_old_copy_of_the_authority(rig: Rig):
    rig.ready("a")
    folder = rig.keys.office("test").folder
    old = (folder / "register.json").read_bytes()
    for _ in range(2):
        assert rig.pancakes("fleet", "sign", "--fleet", "test").returncode == 0
    (folder / "register.json").write_bytes(old)
    told = rig.pancakes("fleet", "sign", "--fleet", "test")
    assert "a knows the roster 3 already, and takes none with a lower number: this folder is an old copy" in told.stderr
