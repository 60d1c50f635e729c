"""Names of hosts of a test's own: programs that see another /etc/hosts, in a namespace of their own."""

from __future__ import annotations

import shutil
import subprocess
from functools import cache
from pathlib import Path

_ENTER = ["unshare", "--map-root-user", "--mount", "sh", "-c", 'mount --bind "$0" /etc/hosts && exec "$@"']


@cache
def may_have_hosts() -> bool:
    """Returns whether this machine lets its users have a namespace of their own."""
    return shutil.which("unshare") is not None and not subprocess.run([*_ENTER, "/dev/null", "true"]).returncode


def with_hosts(directory: Path, hosts: dict[str, str]) -> list[str]:
    """Returns what is put before a command so that names of hosts lead to these numbers for it."""
    file = directory / "hosts"
    file.write_text("".join(f"{number} {name}\n" for name, number in {"localhost": "127.0.0.1", **hosts}.items()))
    return [*_ENTER, str(file)]
