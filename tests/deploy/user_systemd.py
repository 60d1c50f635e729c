"""A real systemd that manages the services of one user, in its own mount namespace: PID 1 may be anything."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from deploy.ssh_hosts import ENTER, PATIENCE_S

SYSTEMD = Path("/lib/systemd/systemd")
RUNTIME = "/run/user/0"
BEGIN = """
set -e
for place in /sys/fs/cgroup/systemd /sys/fs/cgroup/unified /sys/fs/cgroup; do
    if [ -w $place/cgroup.procs ]; then mkdir -p $place/$1; echo $$ >$place/$1/cgroup.procs; fi
done
mount --make-rprivate /
mount -t tmpfs tmpfs /run
mkdir -p /run/systemd/system /run/sshd /run/user/0
chmod 700 /run/user/0
exec /lib/systemd/systemd --user --log-target=console
"""


class UserSystemd:
    """It runs until it is closed; `pid` is its process, whose mounts a program has to see that speaks to it.

    Args:
        home: the home of its user.
    """

    def __init__(self, home: Path) -> None:
        if os.getuid() != 0 or not SYSTEMD.exists() or shutil.which("unshare") is None:
            pytest.skip("a systemd of one's own needs root, systemd and unshare")
        self._group = f"pancakes-test-{os.getpid()}"
        self.environment = {"HOME": str(home), "XDG_RUNTIME_DIR": RUNTIME, "PATH": os.environ["PATH"]}
        self._log = home / "systemd.log"
        with open(self._log, "wb") as log:
            self._process = subprocess.Popen(
                ["unshare", "--mount", "sh", "-c", BEGIN, "sh", self._group],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self.environment,
            )
        self.pid = self._process.pid
        until_s = time.monotonic() + PATIENCE_S
        while self._systemctl("is-system-running").stdout.strip() not in ("running", "degraded"):
            if self._process.poll() is not None or time.monotonic() > until_s:
                said = self._log.read_text()
                self.close()
                pytest.skip(f"systemd does not run for a user here: {said[-300:]}")
            time.sleep(0.05)

    def _systemctl(self, *words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", ENTER, f"/proc/{self.pid}/ns/mnt", "/usr/bin/systemctl", "--user", *words]
        return subprocess.run(command, env=self.environment, capture_output=True, text=True)

    def close(self) -> None:
        """End it, and the services that it runs."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        until_s = time.monotonic() + PATIENCE_S
        for place in ("systemd", "unified", ""):
            folder = Path("/sys/fs/cgroup") / place / self._group
            while folder.exists() and time.monotonic() < until_s:  # the kernel takes its time after a process has ended
                for inner in sorted(folder.glob("**/"), reverse=True):
                    with contextlib.suppress(OSError):
                        inner.rmdir()
