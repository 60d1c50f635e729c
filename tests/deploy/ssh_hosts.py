"""Hosts for tests: real SSH servers on the loopback interface, each with its own home, port and host key."""

from __future__ import annotations

import getpass
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
with_sshd = pytest.mark.skipif(
    SSHD is None or shutil.which("ssh") is None, reason="there is no SSH server here: apt install openssh-server"
)
PATIENCE_S = 20.0
INSTALLED = str(Path(sys.executable).parent)
"""A host with this on its path has Pancakes installed."""
BARE = "/usr/local/bin:/usr/bin:/bin"

ENTER = """
import ctypes, os, sys
mounts, command = sys.argv[1], sys.argv[2:]
if ctypes.CDLL(None, use_errno=True).setns(os.open(mounts, os.O_RDONLY), 0):
    sys.exit(os.strerror(ctypes.get_errno()))
os.execv(command[0], command)
"""


class SshHost:
    """One server, which has lived as long as the test needs it.

    Args:
        name: what `ssh` knows it by.
        folder: where its files are; its home is below.
        path: the variable PATH of its sessions.
        variables: further ones.
        enter: the process whose mounts it sees; 0: those of the test.
    """

    def __init__(
        self, name: str, folder: Path, path: str, variables: dict[str, str] | None = None, enter: int = 0
    ) -> None:
        assert SSHD is not None
        self.name, self.folder, self.home = name, folder, folder / "home"
        self.home.mkdir(parents=True, exist_ok=True)
        self.runtime = folder / "run"
        self.runtime.mkdir(mode=0o700, exist_ok=True)
        self.port = free_port()
        make_key(folder / "host_key")
        own = {"HOME": str(self.home), "XDG_RUNTIME_DIR": str(self.runtime), "PATH": path, **(variables or {})}
        lines = [
            f"Port {self.port}",
            "ListenAddress 127.0.0.1",
            f"HostKey {folder / 'host_key'}",
            f"AuthorizedKeysFile {folder.parent / 'user_key.pub'}",
            "PidFile none",
            "UsePAM no",
            "StrictModes no",
            "PermitRootLogin prohibit-password",
            "PrintMotd no",
            "MaxStartups 100",
            "SetEnv " + " ".join(f'"{key}={value}"' for key, value in own.items()),
        ]
        (folder / "sshd_config").write_text("\n".join(lines) + "\n")
        if os.getuid() == 0:
            Path("/run/sshd").mkdir(exist_ok=True)
        self._enter = enter
        self.process = self._start()

    @property
    def config(self) -> str:
        """Its entry in the user's configuration of `ssh`."""
        lines = {
            "HostName": "127.0.0.1",
            "Port": self.port,
            "User": getpass.getuser(),
            "IdentityFile": self.folder.parent / "user_key",
            "IdentitiesOnly": "yes",
            "UserKnownHostsFile": self.folder / "known",
            "StrictHostKeyChecking": "yes",
            "LogLevel": "ERROR",
        }
        return f"Host {self.name}\n" + "".join(f"  {key} {value}\n" for key, value in lines.items())

    @property
    def data(self) -> Path:
        """The folder of deployed files."""
        return self.home / ".local" / "share" / "pancakes"

    def _start(self) -> subprocess.Popen[bytes]:
        assert SSHD is not None
        command = [SSHD, "-D", "-e", "-f", str(self.folder / "sshd_config")]
        if self._enter:
            command = [sys.executable, "-c", ENTER, f"/proc/{self._enter}/ns/mnt", *command]
        public = (self.folder / "host_key.pub").read_text().split()[:2]
        (self.folder / "known").write_text(f"[127.0.0.1]:{self.port} {' '.join(public)}\n")
        with open(self.folder / "sshd.log", "ab") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return process
            assert process.poll() is None, (self.folder / "sshd.log").read_text()
            time.sleep(0.02)
        raise AssertionError((self.folder / "sshd.log").read_text())

    def close(self) -> None:
        """End the server; sessions that are open go on until they end."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(PATIENCE_S)


class SshHosts:
    """Some hosts, and the configuration of `ssh` with which a user of this machine reaches them."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="ph-"))  # paths of sockets have to be short
        make_key(self.folder / "user_key")
        self.hosts: dict[str, SshHost] = {}
        self.write_config()

    @property
    def ssh(self) -> str:
        """The command for `PANCAKES_SSH`."""
        return f"ssh -F {self.folder / 'ssh_config'}"

    def add(self, name: str, path: str, variables: dict[str, str] | None = None, enter: int = 0) -> SshHost:
        """Start one more."""
        folder = self.folder / name
        folder.mkdir(exist_ok=True)
        self.hosts[name] = SshHost(name, folder, path, variables, enter)
        self.write_config()
        return self.hosts[name]

    def write_config(self) -> None:
        """Write the configuration of `ssh` anew."""
        (self.folder / "ssh_config").write_text("\n".join(host.config for host in self.hosts.values()))

    def close(self) -> None:
        """End them all."""
        for host in self.hosts.values():
            host.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def make_key(path: Path) -> None:
    """Make a key for a user or a host."""
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(path)], check=True)


def free_port() -> int:
    """Return a port at which no program listens."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port
