"""The button of the page that stops all actuators, and the line that shows it."""

from __future__ import annotations

import json
from typing import Any

from cli.processes import Rig
from web.browsing import expect, opened, view


def halted(rig: Rig) -> list[str]:
    found = [json.loads(rig.pancakes("agent", "info", name, "--format", "json").stdout)[0] for name in ("a", "b")]
    return [row["agent"] for row in found if row["halt"]]


def test_person_halts_all_agents_and_ends_it(acting: Any, pair: Rig):
    button, line = acting.get_by_role("button", name="Halt", exact=True), acting.locator("#halted")
    expect(button).to_be_visible()
    expect(line).to_be_hidden()
    button.click()
    expect(line).to_contain_text("All actuators are stopped.")
    expect(button).to_be_hidden()
    assert halted(pair) == ["a", "b"]
    end = acting.get_by_role("button", name="End the halt …")
    end.click()
    expect(acting.locator("#dialog")).to_contain_text("The actuators of a, b may move at once.")
    acting.get_by_role("button", name="Cancel").click()
    assert halted(pair) == ["a", "b"]
    end.click()
    acting.get_by_role("button", name="Let them move").click()
    expect(line).to_be_hidden()
    expect(button).to_be_visible()
    assert halted(pair) == []


def test_page_without_control_shows_a_halt(pair: Rig, browser: Any, faults: list[str]):
    assert pair.pancakes("halt", "b", "--reason", "a child").returncode == 0
    page = opened(browser, view(pair), faults)
    expect(page.locator("#halted")).to_contain_text(": a child. All actuators are stopped.")
    expect(page.locator("#halted")).to_contain_text("b: halted by")
    expect(page.get_by_role("button", name="Halt", exact=True)).to_be_hidden()
    expect(page.get_by_role("button", name="End the halt …")).to_be_hidden()
    assert faults == []
