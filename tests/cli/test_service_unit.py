"""The unit with which systemd runs an agent."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from cli.processes import Rig
from msgspec.structs import replace

from pancakes.bodies.devices.hardware import Hardware
from pancakes.errors import PancakesError
from pancakes.tools.cli.service_unit import UnitFacts, unit_of, user_unit_of

FACTS = UnitFacts("a", "yard", ("/opt/pancakes/bin/pancakes-agent", "--config", "/etc/pancakes/a.toml"))
EXPOSURE = 3.0
with_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed here")


def values(unit: str, key: str) -> list[str]:
    """Returns what stands for a key in a unit."""
    return [line.partition("=")[2] for line in unit.splitlines() if line.startswith(f"{key}=")]


@with_systemd
@pytest.mark.parametrize(
    "facts",
    [
        FACTS,
        replace(FACTS, networked=True, group="robots", writes=("/srv/my data", "/srv/100%"), reads=("/home/x",)),
        replace(FACTS, hardware=(Hardware("/dev/ttyUSB0", "dialout"), Hardware("char-i2c", "i2c"))),
    ],
    ids=["bare", "all", "hardware"],
)
def test_systemd_finds_no_fault_with_it(tmp_path: Path, facts: UnitFacts):
    program = tmp_path / "pancakes agent"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for name, unit in (("system", unit_of(replace(facts, command=(str(program), "--config", "/etc/$x %y.toml")))),):
        path = tmp_path / f"pancakes-{name}.service"
        path.write_text(unit)
        verified = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True)
        assert (verified.returncode, verified.stdout, verified.stderr) == (0, "", "")


@with_systemd
def test_an_agent_without_hardware_is_hardly_exposed(tmp_path: Path):
    path = tmp_path / "pancakes-a.service"
    path.write_text(unit_of(FACTS))
    told = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(path)], capture_output=True, text=True
    ).stdout
    found = re.search(r"Overall exposure level for pancakes-a.service: ([\d.]+)", told)
    assert found is not None and float(found[1]) <= EXPOSURE, told


def test_it_may_open_what_its_drivers_need_and_nothing_else():
    assert values(unit_of(FACTS), "PrivateDevices") == ["yes"]
    unit = unit_of(replace(FACTS, hardware=(Hardware("/dev/ttyUSB0", "dialout"), Hardware("/dev/ttyUSB1", "dialout"))))
    assert values(unit, "PrivateDevices") == []
    assert values(unit, "DevicePolicy") == ["closed"]
    assert values(unit, "DeviceAllow") == ["/dev/ttyUSB0 rw", "/dev/ttyUSB1 rw"]
    assert values(unit, "SupplementaryGroups") == ["dialout"]


def test_its_folders_are_its_own_and_those_that_the_configuration_names():
    unit = unit_of(replace(FACTS, writes=("/srv/logs", "/srv/my data")))
    assert values(unit, "StateDirectory") == ["pancakes/yard/a"]
    assert values(unit, "ReadWritePaths") == ["-/srv/logs", '"-/srv/my data"']
    assert values(unit, "ProtectHome") == ["yes"]
    assert values(unit_of(replace(FACTS, reads=("/home/pi/pancakes",))), "ProtectHome") == ["read-only"]
    assert values(unit_of(replace(FACTS, reads=("/homes",))), "ProtectHome") == ["yes"]


def test_a_dollar_is_doubled_where_systemd_takes_it_for_a_variable_and_nowhere_else():
    unit = unit_of(
        replace(FACTS, command=("/opt/$x/agent", "--config", "/etc/a b$.toml"), writes=("/srv/$y", "/srv/$ 2"))
    )
    assert values(unit, "ExecStart") == ['/opt/$$x/agent --config "/etc/a b$$.toml"']
    assert values(unit, "ReadWritePaths") == ["-/srv/$y", '"-/srv/$ 2"']


def test_a_group_may_look_where_the_configuration_says_so():
    assert values(unit_of(FACTS), "RuntimeDirectoryMode") == ["0700"]
    unit = unit_of(replace(FACTS, group="robots"))
    assert values(unit, "RuntimeDirectoryMode") == ["0750"] and values(unit, "SupplementaryGroups") == ["robots"]


def test_one_on_the_network_waits_for_it():
    assert values(unit_of(FACTS), "Wants") == []
    assert values(unit_of(replace(FACTS, networked=True)), "Wants") == ["network-online.target"]


def test_a_user_needs_a_name_that_the_machine_can_have():
    assert values(unit_of(FACTS, "robot"), "User") == ["robot"]
    with pytest.raises(PancakesError, match="'my robot' is no name for a user of this machine"):
        unit_of(FACTS, "my robot")


def test_the_unit_of_a_person_keeps_the_usual_folders():
    unit = user_unit_of(FACTS, "/home/me/100% mine", {"PANCAKES_RUNTIME_DIR": "/run/my agents", "SHELL": "/bin/sh"})
    assert values(unit, "User") == values(unit, "StateDirectory") == values(unit, "ProtectSystem") == []
    assert values(unit, "WantedBy") == ["default.target"] and values(unit, "Type") == ["notify"]
    assert values(unit, "WorkingDirectory") == ["/home/me/100%% mine"]
    assert values(unit, "Environment") == ['"PANCAKES_RUNTIME_DIR=/run/my agents"']


def test_the_command_prints_the_unit_of_a_configuration(rig: Rig):
    logs = rig.directory / "logs"
    config = rig.config("a", f'[service.log]\nsettings = {{ file = "{logs}/a.jsonl" }}\n')
    done = rig.pancakes("agent", "unit", str(config), "--run-as", "robot")
    assert done.returncode == 0, done.stderr
    assert values(done.stdout, "User") == ["robot"] and values(done.stdout, "ReadWritePaths") == [f"-{logs}"]
    assert values(done.stdout, "ExecStart")[0].endswith(f"--config {config}")
    assert "User=" not in rig.pancakes("agent", "unit", str(config), "--user").stdout


def test_a_driver_says_what_it_opens(rig: Rig):
    settings = '{ port = "/dev/ttyUSB3", nodes = { shed = 1 } }'
    config = rig.config("a", f'[device.line]\ndriver = "sensor_field.serial"\nsettings = {settings}\n')
    done = rig.pancakes("agent", "unit", str(config))
    assert done.returncode == 0, done.stderr
    assert values(done.stdout, "DeviceAllow") == ["/dev/ttyUSB3 rw"]
    assert values(done.stdout, "SupplementaryGroups") == ["dialout"] and values(done.stdout, "ReadWritePaths") == []


def test_what_cannot_be_a_service_is_refused_with_a_reason(rig: Rig):
    config = rig.config("a", '[device.arm]\ndriver = "no.such"\n')
    done = rig.pancakes("agent", "unit", str(config))
    assert done.returncode == 4 and "no.such" in done.stderr and done.stdout == ""
    both = rig.pancakes("agent", "unit", str(config), "--user", "--run-as", "robot")
    assert both.returncode == 2 and "one of --user runs as you" in both.stderr
    nobody = rig.pancakes("agent", "unit", str(rig.config("b")), "--run-as", "")
    assert nobody.returncode == 1 and "'' is no name for a user of this machine" in nobody.stderr
