"""What the page shows of docks, and of batteries that are charged, in a real browser."""

from __future__ import annotations

from typing import Any

import pytest
from web.browsing import expect, opened
from web.page_rig import Fleet
from web.samples import agent, describe, packet, world

from pancakes.devices import Battery, DockState
from pancakes.tools.web.page_server import PageServer

TROUBLE = "dock1 says that it charges, and the battery does not rise: check the dock"


@pytest.fixture
def charging(fleet: Fleet) -> Fleet:
    """A robot at a dock, whose battery it charges; another one finds that it does not."""
    model = fleet.feed.model
    lies = agent("robot2", reserve={"seconds": 41.2, "trouble": TROUBLE})
    describe(model, agent("world", role="environment"), agent("robot1"), lies, agent("dock1"))
    model.hear("world", world(1.0, robot1=(0.0, -1.0), robot2=(1.0, 0.0)), 1.0)
    model.hear("robot1", packet("robot1/device/battery", "system", "battery", Battery(7.9, 0.65, True)), 1.0)
    dock = DockState("charging", 0.0, -1.0, "robot1")
    model.hear("dock1", packet("dock1/device/dock", "system", "dock_state", dock), 1.0)
    return fleet


def test_cards_show_who_is_charged_where_and_what_is_wrong(
    charging: Fleet, server: PageServer, browser: Any, faults: list[str]
):
    page = opened(browser, server.address, faults)
    expect(page.locator("[data-agent=robot1] .battery")).to_contain_text("65 % · 7.90 V · charging")
    expect(page.locator("[data-agent=dock1] .figures")).to_contain_text("charging robot1")
    expect(page.locator("[data-agent=robot2] .figures")).to_contain_text("41 s")
    expect(page.locator("[data-agent=robot2] .figures")).to_contain_text(TROUBLE)
    assert faults == []
