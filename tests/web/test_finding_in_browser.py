"""A person looks for something on the page: the search, repeats in the list of events, the address of the page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from web.browsing import PHONE, chip, expect, opened
from web.page_rig import Fleet
from web.samples import agent, describe, record, task

from pancakes.control import Reply
from pancakes.tools.web.page_server import PageServer

TWENTY = "\N{MULTIPLICATION SIGN}20"


def line(name: str, text: str, t_s: float, level: str = "warning") -> dict[str, Any]:
    return record(name, "line", t_s, "device", level=level, text=text)


@pytest.fixture
def noisy(fleet: Fleet) -> Fleet:
    """Three agents; two of them repeat warnings in turns."""
    model = fleet.feed.model
    for second in range(30):
        fleet.t = float(second)
        describe(
            model,
            agent("a", task("a", "Scan"), task("a", "sonar", "device"), mission_s=fleet.t),
            agent("b", task("b", "Guide"), mission_s=fleet.t),
            agent("c", task("c", "Load"), mission_s=fleet.t),
            t=fleet.t,
        )
        if second >= 10:
            model.tell(line("a", f"the echo took {0.1 * second:.5f} s", fleet.t), fleet.t)
            model.tell(line("b", "no fix", fleet.t), fleet.t)
        fleet.feed.record()
    model.tell(record("c", "on_circle", 29.0, radius_m=0.60512345), 29.0)
    description = {
        "service": "client", "task": "Guide", "settings": {}, "settings_schema": {}, "timers": [],
        "state": {"steps": 3},
    }  # fmt: skip
    fleet.looks = {True: Reply(None, description)}
    return fleet


@pytest.fixture
def page(noisy: Fleet, server: PageServer, browser: Any, faults: list[str]) -> Iterator[Any]:
    page = opened(browser, server.address, faults)
    expect(chip(page, "a", "Scan")).to_be_visible()
    yield page
    assert faults == []


def test_repeats_are_grouped_with_their_count(page: Any):
    rows = page.locator("#events li")
    expect(rows).to_have_text(
        [
            re.compile(r"c: on circle \(radius 0.605 m\)"),
            re.compile(f"b: no fix.*{TWENTY}"),
            re.compile(f"a: the echo.*{TWENTY}"),
        ]
    )
    expect(rows.nth(2)).to_contain_text("2.9 s")
    page.get_by_role("button", name="Show all 20 since 0:10.0").first.click()
    expect(rows).to_have_count(22)
    page.get_by_role("button", name="Show only the newest of 20").click()
    expect(rows).to_have_count(3)


def test_numbers_in_names_are_not_repeats(page: Any):
    """`agent1` and `agent2` are different, and so are moves; numbers of one line are not."""
    counts = page.evaluate(
        """async () => {
          const { grouped } = await import("/event_groups.js");
          const at = (t, text, agent = "a") => ({ t, text, agent, kind: "line" });
          const groups = (...events) => grouped(events, 9).map((it) => it.events.length);
          return [
            groups(at(2, "agent2 bids 0"), at(1, "agent1 bids 0")),
            groups(at(2, "took 0.1 s"), at(1, "took 0.2 s")),
            groups(at(99, "took 0.1 s"), at(1, "took 0.2 s")),
            groups(at(60, "no fix"), at(1, "no fix")),
            groups(at(2, "no fix"), at(1, "no fix", "b")),
          ];
        }"""
    )
    assert counts == [[1, 1], [2], [1, 1], [2], [1, 1]]


def test_search_finds_agents_tasks_and_events(page: Any):
    page.keyboard.press("/")
    field = page.get_by_role("searchbox", name="Search agents")
    expect(field).to_be_focused()
    field.fill("guide")
    expect(page.locator(".card:visible")).to_have_count(1)
    expect(chip(page, "b", "Guide")).to_be_visible()
    expect(page.locator("#found")).to_have_text("1 agent, 1 task")
    expect(page.locator("#events li")).to_have_text("no event is found")

    # A task of an agent's own service is shown where it is folded away.
    field.fill("sonar")
    expect(chip(page, "a", "sonar")).to_be_visible()
    expect(chip(page, "a", "Scan")).to_be_hidden()
    field.fill("echo a:")
    expect(page.locator("#events li")).to_have_text(re.compile(f"a: the echo.*{TWENTY}"))
    field.press("Escape")
    expect(page.locator(".card:visible")).to_have_count(3)
    expect(chip(page, "a", "sonar")).to_be_hidden()
    expect(page.locator("#found")).to_have_text("")


def test_address_brings_back_what_was_shown(page: Any, browser: Any, faults: list[str]):
    page.locator("label", has_text="Mesh").click()
    page.locator("label", has_text="Warnings").click()
    page.get_by_role("searchbox", name="Search agents").fill("b")
    page.locator("[data-agent=b] h3").click()
    page.get_by_label("How much time the plots show").select_option("all")
    chip(page, "b", "Guide").get_by_role("button").click()
    expect(page.get_by_role("dialog", name="Guide on b")).to_be_visible()
    page.get_by_role("slider", name="Time").fill("12")
    expect(page.locator("#status")).to_have_text("past")
    page.wait_for_function("() => location.hash.includes('at=12')")

    other = opened(browser, page.url, faults)
    expect(other.locator("body")).to_have_attribute("data-stage", "mesh")
    expect(other.get_by_role("radio", name="Warnings")).to_be_checked()
    expect(other.get_by_role("searchbox", name="Search agents")).to_have_value("b")
    expect(other.locator("[data-agent=b].selected")).to_have_count(1)
    expect(other.get_by_role("dialog", name="Guide on b")).to_be_visible()
    expect(other.get_by_label("How much time the plots show")).to_have_value("")
    expect(other.locator("#clock")).to_have_text("0:12.0")

    # A person who changes the address sees what it says now.
    other.evaluate("() => { location.hash = location.hash.replace(/&(at|task)=[^&]*/g, '') }")
    expect(other.locator("#status")).to_have_text("live")
    expect(other.get_by_role("dialog")).to_have_count(0)


def test_nonsense_in_the_address_is_ignored(server: PageServer, noisy: Fleet, browser: Any, faults: list[str]):
    nonsense = "&stage=%22x&show=x&at=x&task=a&why=&agent=nobody&plot=%20,x,a%20b%20c%20d&span=7&find="
    page = opened(browser, server.address + nonsense, faults)
    expect(chip(page, "a", "Scan")).to_be_visible()
    expect(page.locator("#status")).to_have_text("live")
    expect(page.get_by_role("dialog")).to_have_count(0)
    assert faults == []


@pytest.mark.parametrize("size", [{"width": 1440, "height": 900}, {"width": 1000, "height": 800}, PHONE])
def test_inspector_does_not_hide_the_arena(
    noisy: Fleet, server: PageServer, browser: Any, faults: list[str], size: dict[str, int]
):
    page = opened(browser, server.address, faults, viewport=size)
    chip(page, "b", "Guide").get_by_role("button").press("Enter")
    inspector = page.get_by_role("dialog", name="Guide on b")
    expect(inspector).to_contain_text("steps")
    page.evaluate("() => scrollTo({ top: 0, behavior: 'instant' })")
    arena, beside = page.locator("#canvas").bounding_box(), inspector.bounding_box()
    assert beside["x"] >= arena["x"] + arena["width"] or beside["y"] >= arena["y"] + 0.9 * arena["height"]

    # The rest of the page works meanwhile, and escape closes it.
    page.get_by_role("button", name="Pause").click()
    expect(page.locator("#status")).to_have_text("past")
    page.keyboard.press("Escape")
    expect(inspector).to_be_hidden()
    assert faults == []
