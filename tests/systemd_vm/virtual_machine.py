"""A virtual machine: a kernel and a systemd of its own, so that a test may do there what is of a whole machine."""

from __future__ import annotations

import json
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from harness.debian_packages import need
from systemd_vm import guest_commands

PATIENCE_S = 400.0
"""So long a machine may take to start, and a command in it: its processor is made of instructions of this one."""
SERVICE = """
[Unit]
Description=Commands of a test
[Service]
ExecStart=/usr/bin/python3 /opt/guest_commands.py
[Install]
WantedBy=multi-user.target
"""
GUEST_FILES = {
    "/opt/guest_commands.py": Path(guest_commands.__file__).read_text(),
    "/etc/systemd/system/commands.service": SERVICE,
    "/etc/udev/rules.d/90-commands.rules": 'KERNEL=="vport*", ATTR{name}=="commands", TAG+="systemd", '
    'ENV{SYSTEMD_WANTS}+="commands.service"\n',
    "/etc/hostname": "guest\n",
    "/etc/fstab": "/dev/vda / ext4 defaults 0 0\n",
}
"""What a disk needs, so that commands can be given."""


class VirtualMachine:
    """It runs until it is closed.

    Args:
        folder: its files.
        tree: the tree of its Debian, whose kernel it runs.
        disk: see `machine_image.disk_with`; with `GUEST_FILES`.
        serial_ports: the terminals of this machine at the other end of its `/dev/ttyS1`, `/dev/ttyS2`, ...
    """

    def __init__(self, folder: Path, tree: Path, disk: Path, serial_ports: Sequence[Path]) -> None:
        self._console = folder / "console"
        path = folder / "commands"
        (kernel,) = tree.glob("boot/vmlinuz-*")
        (initrd,) = tree.glob("boot/initrd.img-*")
        command = [need("qemu-system-x86_64", "qemu-system-x86"), "-nodefaults", "-display", "none", "-no-reboot"]
        command += ["-machine", "q35", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", "1024"]
        command += ["-kernel", str(kernel), "-initrd", str(initrd)]
        command += ["-append", "root=/dev/vda rw console=ttyS0 quiet mitigations=off"]
        command += ["-drive", f"file={disk},format=raw,if=virtio,cache=unsafe"]
        command += ["-chardev", f"file,id=console,path={self._console}", "-device", "isa-serial,chardev=console"]
        for number, port in enumerate(serial_ports):
            command += ["-chardev", f"serial,id=serial{number},path={port}"]
            command += ["-device", f"isa-serial,chardev=serial{number}"]
        command += ["-device", "virtio-serial", "-chardev", f"socket,id=commands,path={path},server=on,wait=off"]
        command += ["-device", "virtserialport,chardev=commands,name=commands"]
        with open(folder / "qemu", "wb") as said:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        self._said = folder / "qemu"
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(PATIENCE_S)
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                self._socket.connect(str(path))
                break
            except OSError:
                assert self._process.poll() is None and time.monotonic() < until_s, self._said.read_text()
                time.sleep(0.05)

    def does(self, command: str) -> str:
        """Has a shell in the machine carry out a command that has to go well; returns what it prints."""
        code, said = self.tries(command)
        assert code == 0, f"{command}: exit code {code}: {said}"
        return said

    def tries(self, command: str) -> tuple[int, str]:
        """Has a shell in the machine carry out a command; returns its exit code and what it prints."""
        self._socket.sendall(json.dumps(command).encode() + b"\n")
        answer = b""
        while not answer.endswith(b"\n"):
            try:
                more = self._socket.recv(65536)
            except TimeoutError:
                more = b""
            assert more, f"no answer to {command}; the console says {self._console.read_bytes()[-3000:]!r}"
            answer += more
        code, said = json.loads(answer)
        return code, said

    def until(self, command: str, within_s: float = PATIENCE_S) -> str:
        """Waits until a command goes well; returns what it prints then."""
        until_s = time.monotonic() + within_s
        while True:
            code, said = self.tries(command)
            if code == 0:
                return said
            assert time.monotonic() < until_s, f"{command}: {said}"
            time.sleep(0.2)

    def close(self) -> None:
        """Switches it off."""
        self._socket.close()
        self._process.kill()
        self._process.wait()
