"""The unit that `pancakes agent unit` prints, run by the systemd of a whole machine, as docs/system-service.md says."""

from __future__ import annotations

import pytest
from systemd_vm.conftest import CONFIG, ROVER, Bench
from systemd_vm.virtual_machine import VirtualMachine

UNIT = "pancakes-rover"
PANCAKES = "/opt/pancakes/bin/pancakes"
OTHER_PORT = """
[device.battery]
driver = "khepera3.battery"
rate_hz = 1
settings = { port = "/dev/ttyS2" }
"""
WALK = """
[task.Walk]
type = "yard.Walk"
"""
CHIP = """\
schema = 1

[agent]
name = "rover"
fleet = "yard"
listen = []

[device.heat]
driver = "pi.temperature"
rate_hz = 1
settings = {{ model = "lm75", bus = {bus} }}

[device.cell]
driver = "pi.battery"
rate_hz = 1
settings = {{ bus = {bus}, full_v = 8.4, empty_v = 6.4 }}
"""


def installs(machine: VirtualMachine, config: str) -> None:
    """Writes the configuration and its unit."""
    configures(machine, config)
    machine.does(f"{PANCAKES} agent unit {CONFIG} > /etc/systemd/system/{UNIT}.service && systemctl daemon-reload")


def configures(machine: VirtualMachine, config: str) -> None:
    machine.does(f"cat > {CONFIG} <<'end'\n{config}end")


def hears(machine: VirtualMachine, text: str) -> None:
    """Waits for a line of the service, since it was started last."""
    machine.until(f"journalctl -o cat _SYSTEMD_INVOCATION_ID={shows(machine, 'InvocationID')} | grep -F {text!r}")


def shows(machine: VirtualMachine, key: str) -> str:
    return machine.does(f"systemctl show -P {key} {UNIT}").strip()


@pytest.mark.timeout(1800)
def test_a_service_opens_the_serial_port_of_its_configuration_and_is_refused_another(bench: Bench):
    machine = bench.machine
    installs(machine, ROVER + WALK)
    machine.does(f"systemctl enable --now {UNIT}")  # which returns once the agent is ready
    assert shows(machine, "ActiveState") == "active" and shows(machine, "StatusText") == "rover is ready"
    hears(machine, "speaks with a Khepera III (firmware 3.1) on /dev/ttyS1")
    assert "D,l0,l0" in bench.robot.heard

    # Its folders are its own, and it runs as its user.
    folders = "/var/lib/pancakes/yard/rover /var/log/pancakes /run/pancakes"
    assert machine.does(f"stat -c '%U %a' {folders}").splitlines() == ["pancakes 700", "pancakes 755", "pancakes 700"]
    main = shows(machine, "MainPID")
    assert machine.does(f"stat -c %U /proc/{main}").strip() == "pancakes"
    listed = machine.does(f"PANCAKES_RUNTIME_DIR=/run/pancakes {PANCAKES} agent list")
    assert "rover" in listed

    # Another port in the configuration is refused until the unit is printed anew, although its group may open it.
    configures(machine, ROVER + WALK + OTHER_PORT)
    machine.does(f"systemctl restart {UNIT}")
    hears(machine, "/dev/ttyS2 cannot be used (Operation not permitted: ")
    hears(machine, "speaks with a Khepera III (firmware 3.1) on /dev/ttyS1")
    assert bench.other.heard == []
    warnings = machine.does(f"journalctl -o cat -u {UNIT} -p warning")
    assert "/dev/ttyS2 cannot be used" in warnings and "speaks with" not in warnings
    installs(machine, ROVER + WALK + OTHER_PORT)
    machine.does(f"systemctl restart {UNIT}")
    hears(machine, "speaks with a Khepera III (firmware 3.1) on /dev/ttyS2")

    # One that is killed, or hangs, is started again.
    main = shows(machine, "MainPID")
    machine.does(f"kill -KILL {main}")
    machine.until(f"test $(systemctl show -P NRestarts {UNIT}) = 1 && systemctl is-active {UNIT}")
    machine.does("touch /run/hang")
    machine.until(f"test $(systemctl show -P NRestarts {UNIT}) = 2 && rm -f /run/hang")
    machine.until(f"systemctl is-active {UNIT}")
    assert "Watchdog timeout" in machine.does(f"journalctl -o cat -u {UNIT}")

    bench.robot.heard.clear()
    machine.does(f"systemctl stop {UNIT}")
    assert (shows(machine, "Result"), shows(machine, "ExecMainStatus")) == ("success", "0")
    assert "D,l0,l0" in bench.robot.heard, "the wheels are told to stand"


@pytest.mark.timeout(1800)
def test_a_chip_on_a_bus_of_the_kernel_is_read_by_a_service_that_was_started_when_the_bus_was_there(bench: Bench):
    machine = bench.machine
    bus = plug(machine)
    machine.does("rmmod i2c-stub")
    installs(machine, CHIP.format(bus=bus))
    machine.does(f"systemctl restart {UNIT}")
    hears(machine, f"the bus /dev/i2c-{bus} cannot be opened (No such file or directory); raspi-config")
    assert plug(machine) == bus
    hears(machine, f"the bus /dev/i2c-{bus} cannot be opened (Operation not permitted: ")
    machine.does(f"systemctl restart {UNIT}")
    echo = f"PANCAKES_RUNTIME_DIR=/run/pancakes timeout 60 {PANCAKES} channel echo rover/system --count 1"
    assert "celsius: 25\n" in machine.does(f"{echo} --type temperature")
    assert "voltage_v: 7.8\n" in machine.does(f"{echo} --type battery")
    machine.does(f"i2cset -y {bus} 0x48 0 0xe7 0x00 i")  # table 8 of the LM75A
    machine.until(f"{echo} --type temperature | grep 'celsius: -25$'")
    machine.does(f"systemctl stop {UNIT}")


def plug(machine: VirtualMachine) -> int:
    """Puts a thermometer at 25 degrees and a voltmeter at 7.8 V on a bus; returns the number of the bus."""
    machine.does("modprobe i2c-stub chip_addr=0x48,0x40 && modprobe i2c-dev && udevadm settle")
    bus = machine.does("grep -l 'SMBus stub' /sys/class/i2c-adapter/i2c-*/name | sed 's/.*i2c-//;s:/name::'").strip()
    machine.does(f"i2cset -y {bus} 0x48 0 0x19 0x00 i && i2cset -y {bus} 0x40 2 0x3c 0xf0 i")
    return int(bus)
