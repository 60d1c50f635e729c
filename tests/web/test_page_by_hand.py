"""A person migrates, stops and changes tasks on the page in a real browser: by mouse, by touch, by keyboard."""

from __future__ import annotations

import re
from typing import Any

from web.browsing import chip, drag, expect, middle


def test_drag_migrates_a_task_after_a_dry_run(acting: Any):
    expect(acting.locator("body.control")).to_have_count(1)
    expect(chip(acting, "a", "Walk")).to_have_attribute("data-state", "running")
    expect(acting.locator("[data-agent=a] .links")).to_have_text(re.compile("links: b"))
    drag(acting, chip(acting, "a", "Walk"), acting.locator("[data-agent=b]"))

    dialog = acting.get_by_role("dialog")
    expect(dialog).to_contain_text("Move Walk from a to b?")
    expect(dialog).to_contain_text("no other agent was asked. Nothing has been moved yet")
    expect(dialog.locator("tbody tr")).to_have_text([re.compile(r"b\s*bids\s*0")])
    expect(chip(acting, "a", "Walk")).to_have_attribute("data-state", "running")
    expect(chip(acting, "b", "Walk")).to_have_count(0)

    dialog.get_by_role("button", name="Move it to b").click()
    expect(chip(acting, "b", "Walk")).to_have_attribute("data-state", "running")
    expect(dialog).to_have_count(0)
    expect(acting.locator("#events").get_by_text("Walk moved to b (only b was asked)")).to_be_visible()
    expect(acting.locator("#events").get_by_text("a asks only b to take Walk").first).to_be_visible()


def test_task_is_controlled_by_touch(touched: Any):
    walk = chip(touched, "a", "Walk")
    expect(walk).to_have_attribute("data-state", "running")
    expect(touched.locator("[data-agent=a] .links")).to_have_text(re.compile("links: b"))

    # It is changed by tapping.
    walk.get_by_role("button").tap()
    dialog = touched.get_by_role("dialog")
    rates = dialog.get_by_role("form", name="Rates")
    rates.get_by_role("spinbutton", name="step Hz").fill("9")
    rates.get_by_role("button", name="Apply").tap()
    expect(rates.get_by_role("status")).to_have_text("set: step")
    dialog.get_by_role("button", name="Stop").tap()
    expect(dialog).to_contain_text("it has stopped")
    dialog.get_by_role("button", name="Close").tap()
    expect(walk).to_have_attribute("data-state", "stopped")
    walk.get_by_role("button").tap()
    dialog.get_by_role("button", name="Start").tap()
    expect(walk).to_have_attribute("data-state", "running")
    dialog.get_by_role("button", name="Close").tap()

    # Elsewhere than on its grip a finger scrolls, and moves nothing.
    finger = touched.context.new_cdp_session(touched)

    def touch(kind: str, *points: dict[str, float]) -> None:
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    walk.scroll_into_view_if_needed()
    at = middle(walk)
    touch("touchStart", at)
    for step in range(1, 8):
        touch("touchMove", {"x": at["x"], "y": at["y"] - 15 * step})
    touch("touchEnd")
    expect(touched.locator(".ghost")).to_have_count(0)
    expect(dialog).to_have_count(0)
    touched.evaluate("""() => new Promise((still) => {
      let before = NaN;
      const look = () => (scrollY === before ? still() : ((before = scrollY), setTimeout(look, 150)));
      look();
    })""")

    # By its grip it is dragged, and the page goes along at its edge, until the other agent is there.
    touched.locator("[data-agent=a]").evaluate("(card) => card.scrollIntoView({block: 'end'})")
    at = middle(walk.locator(".grip"))
    touch("touchStart", at)
    for step in range(1, 11):
        touch("touchMove", {"x": at["x"] - 10 * step, "y": at["y"] + (412 - at["y"]) * step / 10})
    expect(touched.locator("[data-agent=b].target")).to_have_count(1)
    touch("touchEnd")
    expect(dialog).to_contain_text("Move Walk from a to b?")
    # Not tapped: so soon after a finger was lifted Chromium makes no click of it; no person is that quick.
    dialog.get_by_role("button", name="Move it to b").click()
    expect(chip(touched, "b", "Walk")).to_have_attribute("data-state", "running")


def test_escape_cancels_a_drag(acting: Any):
    walk = chip(acting, "a", "Walk")
    expect(walk).to_have_attribute("data-state", "running")
    at = middle(walk)
    acting.mouse.move(at["x"], at["y"])
    acting.mouse.down()
    target = middle(acting.locator("[data-agent=b]"))
    acting.mouse.move(target["x"], target["y"], steps=5)
    expect(acting.locator("[data-agent=b].target")).to_have_count(1)
    acting.keyboard.press("Escape")
    expect(acting.locator(".ghost")).to_have_count(0)
    acting.mouse.up()
    expect(acting.get_by_role("dialog")).to_have_count(0)


def test_task_is_controlled_by_keyboard(acting: Any):
    walk = chip(acting, "a", "Walk")
    expect(walk).to_have_attribute("data-state", "running")
    expect(acting.locator("[data-agent=a] .links")).to_have_text(re.compile("links: b"))
    walk.get_by_role("button").focus()
    acting.keyboard.press("Enter")
    dialog = acting.get_by_role("dialog")
    dialog.get_by_role("spinbutton", name="step Hz").fill("9")
    acting.keyboard.press("Enter")
    expect(dialog.get_by_role("form", name="Rates").get_by_role("status")).to_have_text("set: step")
    acting.keyboard.press("Escape")
    expect(walk.locator(".figure")).to_have_text(re.compile("9 Hz"))

    walk.get_by_role("button").focus()
    acting.keyboard.press("Enter")
    dialog.get_by_role("button", name="Stop").press("Enter")
    expect(dialog).to_contain_text("it has stopped")
    acting.keyboard.press("Escape")
    expect(walk).to_have_attribute("data-state", "stopped")
    walk.get_by_role("button").press("Enter")
    dialog.get_by_role("button", name="Start").press("Enter")
    expect(walk).to_have_attribute("data-state", "running")
    acting.keyboard.press("Escape")

    walk.get_by_role("button").press("Enter")
    dialog.get_by_role("button", name="Move …").press("Enter")
    expect(dialog.get_by_role("button", name="Move it to b")).to_be_focused()
    acting.keyboard.press("Enter")
    expect(chip(acting, "b", "Walk")).to_have_attribute("data-state", "running")
