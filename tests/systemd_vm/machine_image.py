"""A Debian for a virtual machine: its tree, which is made once and kept, and disks with a test's own files in it."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from harness.debian_packages import need

SUITE = "bookworm"
PACKAGES = ("linux-image-amd64", "systemd-sysv", "udev", "kmod", "i2c-tools", "python3-venv")
LEFT_OUT = (
    "/usr/share/doc/*",
    "/usr/share/man/*",
    "/usr/share/locale/*",
    *(f"/lib/modules/*/kernel/{part}/*" for part in ("drivers/gpu", "drivers/media", "drivers/net", "sound")),
)
"""What no test needs: half of the tree."""
DISK_BYTES = 1 << 30


def debian_tree() -> Path:
    """Returns the folder with the tree; the first call on a machine makes it, which takes two minutes."""
    if os.geteuid() != 0:
        pytest.skip("to make the disk of a virtual machine, its files must be given to root: needs root")
    program = need("mmdebstrap", "mmdebstrap")
    command = [program, "--mode=root", "--variant=minbase", f"--include={','.join(PACKAGES)}"]
    command += [f"--dpkgopt=path-exclude={pattern}" for pattern in LEFT_OUT]
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pancakes-tests" / "debian-trees"
    base.mkdir(parents=True, exist_ok=True)
    tree = base / hashlib.sha256("\n".join((*command[1:], SUITE)).encode()).hexdigest()[:16]
    with open(base / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not tree.exists():
            made = base / "made"
            shutil.rmtree(made, ignore_errors=True)
            done = subprocess.run(
                [*command, SUITE, str(made)], stdin=subprocess.DEVNULL, capture_output=True, text=True
            )
            if done.returncode != 0:
                pytest.skip(f"there is no Debian for a virtual machine: mmdebstrap says {done.stderr[-500:]}")
            made.rename(tree)
    return tree


def disk_with(tree: Path, folder: Path, files: Mapping[str, str], wheels: Sequence[Path]) -> Path:
    """Makes a disk.

    Args:
        tree: what is on it.
        folder: where it is made.
        files: texts that are on it as well, by their paths.
        wheels: of these, and of no others, an environment is made in `/opt/pancakes`.

    Returns:
        The file with the disk's file system.
    """
    root = folder / "root"
    _run("cp", "-a", "--reflink=auto", str(tree), str(root))
    for name, text in files.items():
        path = root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    inside = root / "opt" / "wheels"
    inside.mkdir()
    for wheel in wheels:
        shutil.copy(wheel, inside)
    _run("chroot", str(root), "python3", "-m", "venv", "/opt/pancakes")
    install = ("-m", "pip", "install", "--quiet", "--no-index", "--no-deps")
    _run("chroot", str(root), "/opt/pancakes/bin/python", *install, *(f"/opt/wheels/{it.name}" for it in wheels))
    disk = folder / "disk"
    with open(disk, "wb") as file:
        file.truncate(DISK_BYTES)
    _run(need("mke2fs", "e2fsprogs"), "-q", "-t", "ext4", "-d", str(root), str(disk))
    shutil.rmtree(root)
    return disk


def _run(*command: str) -> None:
    environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8"}
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, f"{' '.join(command[:4])}: {done.stderr[-2000:]}"
