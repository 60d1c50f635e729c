"""What the tests of this directory have in common."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def runtime_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keeps the test's clients from the agents of whoever runs the tests."""
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "runtime"))
    yield
