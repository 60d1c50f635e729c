"""A machine that systemd runs, with Pancakes in it and a robot at a serial port."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from deploy.plugin_wheels import plugin_wheel
from pi.khepera_bench import KheperaBench
from systemd_vm.machine_image import debian_tree, disk_with
from systemd_vm.virtual_machine import GUEST_FILES, VirtualMachine

from pancakes.tools.deploy.wheels import CORE, Platform, distribution_of, installed_wheels, libraries_for

DEBIAN = Platform.of((3, 11), "linux-x86_64", ("glibc", "2.36"))
CONFIG = "/etc/pancakes/rover.toml"
ROVER = """\
schema = 1

[agent]
name = "rover"
fleet = "yard"
listen = []

[device.motors]
driver = "khepera3.motors"
settings = { port = "/dev/ttyS1" }
"""
"""A robot at the first serial port after the console."""
WALK = '''
import os
import signal

from pancakes.task import Task, Tick, every

VERSION = "{version}"


class Walk(Task):
    """Hangs the whole process where a file tells it to."""

    @every(hz=2)
    def look(self, tick: Tick) -> None:
        if os.path.exists("/run/hang"):
            os.kill(os.getpid(), signal.SIGSTOP)
'''


@dataclass
class Bench:
    """What a test has before it.

    Attributes:
        machine: the computer.
        robot: at `/dev/ttyS1`.
        other: one at `/dev/ttyS2`.
    """

    machine: VirtualMachine
    robot: KheperaBench
    other: KheperaBench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    tree = debian_tree()
    folder = tmp_path_factory.mktemp("machine")
    own = [it for it in installed_wheels(folder) if distribution_of(it) in (CORE, "pancakes-pi")]
    wheels = [it.path for it in (*own, *libraries_for(own, (), DEBIAN))] + [plugin_wheel(folder / "yard", "1.0", WALK)]
    disk = disk_with(tree, folder, {**GUEST_FILES, CONFIG: ROVER}, wheels)
    robot, other = KheperaBench(folder / "robot"), KheperaBench(folder / "other")
    machine = None
    try:
        machine = VirtualMachine(folder, tree, disk, [robot.link, other.link])
        machine.does("useradd --system --home-dir /var/lib/pancakes --shell /usr/sbin/nologin pancakes")
        yield Bench(machine, robot, other)
    finally:
        if machine is not None:
            machine.close()
        robot.unplug()
        other.unplug()
