"""Builds the source distributions and the wheels of the project and of its plug-ins. Needs nothing but Python.

Each wheel is built from its source distribution, so both have all that belongs to them, or the build is of no use. With
`--try` the wheels, and what they require, are installed into a new environment, and the demos that they bring are run
there in virtual time, in an empty folder: nothing of this clone is in reach.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from environment import ROOT, make_venv, run, say

PLUGINS = tuple(path.parent for path in sorted((ROOT / "plugins").glob("*/setup.cfg")))
TOOLS = ("build>=1", "setuptools>=68", "wheel")


def main() -> None:
    """Builds, and tries what was built where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="where they go; dist/ in the clone if left out")
    parser.add_argument("--try", dest="demos", metavar="DEMO", nargs="*", help="run these demos from them; none: all")
    options = parser.parse_args()
    out = options.out.absolute()
    with tempfile.TemporaryDirectory() as made:
        place = Path(made)
        wheels = build(place / "builder", out)
        if options.demos is not None:
            try_out(place / "user", wheels, options.demos)
    print(*wheels, sep="\n")


def build(venv: Path, out: Path) -> list[Path]:
    """Builds everything; returns the wheels."""
    say(f"building into {out}")
    make_venv(venv)
    install(venv, *TOOLS)
    wheels = []
    for root in (ROOT, *PLUGINS):
        before = {path: path.stat().st_mtime_ns for path in out.glob("*.whl")}
        command = [str(venv / "bin" / "python"), "-m", "build", "--no-isolation", "--outdir", str(out), str(root)]
        quietly(command, f"{root} could not be built")
        wheels += [path for path in sorted(out.glob("*.whl")) if before.get(path) != path.stat().st_mtime_ns]
    return wheels


def try_out(place: Path, wheels: Sequence[Path], demos: Sequence[str]) -> None:
    """Installs wheels as a user would, and runs demos from them; ends the script where one of them fails."""
    say("installing them into an empty environment")
    venv, folder = place / "venv", place / "empty"
    make_venv(venv)
    folder.mkdir()
    install(venv, *map(str, wheels))
    pancakes = str(venv / "bin" / "pancakes")
    # What the caller's shell says about Python and about running agents is none of the user's.
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "PYTHON"))}
    listed = subprocess.run(
        [pancakes, "demo", "--list"], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    )
    there = [line.split()[0] for line in listed.stdout.splitlines()]
    if listed.returncode or not there:
        sys.exit("the wheels bring no demos")
    for demo in demos or there:
        say(f"running {demo}")
        command = [pancakes, "demo", demo, "--virtual", "--headless"]
        found = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)
        if found.returncode:
            print(found.stdout, file=sys.stderr)
            sys.exit(f"the demo {demo} failed from the wheels: `{' '.join(command)}` ended with {found.returncode}.")


def install(venv: Path, *what: str) -> None:
    """Installs packages into an environment."""
    pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]
    run([*pip, *what], "the installation failed")


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
