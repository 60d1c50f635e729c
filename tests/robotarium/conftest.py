"""What tests of the Robotarium need: its simulator, which no one here wrote."""

from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture
def robotarium() -> Any:
    """The class of its simulator. Each test that needs it comes through here, and says so if it is missing."""
    module = pytest.importorskip("rps.robotarium", reason="robotarium-python-simulator is not installed")
    return module.Robotarium
