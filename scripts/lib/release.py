"""Build, check and try a release: the project and its plug-ins. Needs only Python.

Only the files of the commit are built. If the commit has no tag `vVERSION`, `pancakes --version` shows the commit. Each
wheel is built from its source distribution, so both are complete. They are checked (metadata, versions, licence,
contents), and put into a package index on this machine, with all that they require. From there they are installed by
name into an empty environment of each supported Python, without another index. The demos in them are run there in
virtual time, in an empty folder, without access to this clone.
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
from urllib.parse import quote

from environment import ROOT, make_venv, run, say
from release_checks import faults_of, packaged

TOOLS = ("build>=1", "setuptools>=68", "wheel", "twine>=5")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
"""The versions of Python that are supported."""
NEXT_PYTHON = "3.15"
"""The next Python: it is tried, but may be skipped if the requirements of Pancakes are not available for it."""
PYENV = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"


def main() -> None:
    """Build, check and try a release."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="output folder (default: dist/ in the clone)")
    parser.add_argument("--demos", metavar="DEMO", nargs="+", default=[], help="run only these demos (default: all)")
    parser.add_argument("--this-python", action="store_true", help="try only the Python that runs this script")
    parser.add_argument("--container", action="store_true", help="only build the container of an agent, and run one")
    options = parser.parse_args()
    if options.container:
        try_container()
        return
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
    """Build and check everything; return the wheels."""
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
    quietly([python, "-m", "twine", "check", "--strict", *map(str, (*wheels, *sdists))], "the metadata is invalid")
    sources = [it for root in roots for it in packaged(root, [path.parent.name for path in root.glob("*/__init__.py")])]
    if faults := faults_of(wheels, sdists, sources):
        sys.exit("\n".join(["the built files are not fit for a release:", *faults]))
    out.mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copy(path, out)) for path in (*wheels, *sdists)][: len(wheels)]


def export(place: Path) -> str:
    """Copy the files of the commit, or of a folder without git; return the name of the build, empty: a release."""
    if not (ROOT / ".git").exists():
        say("this folder is not a git clone: all of its files are used, without the name of a commit")
        shutil.copytree(
            ROOT, place, symlinks=True, ignore=shutil.ignore_patterns(".venv", "dist", "runs", "*.egg-info")
        )
        return ""
    if git("status", "--porcelain", "--untracked-files=no"):
        say("uncommitted changes are left out")
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
    """Ask git about the clone."""
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def found_pythons() -> dict[str, str]:
    """Return the supported Pythons of this machine, by version; print which are skipped."""
    found = {}
    for version in (*PYTHONS, NEXT_PYTHON):
        places = [f"python{version}", *map(str, sorted(PYENV.glob(f"{version}.*/bin/python{version}"), reverse=True))]
        python = next((place for place in places if makes_environments(place)), None)
        if python is not None:
            found[version] = python
        else:
            say(f"Python {version} is skipped: this machine has none that can make virtual environments")
    return found


def makes_environments(python: str) -> bool:
    """Return whether this Python exists and can make environments with pip."""
    try:
        return subprocess.run([python, "-c", "import venv, ensurepip"], capture_output=True).returncode == 0
    except OSError:
        return False


def try_out(place: Path, version: str, python: str, wheels: Sequence[Path], demos: Sequence[str]) -> None:
    """Install wheels as a user would, and run demos from them; end the script if one of them fails."""
    say(f"installing them from an index of their own into an empty environment of Python {version}")
    venv, folder = place / "venv", place / "empty"
    folder.mkdir(parents=True)
    run([python, "-m", "venv", str(venv)], "no virtual environment could be made")
    files = place / "files"
    if not succeeds_to_download(venv, wheels, files):
        if version != NEXT_PYTHON:
            sys.exit(f"what the wheels require could not be downloaded for Python {version}")
        say(f"Python {version} is skipped: the requirements of Pancakes cannot be installed for it yet")
        return
    index = make_index(files, place / "simple")
    install(venv, *sorted({name_of(wheel) for wheel in wheels}), index=index)
    pancakes = str(venv / "bin" / "pancakes")
    # A user would not have this shell's variables about Python and about running agents.
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
        sys.exit("the wheels have no demos")
    for demo in demos or there:
        say(f"running {demo}")
        output("demo", demo, "--virtual", "--headless")


AGENT = """
schema = 1
[agent]
name = "boxed"
listen = "local://boxed"
[device.load]
driver = "host.load"
rate_hz = 1
"""


def try_container() -> None:
    """Build the container of an agent, and run an agent in it until it is ready and was stopped."""
    tool = next((it for it in ("docker", "podman") if can_run_containers(it)), None)
    if tool is None:
        sys.exit("this machine has neither docker nor podman that answers: the container is not tried")
    image = "pancakes-agent"
    run([tool, "build", "-f", str(ROOT / "scripts" / "Containerfile"), "-t", image, str(ROOT)], "it could not be built")
    with tempfile.TemporaryDirectory() as made:
        file = Path(made) / "agent.toml"
        file.write_text(AGENT)
        mounted = ["--rm", "--init", "-v", f"{file}:/etc/pancakes/agent.toml:ro"]
        command = [tool, "run", *mounted, "--entrypoint", "timeout", image]
        # The program ends by SIGTERM after some seconds, gracefully, so its code is 0.
        agent = ["--preserve-status", "5", "pancakes-agent", "--config", "/etc/pancakes/agent.toml"]
        found = subprocess.run([*command, *agent], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if found.returncode or "boxed/kernel: ready" not in found.stdout:
        sys.exit(f"{found.stdout}\nthe agent in the container ended with {found.returncode}")
    say(f"an agent ran in a container of {tool}")


def can_run_containers(tool: str) -> bool:
    """Return whether a container tool is there, with what it needs."""
    try:
        return subprocess.run([tool, "info"], capture_output=True).returncode == 0
    except OSError:
        return False


def succeeds_to_download(venv: Path, wheels: Sequence[Path], files: Path) -> bool:
    """Return whether wheels, and all that they require, could be put into a folder."""
    options = ["--dest", str(files), "--only-binary=:all:"]
    command = [*pip(venv, "download"), *options, *map(str, wheels)]
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL).returncode == 0


def make_index(files: Path, index: Path) -> str:
    """Make a package index of a folder with wheels, as a simple repository (PEP 503); return its address."""
    for file in sorted(files.glob("*.whl")):
        page = index / name_of(file) / "index.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, page.parent)
        with page.open("a") as lines:
            lines.write(f'<!DOCTYPE html><a href="{quote(file.name)}">{file.name}</a>\n')
    return index.as_uri()


def name_of(wheel: Path) -> str:
    """Return the name of a wheel's distribution, as an index spells it."""
    return re.sub(r"[-_.]+", "-", wheel.name.partition("-")[0]).lower()


def install(venv: Path, *what: str, index: str = "") -> None:
    """Install packages into an environment; `index`: the only index that is asked."""
    only = ["--isolated", "--index-url", index] if index else []
    run([*pip(venv), *only, *what], "the installation failed")


def pip(venv: Path, verb: str = "install") -> list[str]:
    """Return the beginning of a command of pip."""
    python = str(venv / "bin" / "python")
    return [python, "-m", "pip", verb, "--quiet", "--disable-pip-version-check", "--no-input"]


def quietly(command: list[str], fault: str) -> None:
    """Run a command; if it fails, print its output and end the script."""
    found = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if found.returncode:
        print(found.stdout, file=sys.stderr)
        sys.exit(f"{fault}: `{' '.join(command)}` ended with {found.returncode}.")


if __name__ == "__main__":
    main()
