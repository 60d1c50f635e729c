"""Builds, checks and tries what is released: the project and its plug-ins. Needs nothing but Python.

Built are the files of the commit, and nothing else of the clone; where no tag `vVERSION` is on it, `pancakes --version`
names it. Each wheel is built from its source distribution, so both have all that belongs to them. They are checked
(metadata, versions, licence, contents), installed into an empty environment of each supported Python that this machine
has, and the demos that they bring are run there in virtual time, in an empty folder: nothing of this clone is in reach.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from environment import ROOT, make_venv, run, say
from release_checks import faults_of, packaged

TOOLS = ("build>=1", "setuptools>=68", "wheel", "twine>=5")
PYTHONS = ("3.11", "3.12", "3.13")
"""The versions of Python that are supported."""
NEXT_PYTHON = "3.14"
"""The one to come: tried, and no fault where what Pancakes requires cannot be had for it."""
PYENV = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"


def main() -> None:
    """Builds, checks and tries."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="where they go; dist/ in the clone if left out")
    parser.add_argument("--demos", metavar="DEMO", nargs="+", default=[], help="run these demos; all if left out")
    parser.add_argument("--this-python", action="store_true", help="try them with the Python of this script alone")
    options = parser.parse_args()
    out = options.out.absolute()
    with tempfile.TemporaryDirectory() as made:
        place = Path(made)
        wheels = build(place, out)
        here = sys.version_info[:2]
        pythons = {f"{here[0]}.{here[1]}": sys.executable} if options.this_python else found_pythons()
        for version, python in pythons.items():
            try_out(place / version, version, python, wheels, options.demos)
    print(*wheels, sep="\n")


def build(place: Path, out: Path) -> list[Path]:
    """Builds and checks everything; returns the wheels."""
    source, venv = place / "source", place / "builder"
    commit = export(source)
    say(f"building {commit or 'the release'} into {out}")
    make_venv(venv)
    install(venv, *TOOLS)
    python, fresh = str(venv / "bin" / "python"), place / "dist"
    roots = (source, *(path.parent for path in sorted((source / "plugins").glob("*/setup.cfg"))))
    for root in roots:
        command = [python, "-m", "build", "--no-isolation", "--outdir", str(fresh), str(root)]
        quietly(command, f"{root.relative_to(place)} could not be built")
    wheels, sdists = sorted(fresh.glob("*.whl")), sorted(fresh.glob("*.tar.gz"))
    quietly([python, "-m", "twine", "check", "--strict", *map(str, (*wheels, *sdists))], "the metadata is not sound")
    sources = [it for root in roots for it in packaged(root, [path.parent.name for path in root.glob("*/__init__.py")])]
    if faults := faults_of(wheels, sdists, sources):
        sys.exit("\n".join(["what was built is not fit for a release:", *faults]))
    out.mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copy(path, out)) for path in (*wheels, *sdists)][: len(wheels)]


def export(place: Path) -> str:
    """Takes the files of the commit, or of a folder that is no clone; returns what is built, empty: a release."""
    if not (ROOT / ".git").exists():
        say("this is no clone: all that lies here is taken, and no commit is named")
        shutil.copytree(
            ROOT, place, symlinks=True, ignore=shutil.ignore_patterns(".venv", "dist", "runs", "*.egg-info")
        )
        return ""
    if git("status", "--porcelain", "--untracked-files=no"):
        say("changes that are not committed are left out")
    archive = subprocess.run(["git", "-C", str(ROOT), "archive", "HEAD"], stdout=subprocess.PIPE, check=True).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as files:
        files.extractall(place, filter="tar")
    version = re.search(r'__version__ = "(.+)"', (place / "pancakes" / "__init__.py").read_text())
    if version is not None and f"v{version[1]}" in git("tag", "--points-at", "HEAD").split():
        return ""
    commit = git("rev-parse", "--short=12", "HEAD")
    (place / "pancakes" / "commit.txt").write_text(f"{commit}\n")
    return f"the commit {commit}"


def git(*arguments: str) -> str:
    """Asks git about the clone."""
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def found_pythons() -> dict[str, str]:
    """Returns the Pythons of this machine that are supported, by version; says which are left out."""
    found = {}
    for version in (*PYTHONS, NEXT_PYTHON):
        places = [f"python{version}", *map(str, sorted(PYENV.glob(f"{version}.*/bin/python{version}"), reverse=True))]
        python = next((place for place in places if makes_environments(place)), None)
        if python is not None:
            found[version] = python
        else:
            say(f"Python {version} is left out: this machine has none that makes environments")
    return found


def makes_environments(python: str) -> bool:
    """Whether there is such a Python, and pip comes with it."""
    try:
        return subprocess.run([python, "-c", "import venv, ensurepip"], capture_output=True).returncode == 0
    except OSError:
        return False


def try_out(place: Path, version: str, python: str, wheels: Sequence[Path], demos: Sequence[str]) -> None:
    """Installs wheels as a user would, and runs demos from them; ends the script where one of them fails."""
    say(f"installing them into an empty environment of Python {version}")
    venv, folder = place / "venv", place / "empty"
    folder.mkdir(parents=True)
    run([python, "-m", "venv", str(venv)], "no virtual environment could be made")
    if version == NEXT_PYTHON and not succeeds_to_install(venv, wheels):
        say(f"Python {version} is left out: what Pancakes requires cannot be installed for it yet")
        return
    install(venv, *map(str, wheels))
    pancakes = str(venv / "bin" / "pancakes")
    # What the caller's shell says about Python and about running agents is none of the user's.
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "PYTHON"))}

    def output(*command: str) -> str:
        found = subprocess.run([pancakes, *command], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)
        if found.returncode:
            print(found.stdout, file=sys.stderr)
            sys.exit(f"`pancakes {' '.join(command)}` failed from the wheels: it ended with {found.returncode}.")
        return found.stdout

    say(output("--version").strip())
    listed = output("demo", "--list").splitlines()
    there = [line.split()[0] for line in listed if not line.endswith("(live only)")]
    if not there:
        sys.exit("the wheels bring no demos")
    for demo in demos or there:
        say(f"running {demo}")
        output("demo", demo, "--virtual", "--headless")


def succeeds_to_install(venv: Path, wheels: Sequence[Path]) -> bool:
    """Whether wheels and what they require can be installed."""
    command = [*pip(venv), "--only-binary=:all:", *map(str, wheels)]
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0


def install(venv: Path, *what: str) -> None:
    """Installs packages into an environment."""
    run([*pip(venv), *what], "the installation failed")


def pip(venv: Path) -> list[str]:
    """Returns the beginning of a command that installs into an environment."""
    python = str(venv / "bin" / "python")
    return [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]


def quietly(command: list[str], fault: str) -> None:
    """Runs a command, and shows what it said only where it fails, which ends the script."""
    found = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if found.returncode:
        print(found.stdout, file=sys.stderr)
        sys.exit(f"{fault}: `{' '.join(command)}` ended with {found.returncode}.")


if __name__ == "__main__":
    main()
