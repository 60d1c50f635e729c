"""Wheels that are built of what is installed here."""

from __future__ import annotations

import zipfile
from pathlib import Path

from pancakes.tools.deploy.wheels import distribution_of, installed_wheels


def test_wheels_are_made_of_what_is_installed(tmp_path: Path):
    wheels = installed_wheels(tmp_path)
    assert {distribution_of(wheel) for wheel in wheels} >= {"pancakes-agents", "pancakes-encirclement"}
    (own,) = [wheel for wheel in wheels if distribution_of(wheel) == "pancakes-agents"]
    with zipfile.ZipFile(own.path) as archive:
        assert "pancakes/tools/there/own_supervisor.py" in archive.namelist()
