"""A type checker that runs over a user's script sees the types of Pancakes."""

from __future__ import annotations

from configparser import ConfigParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_marker_of_typed_packages_is_there_and_is_packed():
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg")
    assert (ROOT / "pancakes" / "py.typed").exists()
    assert "py.typed" in parser["options.package_data"]["pancakes"].split()
