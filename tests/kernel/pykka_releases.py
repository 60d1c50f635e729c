"""Which pykka releases there are that setup.cfg allows, and where to get one: by pip, from the index that it uses."""

import subprocess
import sys
import tarfile
from configparser import ConfigParser
from functools import cache
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PATIENCE_S = 100.0


def pip(*arguments):
    """Runs pip; returns what it prints."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    if done.returncode:
        raise OSError(f"pip {arguments[0]} failed: {done.stderr.strip()[-500:]}")
    return done.stdout


@cache
def allowed():
    """Returns the numbers of the releases that setup.cfg allows, newest first."""
    config = ConfigParser()
    config.read(ROOT / "setup.cfg")
    lines = config["options"]["install_requires"].splitlines()
    (wanted,) = (Requirement(line) for line in lines if line.startswith("pykka"))
    told = pip("index", "versions", "pykka")
    (versions,) = (line for line in told.splitlines() if line.startswith("Available versions:"))
    return list(wanted.specifier.filter(version.strip() for version in versions.partition(":")[2].split(",")))


def unpacked_sdist(version, folder):
    """Fetches a release's source distribution; returns the folder that it holds."""
    pip("download", "--quiet", "--no-deps", "--no-binary", "pykka", "--dest", folder, f"pykka=={version}")
    (archive,) = Path(folder).glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        opened.extractall(folder, filter="data")
    return Path(folder) / archive.name.removesuffix(".tar.gz")
