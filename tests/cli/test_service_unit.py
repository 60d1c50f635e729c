"""The unit with which systemd runs an agent."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from cli.invoked import invoked
from cli.processes import Rig
from msgspec.structs import replace

from pancakes.devices.driver import Hardware
from pancakes.errors import PancakesError
from pancakes.tools.cli.systemd_unit import UnitFacts, unit_of, user_unit_of

FACTS = UnitFacts("a", "yard", ("/opt/pancakes/bin/pancakes-agent", "--config", "/etc/pancakes/a.toml"))
EXPOSURE = 3.0
with_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed here")


def values(unit: str, key: str) -> list[str]:
    """Return the values of a key in a unit."""
    return [line.partition("=")[2] for line in unit.splitlines() if line.startswith(f"{key}=")]


@with_systemd
def test_unit_is_valid_and_confined(tmp_path: Path):
    program = tmp_path / "pancakes agent"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    paths = []
    for number, facts in enumerate(
        (
            FACTS,
            replace(FACTS, networked=True, group="robots", writes=("/srv/my data", "/srv/100%"), reads=("/home/x",)),
            replace(FACTS, hardware=(Hardware("/dev/ttyUSB0", "dialout"), Hardware("char-i2c", "i2c"))),
        )
    ):
        paths.append(tmp_path / f"pancakes-{number}.service")
        paths[-1].write_text(unit_of(replace(facts, command=(str(program), "--config", "/etc/$x %y.toml"))))
    verified = subprocess.run(["systemd-analyze", "verify", *map(str, paths)], capture_output=True, text=True)
    assert (verified.returncode, verified.stdout, verified.stderr) == (0, "", "")

    path = tmp_path / "pancakes-a.service"
    path.write_text(unit_of(FACTS))
    told = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(path)], capture_output=True, text=True
    ).stdout
    found = re.search(r"Overall exposure level for pancakes-a.service: ([\d.]+)", told)
    assert found is not None and float(found[1]) <= EXPOSURE, told


def test_unit_opens_only_the_devices_of_its_drivers():
    assert values(unit_of(FACTS), "PrivateDevices") == ["yes"]
    unit = unit_of(replace(FACTS, hardware=(Hardware("/dev/ttyUSB0", "dialout"), Hardware("/dev/ttyUSB1", "dialout"))))
    assert values(unit, "PrivateDevices") == []
    assert values(unit, "DevicePolicy") == ["closed"]
    assert values(unit, "DeviceAllow") == ["/dev/ttyUSB0 rw", "/dev/ttyUSB1 rw"]
    assert values(unit, "SupplementaryGroups") == ["dialout"]


def test_unit_has_its_folders_and_those_of_the_configuration():
    unit = unit_of(replace(FACTS, writes=("/srv/logs", "/srv/my data")))
    assert values(unit, "StateDirectory") == ["pancakes/yard/a"]
    assert values(unit, "ReadWritePaths") == ["-/srv/logs", '"-/srv/my data"']
    assert values(unit, "ProtectHome") == ["yes"]
    assert values(unit_of(replace(FACTS, reads=("/home/pi/pancakes",))), "ProtectHome") == ["read-only"]
    assert values(unit_of(replace(FACTS, reads=("/homes",))), "ProtectHome") == ["yes"]


def test_unit_doubles_a_dollar_in_a_command_only():
    unit = unit_of(
        replace(FACTS, command=("/opt/$x/agent", "--config", "/etc/a b$.toml"), writes=("/srv/$y", "/srv/$ 2"))
    )
    assert values(unit, "ExecStart") == ['/opt/$$x/agent --config "/etc/a b$$.toml"']
    assert values(unit, "ReadWritePaths") == ["-/srv/$y", '"-/srv/$ 2"']


def test_unit_opens_the_runtime_directory_to_the_local_group():
    assert values(unit_of(FACTS), "RuntimeDirectoryMode") == ["0700"]
    unit = unit_of(replace(FACTS, group="robots"))
    assert values(unit, "RuntimeDirectoryMode") == ["0750"] and values(unit, "SupplementaryGroups") == ["robots"]


def test_unit_of_a_networked_agent_waits_for_the_network():
    assert values(unit_of(FACTS), "Wants") == []
    assert values(unit_of(replace(FACTS, networked=True)), "Wants") == ["network-online.target"]


def test_unit_refuses_a_bad_name_of_a_user():
    assert values(unit_of(FACTS, "robot"), "User") == ["robot"]
    with pytest.raises(PancakesError, match="'my robot' is no name for a user of this machine"):
        unit_of(FACTS, "my robot")


def test_unit_of_a_person_keeps_the_usual_folders():
    unit = user_unit_of(FACTS, "/home/me/100% mine", {"PANCAKES_RUNTIME_DIR": "/run/my agents", "SHELL": "/bin/sh"})
    assert values(unit, "User") == values(unit, "StateDirectory") == values(unit, "ProtectSystem") == []
    assert values(unit, "WantedBy") == ["default.target"] and values(unit, "Type") == ["notify"]
    assert values(unit, "WorkingDirectory") == ["/home/me/100%% mine"]
    assert values(unit, "Environment") == ['"PANCAKES_RUNTIME_DIR=/run/my agents"']


def test_agent_unit_prints_the_unit_of_a_configuration(rig: Rig):
    logs = rig.directory / "logs"
    settings = '{ port = "/dev/ttyUSB3", nodes = { shed = 1 } }'
    device = f'[device.line]\ndriver = "sensor_field.serial"\nrate_hz = 1\nsettings = {settings}\n'
    config = rig.config("a", f'[service.log]\nsettings = {{ file = "{logs}/a.jsonl" }}\n{device}')
    done = rig.pancakes("agent", "unit", str(config), "--run-as", "robot")
    assert done.returncode == 0, done.stderr
    assert values(done.stdout, "User") == ["robot"] and values(done.stdout, "ReadWritePaths") == [f"-{logs}"]
    assert values(done.stdout, "ExecStart")[0].endswith(f"--config {config}")
    assert values(done.stdout, "DeviceAllow") == ["/dev/ttyUSB3 rw"], "a driver says what it opens"
    assert values(done.stdout, "SupplementaryGroups") == ["dialout"]
    assert "User=" not in invoked("agent", "unit", str(config), "--user").stdout


def test_agent_unit_is_refused_with_a_reason(rig: Rig):
    config = rig.config("a", '[device.arm]\ndriver = "no.such"\n')
    done = invoked("agent", "unit", str(config))
    assert done.exit_code == 4 and "no.such" in done.stderr and done.stdout == ""
    both = invoked("agent", "unit", str(config), "--user", "--run-as", "robot")
    assert both.exit_code == 2 and "a --user service runs as you" in both.stderr
    assert invoked("agent", "unit", str(rig.config("b")), "--run-as", "").exit_code == 1
