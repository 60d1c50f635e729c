"""Lets the tests of the page import what lies beside them, and starts agents for them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

for directory in (Path(__file__).parent, Path(__file__).parents[1] / "cli"):
    sys.path.insert(0, str(directory))

from browsing import WALK, WALKING, opened, view  # noqa: E402
from processes import Rig  # noqa: E402


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture
def faults() -> list[str]:
    """What the browser complained about."""
    return []


@pytest.fixture
def pair(rig: Rig) -> Rig:
    """Two agents that could both run the task that one of them runs."""
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    first = rig.ready("a", WALKING)
    rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    return rig


@pytest.fixture
def looking(pair: Rig, browser: Any, faults: list[str]) -> Iterator[Any]:
    yield opened(browser, view(pair), faults)
    assert faults == []


@pytest.fixture
def acting(pair: Rig, browser: Any, faults: list[str]) -> Iterator[Any]:
    yield opened(browser, view(pair, "--control"), faults)
    assert faults == []


@pytest.fixture
def touched(pair: Rig, browser: Any, faults: list[str]) -> Iterator[Any]:
    """The page on a phone with a screen that is so small that only one card is seen at a time."""
    small = {"width": 390, "height": 420}
    yield opened(browser, view(pair, "--control"), faults, viewport=small, has_touch=True, is_mobile=True)
    assert faults == []
