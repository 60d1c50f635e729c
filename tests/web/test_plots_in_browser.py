"""A person plots numbers, on a fleet that is made up, in a real browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from cli.processes import Rig
from web.browsing import PHONE, expect, opened, view
from web.page_rig import Fleet
from web.samples import agent, describe, packet, record, task, world

from pancakes.client.rates import RateMeter
from pancakes.devices import Battery
from pancakes.tools.web.page_server import PageServer

SECONDS = 40


@pytest.fixture
def mission(fleet: Fleet) -> Fleet:
    """Two robots with batteries; after 20 s a task migrates, after 30 s one fails."""
    rates = RateMeter()
    model = fleet.feed.model
    for second in range(SECONDS):
        fleet.t = float(second)
        rows = []
        for name in ("a", "b"):
            scan = task(name, "Scan", rate_hz=10.0, ticks=10 * second, lateness_sum_s=0.01 * second)
            level = 1.0 - second / (50.0 if name == "a" else 500.0)
            rows.append(agent(name, scan, peers={"b": 0.002}, mission_s=2.0 * second, speed=2.0, battery_level=level))
            model.hear(name, packet(f"{name}/device/battery", "system", "battery", Battery(8.0, level)), fleet.t)
            model.hear("w", world(2.0 * second, a=(1.0, 2.0), b=(0.1 * second, 0.0)), fleet.t)
        describe(model, *rows, t=fleet.t, rates=rates)
        if second == 20:
            moved = record("a", "migration", 40.0, "network", task="Scan", outcome="moved", winner="b", lines=[])
            model.tell(moved, fleet.t)
        if second == 30:
            model.tell(record("b", "task_failed", 60.0, task="Scan", reason="it broke"), fleet.t)
        fleet.feed.record()
    return fleet


@pytest.fixture
def page(mission: Fleet, server: PageServer, browser: Any, faults: list[str]) -> Iterator[Any]:
    yield opened(browser, server.address, faults)
    assert faults == []


def legend(page: Any, plot: str) -> Any:
    return page.get_by_role("figure", name=plot).locator(".legend li")


def painted(page: Any, plot: str, variable: str) -> list[int]:
    """Return the columns of a plot, in CSS pixels, in which rows near the middle have a colour of the page."""
    columns: list[int] = page.get_by_role("figure", name=plot).evaluate(
        """(figure, variable) => {
          const probe = new OffscreenCanvas(1, 1).getContext("2d");
          probe.fillStyle = getComputedStyle(figure).getPropertyValue(variable);
          probe.fillRect(0, 0, 1, 1);
          const wanted = probe.getImageData(0, 0, 1, 1).data;
          const canvas = figure.querySelector("canvas");
          const rows = canvas.getContext("2d").getImageData(0, 60, canvas.width, 8).data;  // a dash and its gap
          const near = (at) => [0, 1, 2].every((it) => Math.abs(rows[at + it] - wanted[it]) < 24) && rows[at + 3] > 128;
          const inColumn = (x) => [...Array(8).keys()].some((y) => near(4 * (y * canvas.width + x)));
          return [...Array(canvas.width).keys()].filter(inColumn);
        }""",
        variable,
    )
    return columns


def test_batteries_are_plotted_unasked_with_marks(page: Any):
    expect(legend(page, "battery in %")).to_have_text([re.compile(r"^a\s*22 %"), re.compile(r"^b\s*92.2 %")])
    page.wait_for_function("() => document.querySelector('.plot canvas')")
    move, failure = painted(page, "battery", "--move"), painted(page, "battery", "--refused")
    assert move and failure and max(move) < min(failure)


def test_number_is_found_plotted_and_removed(page: Any, server: PageServer):
    page.keyboard.press("p")
    field = page.get_by_role("combobox", name="Plot a number")
    expect(field).to_be_focused()
    field.fill("bodies x_m")
    options = page.get_by_role("listbox").get_by_role("option")
    expect(options).to_have_text([re.compile("bodies.a.x_m\\s*1 m"), re.compile("bodies.b.x_m\\s*3.9 m")])
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    expect(legend(page, "x in m")).to_have_text(re.compile(r"world World b\s*3.9 m"))

    # Another of the same kind comes into the same plot; the rest of the page stays as it was.
    field.fill("bodies.a.x_m")
    expect(options).to_have_count(1)
    options.first.click()
    expect(legend(page, "x in m")).to_have_count(2)
    expect(legend(page, "battery in %")).to_have_count(2)
    page.keyboard.press("Escape")
    expect(options).to_have_count(0)

    page.get_by_role("button", name="Remove world/client/World world_state bodies.b.x_m").click()
    expect(legend(page, "x in m")).to_have_text(re.compile("World a"))
    page.wait_for_function("() => location.hash.includes('plot=') && !location.hash.includes('bodies.b')")
    page.reload()
    expect(legend(page, "x in m")).to_have_text(re.compile("World a"))
    field.fill("no such number")
    expect(page.get_by_role("listbox")).to_contain_text("No number has such a name")


def test_new_points_come_while_it_is_live(page: Any, mission: Fleet):
    expect(legend(page, "battery in %").first).to_contain_text("22 %")
    mission.t = SECONDS + 1.0
    with mission.feed.lock:
        mission.feed.model.series.add("a battery_percent", mission.t, 7.0)
    mission.feed.record()
    expect(legend(page, "battery in %").first).to_contain_text("7 %")


def test_plots_follow_the_timeline_into_the_past(page: Any):
    slider = page.get_by_role("slider", name="Time")
    expect(legend(page, "battery in %").first).to_contain_text("22 %")
    slider.fill("10")
    expect(page.locator("#status")).to_have_text("past")
    expect(legend(page, "battery in %").first).to_contain_text("80 %")

    # A click goes to a moment; the pointer shows what happened there.
    plot = page.get_by_role("figure", name="battery").locator(".u-over")
    box = plot.bounding_box()
    page.get_by_label("How much time the plots show").select_option("all")
    share = 20.0 / (SECONDS - 1.0)
    plot.hover(position={"x": share * box["width"], "y": 20})
    expect(page.get_by_role("figure", name="battery")).to_contain_text("Scan moved to b")
    plot.click(position={"x": share * box["width"], "y": 20})
    expect(page.locator("#clock")).to_have_text(re.compile(r"^0:(38|39|40)\."))


def test_card_and_inspector_offer_plots(page: Any):
    page.locator("[data-agent=a]").get_by_role("button", name="Plot lateness of a").click()
    expect(legend(page, "late in ms")).to_have_text(re.compile(r"^a\s*1 ms"))
    drawn = page.locator("[data-agent=a] .battery .spark path").get_attribute("d")
    assert drawn.count("L") > 20

    page.locator("[data-agent=b] [data-task=Scan]").get_by_role("button").click()
    page.get_by_role("button", name="Plot its rate").click()
    expect(legend(page, "rate in Hz")).to_have_text(re.compile(r"^b Scan\s*5 Hz"))


def test_timeline_has_an_axis_in_mission_time(browser: Any, mission: Fleet, server: PageServer, faults: list[str]):
    context = browser.new_context(viewport={"width": 1280, "height": 860})
    context.add_init_script(
        """window.written = new Set();
        const write = CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
          if (this.canvas.id === "marks") window.written.add(text);
          return write.call(this, text, ...rest);
        };"""
    )
    page = context.new_page()
    page.goto(server.address)
    page.wait_for_function("() => window.written.has('0:30') && window.written.has('1:00')")
    slider = page.get_by_role("slider", name="Time")
    box = slider.bounding_box()
    slider.hover(position={"x": 8 + 20.0 / (SECONDS - 1.0) * (box["width"] - 16), "y": 8})
    expect(page.locator("#hint")).to_have_text(re.compile(r"^0:(39|40)\.\d · Scan moved to b$"))


WRITING = """window.written = {};
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
  const axis = this.canvas.id || "plot";
  const half = this.measureText(text).width / 2;
  const at = this.canvas.id === "marks" ? x : x / devicePixelRatio;
  if (/^\\d+:\\d\\d/.test(text)) (window.written[axis] ??= new Map()).set(text, [at - half, at + half]);
  return write.call(this, text, x, y);
};"""


@pytest.mark.parametrize("jump_s", [0.0, 20.0])
@pytest.mark.parametrize("viewport", [{"width": 1280, "height": 860}, PHONE], ids=["desk", "phone"])
def test_labels_of_time_do_not_overlap(
    fleet: Fleet, server: PageServer, browser: Any, faults: list[str], viewport: dict[str, int], jump_s: float
):
    """Agents that have run for long are found after `jump_s`; until then there were none, or others."""
    for tenths in range(400):
        fleet.t = tenths / 10.0
        if fleet.t >= 0.3:
            mission_s = fleet.t + (200.0 if fleet.t >= jump_s else 0.0)
            describe(fleet.feed.model, agent("a", mission_s=mission_s, battery_level=0.5), t=fleet.t)
        fleet.feed.record()
    context = browser.new_context(viewport=viewport)
    context.add_init_script(WRITING)
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(server.address)
    page.wait_for_function("() => window.written.marks && window.written.plot")
    page.get_by_label("How much time the plots show").select_option("all")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.evaluate("window.written = {}")
    page.set_viewport_size({**viewport, "width": viewport["width"] - 10})
    page.wait_for_function("() => window.written.marks && window.written.plot")
    for axis in ("marks", "plot"):
        labels = page.evaluate(f"[...window.written.{axis}]")
        places = sorted(place for _, place in labels)
        assert len(places) > 1, labels
        assert all(one[1] < other[0] for one, other in pairwise(places)), labels
        assert {text for text, _ in labels} & {"3:45", "3:50"}, labels
    assert faults == []
    context.close()


def test_address_says_whether_the_mesh_is_shown(mission: Fleet, server: PageServer, browser: Any, faults: list[str]):
    """Also if there are poses, for which the page shows the arena by itself."""
    page = opened(browser, f"{server.address}&stage=mesh", faults)
    expect(page.locator("#clock")).to_have_text("1:18.0")
    expect(page.locator("body")).to_have_attribute("data-stage", "mesh")
    page.keyboard.press("m")
    expect(page.locator("body")).to_have_attribute("data-stage", "arena")
    page.wait_for_function("() => location.hash.includes('stage=arena')")
    assert faults == []


def test_plots_fit_a_phone(mission: Fleet, server: PageServer, browser: Any, faults: list[str]):
    page = opened(browser, server.address, faults, viewport=PHONE, color_scheme="dark")
    expect(legend(page, "battery in %")).to_have_count(2)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.emulate_media(color_scheme="light")
    expect(legend(page, "battery in %")).to_have_count(2)
    assert faults == []


def test_packets_of_running_agents_are_plotted(rig: Rig, browser: Any, faults: list[str]):
    """The page does not follow readings of the load by itself, until somebody looks for them."""
    rig.ready("a", '[device.load]\ndriver = "host.load"\nrate_hz = 5\n')
    page = opened(browser, view(rig), faults)
    expect(page.locator("[data-agent=a]")).to_be_visible()
    page.get_by_role("combobox", name="Plot a number").fill("load cpu")
    option = page.get_by_role("listbox").get_by_role("option", name="a/device/load load cpu")
    expect(option).to_be_visible()
    option.click()
    plot = page.get_by_role("figure", name="cpu")
    expect(plot.locator(".legend li")).to_have_text(re.compile(r"^a\s*[\d.]+"))
    expect(plot.locator("canvas")).to_be_visible()
    assert faults == []
