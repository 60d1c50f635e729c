"""Agents and a browser for the tests of the page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig
from web.browsing import WALK, WALKING, opened, view
from web.page_rig import Fleet

from pancakes.tools.web.page import Shown, open_page
from pancakes.tools.web.page_server import PageServer


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture
def faults() -> list[str]:
    """The errors that the browser reported."""
    return []


@pytest.fixture
def pair(rig: Rig) -> Rig:
    """Two agents that could both run the task; one of them runs it."""
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
    """The page on a phone whose screen shows only one card at a time."""
    small = {"width": 390, "height": 420}
    yield opened(browser, view(pair, "--control"), faults, viewport=small, has_touch=True, is_mobile=True)
    assert faults == []


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


@pytest.fixture
def server(fleet: Fleet) -> Iterator[PageServer]:
    server = open_page(Shown(fleet.feed, fleet.explain, fleet.look, fleet.order, "a fleet"), 0)
    yield server
    server.close()


@pytest.fixture
def onlooker(fleet: Fleet) -> Iterator[PageServer]:
    """A server with read-only pages."""
    server = open_page(Shown(fleet.feed, fleet.explain, fleet.look), 0)
    yield server
    server.close()
