"""Wheels that are built from the installed packages."""

from __future__ import annotations

import zipfile
from importlib.metadata import distributions
from pathlib import Path

import pytest

from pancakes.tools.deploy.wheels import distribution_of, installed_wheels

OF_TWO = ("pancakes-agents", "pancakes-encirclement")
"""What is built here: `scripts/release` builds all."""


def test_wheels_of_installed_packages_are_built_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    two = [it for it in distributions() if it.metadata["Name"] in OF_TWO]
    monkeypatch.setattr("pancakes.tools.deploy.wheels.distributions", lambda: two)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("one", "two", "three"):
        (tmp_path / name).mkdir()
    wheels = installed_wheels(tmp_path / "one")
    assert {distribution_of(wheel) for wheel in wheels} == set(OF_TWO)
    (own,) = [wheel for wheel in wheels if distribution_of(wheel) == "pancakes-agents"]
    with zipfile.ZipFile(own.path) as archive:
        assert "pancakes/tools/remote_host/agent_supervisor.py" in archive.namelist()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    again = installed_wheels(tmp_path / "two")
    assert [(wheel.name, wheel.digest) for wheel in again] == [(wheel.name, wheel.digest) for wheel in wheels]
    monkeypatch.setattr("sys.executable", "/no/such/python")
    assert [wheel.digest for wheel in installed_wheels(tmp_path / "three")] == [wheel.digest for wheel in wheels]
