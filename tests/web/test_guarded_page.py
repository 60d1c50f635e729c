"""A guarded task on the page: its guardians, the age of their checkpoints, its permit, and that it is paused."""

from __future__ import annotations

import re
from typing import Any

from cli.processes import Rig, Running
from web.browsing import WALK, WALKING, chip, expect, opened, view

GUARDED = WALKING + 'guard = { copies = 3, lease_s = 2.0, checkpoint_s = 0.2, guardians = ["b", "c"] }\n'


def guarding(rig: Rig) -> tuple[Running, Running]:
    """Start a, b and c, which guard the task on a; return b and c."""
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    others = rig.ready("b"), rig.ready("c")
    peers = ", ".join(f'"{rig.address(other)}"' for other in others)
    rig.ready("a", GUARDED, agent=f"peers = [{peers}]").hear("a/Walk will be guarded by a, b, c")
    return others


def test_guarded_task_on_the_page_is_shown_paused(rig: Rig, browser: Any, faults: list[str]):
    b, c = guarding(rig)
    page = opened(browser, view(rig), faults)
    walk = chip(page, "a", "Walk")
    guards = walk.locator(".guards")
    expect(guards).to_have_text(re.compile(r"^guarded by a \d\.\d s · b \d\.\d s · c \d\.\d s · permit \d\.\d s$"))
    expect(guards).not_to_have_class(re.compile("warn"))
    walk.get_by_role("button").click()
    facts = page.get_by_role("dialog")
    expect(facts).to_contain_text("guardians")
    expect(facts).to_contain_text("permit")
    expect(facts).to_contain_text("old at more than half of them")
    page.keyboard.press("Escape")
    for other in (b, c):
        other.process.kill()
    expect(guards).to_have_text(re.compile(r"b \(silent\) · c \(silent\) · no permit$"))
    expect(guards).to_have_class(re.compile("warn"))
    expect(walk.locator(".notes")).to_have_text("paused")
    expect(page.locator("#events").get_by_text("Walk is paused on a: its guardians do not answer")).to_be_visible()
    assert faults == []
