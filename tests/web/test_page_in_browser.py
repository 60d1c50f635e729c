"""The page in a headless browser: a mission with a migration, and a fleet that a person controls."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig
from web.browsing import PHONE, WALK, WALKING, chip, drag, expect, opened, view

CONFIGS = Path(__file__).parents[2] / "configs" / "encirclement"


def painted(page: Any, agent: str) -> int:
    """Return how many pixels of the arena have the colour of an agent."""
    count: int = page.evaluate(
        """async (agent) => {
          await new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
          const dot = document.querySelector(`[data-agent=${agent}] .dot`);
          const [red, green, blue] = getComputedStyle(dot).backgroundColor.match(/\\d+/g).map(Number);
          const canvas = document.getElementById("canvas");
          const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          let found = 0;
          for (let at = 0; at < data.length; at += 4)
            if (data[at] === red && data[at + 1] === green && data[at + 2] === blue && data[at + 3] === 255) found += 1;
          return found;
        }""",
        agent,
    )
    return count


# A mission


@pytest.fixture
def mission(rig: Rig) -> str:
    """The address of the page of a demo with an early migration; it stays open after the end of the demo."""
    arguments = ["encirclement", "--virtual", "--view", "--speed", "6", "--duration", "45", "--configs", str(CONFIGS)]
    early = ["--set", "world:task.World.settings.robots.agent1.battery.capacity_j=150"]
    demo = rig.run("-u", "-m", "pancakes.tools.cli.main", "demo", *arguments, *early, whole=True)
    return demo.hear("the page is at ").rpartition(" ")[2]


def test_mission_is_shown_live_and_replayed(browser: Any, mission: str, faults: list[str]):
    page = opened(browser, mission, faults)
    page.evaluate(
        """() => new MutationObserver((changes) => {
          for (const change of changes) for (const node of change.addedNodes)
            if (node.classList?.contains("flyer")) document.body.dataset.flown = node.textContent;
        }).observe(document.body, {childList: true})"""
    )

    # Robots appear, and what they run.
    expect(chip(page, "agent1", "ScanTarget")).to_have_attribute("data-state", "running")
    expect(page.locator("#canvas")).to_have_attribute("aria-label", re.compile("agent1 at .* m"))
    expect(page.locator("body")).to_have_attribute("data-stage", "arena")
    for layer in ("trails", "rays", "circles", "names"):
        page.get_by_label(layer).uncheck()
    assert painted(page, "agent1") > 60 and painted(page, "agent2") > 60

    # The move is seen: each answer, and the task on its way from card to card.
    expect(page.locator("#events").get_by_text("agent2 bids 0 for ScanTarget")).to_be_visible()
    expect(
        page.locator("#events").get_by_text("sensor refuses ScanTarget: lacks the device type motors")
    ).to_be_visible()
    expect(chip(page, "agent2", "ScanTarget")).to_have_attribute("data-state", "running")
    expect(page.locator("body")).to_have_attribute("data-flown", "ScanTarget")
    expect(chip(page, "agent1", "GoHome")).to_have_attribute("data-state", "running")

    # The past: before it moved, agent 1 had it.
    page.locator("#events").get_by_text("agent1 asks all neighbours").click()
    page.keyboard.press("j")
    expect(page.locator("#status")).to_have_text("past")
    expect(chip(page, "agent1", "ScanTarget")).to_have_attribute("data-state", "running")
    expect(chip(page, "agent2", "ScanTarget")).to_have_count(0)
    expect(page.locator("#events").get_by_text("agent2 bids 0 for ScanTarget")).to_have_count(0)
    page.get_by_role("slider", name="Time").focus()
    page.keyboard.press("Home")
    expect(page.locator("#clock")).to_have_text(re.compile(r"^0:0"))

    # It plays from there, and comes back.
    page.get_by_label("How fast it plays").select_option("8")
    page.get_by_role("button", name="Play").click()
    expect(chip(page, "agent2", "ScanTarget")).to_have_attribute("data-state", "running")
    page.keyboard.press("l")
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")

    # When the mission is over the page says so, and the timeline is still there.
    expect(page.locator("#waiting")).to_have_text(re.compile("the mission is over: "))
    page.get_by_role("button", name="Back 5 seconds").click()
    expect(page.locator("#status")).to_have_text("past")
    expect(page.get_by_role("button", name="Play")).to_be_visible()

    expect(page.locator("#status")).to_have_text("past")
    page.keyboard.press("l")
    expect(page.locator("#status")).to_have_text("ended")

    # Why it moved, at the end.
    page.locator("[data-agent=agent1]").get_by_role("button", name="Why?").click()
    dialog, chain = page.get_by_role("dialog"), page.locator(".chain li")
    expect(chain.last).to_contain_text("motors agent1/client/GoHome")
    assert chain.count() >= 3
    expect(page.get_by_text("commands came about like this")).to_be_visible()
    assert page.locator(".alike .bars i").count() == 30

    # From command to command by keyboard, and to the moment of one.
    expect(dialog.get_by_role("button", name="Previous command")).to_be_focused()
    (place, count) = re.findall(r"\d+", dialog.locator(".whynav .dim").inner_text())
    assert place == count
    for _ in range(3):
        before = dialog.locator(".whynav .dim").inner_text()
        page.keyboard.press("ArrowLeft")
        expect(dialog.locator(".whynav .dim")).not_to_have_text(before)
    expect(dialog.locator(".whynav .dim")).to_have_text(f"{int(count) - 3} of {count}")
    page.keyboard.press("End")
    expect(dialog.locator(".whynav .dim")).to_have_text(f"{count} of {count}")
    dialog.get_by_role("button", name="To its moment on the timeline").press("Enter")
    expect(dialog).to_have_count(0)

    # Why it moved earlier, when another task did that.
    page.get_by_role("slider", name="Time").focus()
    page.keyboard.press("Home")
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    expect(page.locator("#status")).to_have_text("past")
    page.locator("[data-agent=agent1]").get_by_role("button", name="Why?").press("Enter")
    expect(chain.last).to_contain_text("motors agent1/client/ScanTarget")
    assert faults == []


def test_page_fits_a_phone_and_follows_the_colour_scheme(browser: Any, mission: str, faults: list[str]):
    page = opened(browser, mission, faults, viewport=PHONE, color_scheme="light")
    expect(chip(page, "agent1", "ScanTarget")).to_be_visible()
    for name in ("News", "All"):
        page.get_by_role("radio", name=name).check(force=True)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    expect(page.locator("body")).to_have_css("background-color", "rgb(244, 243, 239)")
    page.emulate_media(color_scheme="dark")
    expect(page.locator("body")).to_have_css("background-color", "rgb(16, 18, 22)")

    page.keyboard.press("m")
    expect(page.locator("body")).to_have_attribute("data-stage", "mesh")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.get_by_role("button", name="Keys and hints").click()
    expect(page.get_by_role("dialog")).to_contain_text("This page is read-only")
    page.keyboard.press("Escape")
    page.locator("[data-agent=agent1]").get_by_role("button", name="Why?").click()
    expect(page.locator(".chain li").last).to_contain_text("motors agent1/client/")
    assert page.evaluate("document.querySelector('dialog[open]').scrollWidth") <= PHONE["width"]
    assert faults == []


WRITTEN = """
const pen = CanvasRenderingContext2D.prototype;
const [write, clear] = [pen.fillText, pen.clearRect];
window.framesSeen = 0;
window.overlaps = new Set();
window.outside = new Set();
let boxes = [];
pen.clearRect = function (...box) {
  for (const [index, one] of boxes.entries()) {
    if (one.left < 0 || one.right > one.width) window.outside.add(one.text);
    for (const other of boxes.slice(index + 1)) {
      const beside = one.right <= other.left || other.right <= one.left;
      if (beside || one.bottom <= other.top || other.bottom <= one.top) continue;
      window.overlaps.add(`${one.text} / ${other.text}`);
    }
  }
  window.framesSeen += boxes.length > 3;
  boxes = [];
  return clear.apply(this, box);
};
pen.fillText = function (text, x, y) {
  if (this.canvas.id === "canvas") {
    const { width, actualBoundingBoxAscent: up, actualBoundingBoxDescent: down } = this.measureText(text);
    const left = this.textAlign === "left" ? x : x - width / 2;
    boxes.push({ text, left, right: left + width, top: y - up, bottom: y + down, width: this.canvas.clientWidth });
  }
  return write.call(this, text, x, y);
};
"""
"""Watches the texts on the canvas in each frame, and records those that overlap."""


def test_labels_on_a_phone_do_not_overlap(browser: Any, mission: str, faults: list[str]):
    context = browser.new_context(viewport={"width": 390, "height": 844}, device_scale_factor=2)
    context.add_init_script(WRITTEN)
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(mission)
    # From before the move, when robots come close to each other, to the end; there it is looked at once more.
    page.locator("#waiting").get_by_text("the mission is over").wait_for(timeout=60_000)
    frames = page.evaluate("window.framesSeen")
    page.wait_for_function("(before) => window.framesSeen > before + 10", arg=frames)
    assert page.evaluate("[...window.overlaps]") == []
    assert page.evaluate("[...window.outside]") == []
    for name in ("agent1", "agent2", "sensor"):
        expect(page.locator("#canvas")).to_have_attribute("aria-label", re.compile(name))
    title, clock = page.locator("#title").bounding_box(), page.locator(".clock").bounding_box()
    assert title["x"] + title["width"] <= clock["x"], "the title makes room for the clock"
    assert faults == []


PLACED = """
async ({ radius, count }) => {
  const { Labels, around } = await import("/labels.js");
  const labels = new Labels();
  labels.begin(360, 300);
  const boxes = [];
  for (let number = 0; number < count; number += 1) {
    const middle = labels.place(`${number}`, 60, 14, around(180, 150, radius, 60, 14));
    if (middle) boxes.push([middle[0] - 30, middle[1] - 7, middle[0] + 30, middle[1] + 7]);
  }
  return boxes;
}
"""


def test_labels_without_room_are_left_out(looking: Any):
    boxes = looking.evaluate(PLACED, {"radius": 7, "count": 40})
    assert 12 <= len(boxes) < 40
    for number, one in enumerate(boxes):
        assert min(one) >= 0 and one[2] <= 360 and one[3] <= 300
        for other in boxes[number + 1 :]:
            assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]


# A fleet without a world


def test_without_poses_the_mesh_is_shown(looking: Any):
    expect(looking.locator("body")).to_have_attribute("data-stage", "mesh")
    expect(looking.locator("#canvas")).to_have_attribute(
        "aria-label", re.compile("Mesh of 2 agents: a runs 1 task; b runs 0 tasks")
    )
    expect(looking.locator("[data-agent=a] .links")).to_have_text(re.compile(r"links: b [\d.]+ ms"))
    expect(looking.locator("[data-agent=a] [data-task=Walk] .figure")).to_have_text(re.compile(r"of 4 Hz"))


def test_fifty_agents_have_separate_places(looking: Any):
    picked = looking.evaluate(
        """async () => {
          const { Mesh } = await import("/mesh.js");
          const canvas = document.createElement("canvas");
          canvas.style = "position: fixed; top: 0; left: 0; width: 370px; height: 360px";
          document.body.append(canvas);
          const names = Array.from({length: 50}, (_, number) => `agent-with-a-long-name-${number}`);
          const links = names.slice(1).map((name) => [`${names[0]}/${name}`, 1.5]);
          const row = {role: "agent", state: "ready"};
          const picture = {agents: () => names, table: () => new Map(links), get: () => row};
          const mesh = new Mesh(canvas);
          mesh.selected = names[0];
          mesh.draw(picture, [], 0);
          const found = names.filter((name) => mesh.bodyAt(picture, ...mesh.places.get(name)) === name).length;
          const places = [...mesh.places.values()];
          const gaps = places.map(([x, y], at) => {
            const [nextX, nextY] = places[(at + 1) % 50];
            return Math.hypot(x - nextX, y - nextY);
          });
          canvas.remove();
          return [found, Math.min(...gaps) >= 1.5 * mesh.radius];
        }"""
    )
    assert picked == [50, True]


def test_laser_scan_is_drawn_from_where_the_scanner_stands(looking: Any):
    """A robot at (1, 2) looks along y; its scanner is 0.5 m ahead of its middle, and sees something 2 m ahead."""
    seen = looking.evaluate(
        """async () => {
          const { Arena } = await import("/arena.js");
          const canvas = document.createElement("canvas");
          canvas.style = "position: fixed; top: 0; left: 0; width: 400px; height: 400px";
          document.body.append(canvas);
          const keys = {
            body: {a: [1, 2, Math.PI / 2, ""]},
            shape: {a: {kind: "robot", radius_m: 0.2, laser_m: 0.5}},
            ring: {"a/laser_scan": {bearings_rad: [0], max_m: 4}},
            rays: {"a/laser_scan": [2]},
          };
          const picture = {
            agents: () => ["a"],
            table: (kind) => new Map(Object.entries(keys[kind] || {})),
            get: (kind, key) => keys[kind]?.[key],
            arena: [10, 10],
          };
          const arena = new Arena(canvas);
          arena.glides.set("a", {from: keys.body.a, to: keys.body.a, since: 0});
          arena.layers = {trails: false, rays: true, circles: false, names: false};
          const dots = [];
          const arc = arena.pen.arc.bind(arena.pen);
          arena.pen.arc = (...at) => { if (at[2] === 1.8) dots.push(at); arc(...at); };
          arena.draw(picture, [], 0);
          canvas.remove();
          return dots.map(([x, y]) => [(x - arena.middle[0]) / arena.scale, (arena.middle[1] - y) / arena.scale]);
        }"""
    )
    assert seen == [pytest.approx([1.0, 4.5])]


def test_ended_fleet_keeps_its_timeline(rig: Rig, browser: Any, faults: list[str]):
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    running = rig.ready("a", WALKING)
    page = opened(browser, view(rig), faults)
    expect(page.locator("#status")).to_have_text("live")
    expect(page.locator("[data-agent=a] .services")).to_have_text(re.compile("client, .*network"))
    expect(chip(page, "a", "Walk").locator(".figure")).to_have_text(re.compile("of 4 Hz"))

    running.close()
    expect(page.locator("#status")).to_have_text("ended")
    expect(page.locator("#waiting")).to_contain_text("the fleet has ended")
    page.get_by_role("slider", name="Time").focus()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    expect(page.locator("#status")).to_have_text("past")
    expect(chip(page, "a", "Walk")).to_have_attribute("data-state", "running")
    page.keyboard.press("l")
    expect(page.locator("#status")).to_have_text("ended")

    rig.ready("a", WALKING)
    expect(page.locator("#status")).to_have_text("live")
    assert faults == []


def test_page_without_control_is_refused(looking: Any):
    expect(chip(looking, "a", "Walk")).to_have_attribute("data-state", "running")
    drag(looking, chip(looking, "a", "Walk"), looking.locator("[data-agent=b]"))
    expect(looking.locator("dialog[open]")).to_have_count(0)
    chip(looking, "a", "Walk").get_by_role("button").click()
    expect(looking.get_by_role("dialog")).to_contain_text("walk.Walk")
    expect(looking.get_by_role("dialog").get_by_role("button")).to_have_text(
        ["Close", "Plot its rate", "Plot its lateness"]
    )

    answer = looking.evaluate(
        """() => new Promise((resolve) => {
          const socket = new WebSocket(`ws://${location.host}/news`);
          const token = new URLSearchParams(location.hash.slice(1)).get("token");
          const order = {id: 1, ask: "order", do: "stop", agent: "a", task: "client/Walk"};
          socket.onopen = () => {
            socket.send(JSON.stringify({id: 0, ask: "hello", token}));
            socket.send(JSON.stringify(order));
          };
          socket.onmessage = (it) => { const news = JSON.parse(it.data); if (news.answer === 1) resolve(news); };
        })"""
    )
    assert answer["ok"] is False and "start it with --control" in answer["reason"]


def test_different_versions_are_shown_on_the_cards(browser: Any, rig: Rig, faults: list[str]):
    def deployed(name: str, build: str) -> None:
        (rig.directory / name).mkdir()
        (rig.directory / name / "pancakes-build").write_text(f"{build}\n")
        program = f"import runpy, sys; sys.prefix = {str(rig.directory / name)!r}; sys.argv[0] = 'agent'\n"
        program += "runpy.run_module('pancakes.tools.cli.agent_command', run_name='__main__')"
        rig.run("-c", program, "--config", str(rig.config(name))).hear("/kernel: ready")

    deployed("one", "0.1.0-aa")
    deployed("two", "0.1.0-bb")
    page = opened(browser, view(rig), faults)
    for name, build in (("one", "0.1.0-aa"), ("two", "0.1.0-bb")):
        expect(page.locator(f"[data-agent={name}]")).to_contain_text(build)
