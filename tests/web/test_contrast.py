"""All text on the page can be read, and its controls and graphics can be told apart, in light and in dark mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from web.browsing import PHONE, chip, expect, opened
from web.page_rig import Fleet
from web.samples import agent, describe, packet, record, task, world

from pancakes.client.rates import RateMeter
from pancakes.control import Reply
from pancakes.devices import Battery, Motion
from pancakes.tools.web.page_server import PageServer

MEASURE = (Path(__file__).parent / "contrast.js").read_text().partition("\n")[2]
DRAWN = """
window.written = new Map();
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
  // The texts of messages stand on a bubble of their own.
  if (this.canvas.id && this.globalAlpha === 1) window.written.set(text, this.fillStyle);
  return write.call(this, text, ...rest);
};
"""
"""Notes the colours of all texts on canvases."""
NAMES = [f"robot{number}" for number in range(10)]
SCHEMA = {
    "properties": {
        "step_m": {"type": "number", "minimum": 0.1, "maximum": 2, "description": "how far it goes at once"},
        "gait": {"enum": ["trot", "pace"]},
        "careful": {"type": "boolean"},
        "route": {"type": "array"},
    }
}


@pytest.fixture
def colourful(fleet: Fleet) -> Fleet:
    """A fleet of eleven agents, so that each colour occurs, with all kinds of events and states of tasks."""
    model, rates = fleet.feed.model, RateMeter()
    for second in range(20):
        fleet.t = float(second)
        states = ("running", "stopped", "failed", "stuck", "restarting")
        rows = []
        for name in NAMES:
            tasks = [task(name, state.title(), state=state, rate_hz=10.0, ticks=5 * second) for state in states]
            peers: dict[str, float | None] = {other: 0.001 for other in NAMES if other != name}
            rows.append(
                agent(
                    name, *tasks, peers=peers, mission_s=fleet.t, battery_level=0.2, insecure="no keys", dead_letters=3
                )
            )
            model.hear(name, packet(f"{name}/device/battery", "system", "battery", Battery(7.1, 0.2)), fleet.t)
        places = {name: (0.4 * number - 2.0, 0.1 * second) for number, name in enumerate(NAMES)}
        model.hear("w", world(fleet.t, **places), fleet.t)
        model.hear("robot1", packet("robot1/device/motion", "system", "motion", Motion(True, 0.1, 0.5)), fleet.t)
        described = [*rows, agent("w", role="environment", mission_s=fleet.t)]
        described.append(agent("gone", task("gone", "Lost"), mission_s=fleet.t))
        describe(model, *described, t=fleet.t, rates=rates)
        fleet.feed.record()
    model.describe([{"agent": "gone", "role": "agent", "state": "no answer"}], [], fleet.t)
    happened: dict[str, dict[str, Any]] = {
        "migration_asked": {"task": "Running"},
        "migration_bid": {"task": "Running", "cost": 1.0},
        "migration_refused": {"task": "Running", "reason": "lacks motors"},
        "migration": {"task": "Running", "outcome": "moved", "winner": "robot2", "lines": []},
        "task_failed": {"task": "Failed", "reason": "it broke"},
        "on_circle": {"radius_m": 0.5},
    }
    for number, (kind, fields) in enumerate(happened.items()):
        model.tell(record(NAMES[number], kind, 10.0 + number, **fields), 10.0 + number)
    for level in ("info", "warning", "error"):
        for number in range(3):
            model.tell(record("robot9", "line", 17.0 + number, level=level, text=f"a {level}"), 17.0 + number)
    fleet.feed.record()
    description = {
        "service": "client", "task": "Running", "settings_schema": SCHEMA,
        "state": {"steps": 3, "centre_m": [0.123456, 1.0]},
        "settings": {"step_m": 0.5, "gait": "trot", "careful": True, "route": [1, 2]},
        "timers": [{"timer": "tick", "rate_hz": 10.0, "ticks": 3, "missed": 0}],
    }  # fmt: skip
    fleet.looks = {True: Reply(None, description)}
    return fleet


def measured(page: Any) -> dict[str, Any]:
    page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    found: dict[str, Any] = page.evaluate(MEASURE)
    return found


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_and_graphics_have_contrast(
    colourful: Fleet, server: PageServer, browser: Any, faults: list[str], scheme: str
):
    context = browser.new_context(viewport={"width": 1440, "height": 1400}, color_scheme=scheme)
    context.add_init_script(DRAWN)
    page = context.new_page()
    page.goto(f"{server.address}&find=&plot=robot1+late_ms")
    for name in ("All", "News"):
        page.locator("#filter label", has_text=name).click()
    expect(page.locator(".legend li")).to_have_count(1)
    found = measured(page)
    assert found["poor"] == [] and found["texts"] > 200 and found["graphics"] > 40 and found["drawn"] > 10

    # What opens: a task with its settings, the search, the picker, the mesh, the help.
    page.locator(".agents summary").first.click()
    chip(page, "robot1", "Running").get_by_role("button").click()
    form = page.get_by_role("form", name="Settings")
    form.get_by_role("spinbutton").fill("7")
    form.get_by_role("button", name="Check").click()
    page.get_by_role("searchbox", name="Search agents").fill("robot1")
    page.get_by_role("combobox", name="Plot a number").fill("battery")
    expect(page.get_by_role("listbox").get_by_role("option").first).to_be_visible()
    page.keyboard.press("ArrowDown")
    page.evaluate("() => window.written.clear()")
    page.locator("label", has_text="Mesh").click()
    page.wait_for_function("() => window.written.size > 5")
    assert measured(page)["poor"] == []
    page.get_by_role("button", name="Keys and hints").click()
    assert measured(page)["poor"] == []
    page.keyboard.press("Escape")
    page.get_by_role("slider", name="Time").fill("5")
    expect(page.locator("#status")).to_have_text("past")
    assert measured(page)["poor"] == []
    assert faults == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_phone_and_empty_page_have_contrast(
    fleet: Fleet, server: PageServer, browser: Any, faults: list[str], scheme: str
):
    fleet.feed.wait_for("no agent runs on this machine")
    page = opened(browser, server.address, faults, viewport=PHONE, color_scheme=scheme)
    expect(page.get_by_role("heading", name="No agents yet")).to_be_visible()
    assert measured(page)["poor"] == []
    server.close()
    expect(page.locator("#status")).to_have_text("no server")
    assert measured(page)["poor"] == []
