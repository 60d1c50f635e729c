"""Distributions that `pancakes new` has written, installed for the programs that a test starts."""

from __future__ import annotations

import configparser
import os
from pathlib import Path

from cli.invoked import invoked
from cli.processes import Rig
from click.testing import Result


def new(*arguments: str) -> Result:
    return invoked("new", *arguments)


class AsWritten(configparser.ConfigParser):
    """Keep capital letters in the names of options."""

    def optionxform(self, optionstr: str) -> str:
        return optionstr


def installed(folder: Path, site: Path) -> dict[str, str]:
    """Install a distribution without pip, as pip would leave it on disk; return an environment that has it."""
    parser = AsWritten(delimiters=("=",))
    parser.read(folder / "setup.cfg")
    name, version = parser["metadata"]["name"], parser["metadata"]["version"]
    points = "".join(f"[{group}]\n{lines}\n" for group, lines in parser["options.entry_points"].items())
    information = site / f"{name.replace('-', '_')}-{version}.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (information / "entry_points.txt").write_text(points)
    return {
        **{key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "PYTEST_"))},
        "PYTHONPATH": os.pathsep.join((str(folder), str(site))),
        "PANCAKES_RUNTIME_DIR": str(site / "runtime"),
        "XDG_STATE_HOME": str(site / "state"),
    }


def made(kind: str, folder: Path, rig: Rig) -> Path:
    """Write a distribution `green-house`, and start programs in its folder from now on; return that folder."""
    written = new(kind, "GreenHouse", "--into", str(folder))
    assert written.exit_code == 0, written.output
    place = folder / "green-house"
    rig.environment.update(installed(place, folder / "site"), PANCAKES_RUNTIME_DIR=str(rig.runtime))
    rig.directory = place
    return place
