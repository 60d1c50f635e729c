"""Lets the tests of the page import what lies beside them, and starts agents for them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

for directory in (Path(__file__).parent, Path(__file__).parents[1] / "cli"):
    sys.path.insert(0, str(directory))

from processes import Rig  # noqa: E402


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()
