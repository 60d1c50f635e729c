"""The report's page in a headless browser: any command is picked by pointer and by keyboard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from report.commanded import command
from report.test_making import mission, written

from pancakes.tools.report.findings import Findings
from pancakes.tools.report.html_report import make_report
from pancakes.tools.report.page import make_page
from pancakes.tools.report.plots import Picture

PHONE = {"width": 360, "height": 740}


@pytest.fixture
def report(tmp_path: Path) -> str:
    """A report on two robots; command 60 of `a` took longest."""
    findings = Findings()
    for number in range(100):
        for agent in ("a", "b"):
            slow = agent == "a" and number in (59, 20)
            findings.reactions.add_command(command(number, 40.0 + number if slow else 2.0, agent))
    page = tmp_path / "report.html"
    page.write_text(make_page("Report", {}, [], findings, {}), encoding="utf-8")
    return page.as_uri()


def opened(browser: Any, address: str, **options: Any) -> tuple[Any, list[str]]:
    faults: list[str] = []
    page = browser.new_context(**{"viewport": {"width": 1100, "height": 900}, **options}).new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: faults.append(request.url) if request.url != address else None)
    page.goto(address)
    return page, faults


def expect(target: Any) -> Any:
    from playwright.sync_api import expect

    return expect(target)


def test_picked_command_shows_its_chain(browser: Any, report: str):
    page, faults = opened(browser, report)
    page.get_by_text("Any command", exact=True).click()
    said, rows = page.locator("#picker-said"), page.locator("#picker-chain tr")
    expect(said).to_contain_text("Command 1 of 100, at 0.002 s: v_mps 0.1, omega_radps 0. 2 ms from the first cause")
    assert rows.all_inner_texts()[0].split("\t")[:4] == ["0 ms", "a/device/pose pose #1", "0.5 ms", "1.5 ms"]
    expect(page.locator("#picker-alike")).to_contain_text("Of 100 that came about like this: p50 2 ms")

    # The slowest, and then the next slowest.
    page.get_by_role("button", name="slowest").click()
    expect(said).to_contain_text("Command 60 of 100, at 5.999 s")
    expect(said).to_contain_text("99 ms from the first cause")
    page.get_by_role("button", name="slowest").click()
    expect(said).to_contain_text("Command 21 of 100")

    # By keyboard: a moment, and from one command to the next.
    page.get_by_role("spinbutton").fill("3.14")
    page.keyboard.press("Enter")
    expect(said).to_contain_text("Command 32 of 100, at 3.102 s")
    page.get_by_role("slider", name="Command").focus()
    page.keyboard.press("ArrowRight")
    expect(said).to_contain_text("Command 33 of 100")
    page.get_by_role("button", name="Previous command").press("Enter")
    expect(said).to_contain_text("Command 32 of 100")

    # By pointer: the point that stands out is the slowest.
    box = page.locator("#picker-plot").bounding_box()
    page.mouse.click(box["x"] + 60 + 0.6 * (box["width"] - 70), box["y"] + 18)
    expect(said).to_contain_text("Command 60 of 100")

    # Another actuator.
    page.get_by_role("combobox").select_option("b motors")
    expect(rows.first).to_contain_text("b/device/pose")
    assert faults == []


def test_report_fits_a_phone_in_dark_mode(browser: Any, report: str):
    page, faults = opened(browser, report, viewport=PHONE, color_scheme="dark")
    page.get_by_text("Any command", exact=True).click()
    expect(page.locator("#picker")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert faults == []


def test_wide_parts_scroll_on_a_phone(browser: Any, tmp_path: Path):
    svg = '<svg viewBox="0 0 700 200" class="broad" style="max-width: 980px"><rect width="700" height="200"/></svg>'
    findings = Findings()
    findings.reactions.add_command(command(1, 2.0, "a"))
    page_file = tmp_path / "report.html"
    pictures = {"tasks": Picture("tasks", "Which agent ran which task.", svg)}
    page_file.write_text(make_page("Report", {}, [], findings, pictures), encoding="utf-8")
    page, faults = opened(browser, page_file.as_uri(), viewport={"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    figure = page.locator("#mission .wide")
    assert figure.evaluate("(box) => box.scrollWidth > box.clientWidth + 100")
    # A phone shows no scroll bar: a shade at the edge shows that there is more.
    assert figure.evaluate("(box) => getComputedStyle(box).backgroundImage").count("linear-gradient") == 4
    figure.focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.querySelector('#mission .wide').scrollLeft > 0")
    assert faults == []


def test_report_without_scripts_shows_the_slowest(browser: Any, report: str):
    page, _ = opened(browser, report, java_script_enabled=False)
    page.get_by_text("Any command", exact=True).click()
    expect(page.locator("#picker")).to_be_hidden()
    page.get_by_text("a motors: the slowest of 100 commands").click()
    expect(page.get_by_text("a/device/pose pose #60 → 99 ms → a/client/Scan motors #60")).to_be_visible()


CONTRAST = """
() => {
  const pen = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  const style = getComputedStyle(document.documentElement);
  const luminance = (name) => {
    pen.fillStyle = style.getPropertyValue(name);
    pen.fillRect(0, 0, 1, 1);
    const part = [...pen.getImageData(0, 0, 1, 1).data].slice(0, 3).map((it) => it / 255);
    const [red, green, blue] = part.map((it) => (it <= 0.04045 ? it / 12.92 : ((it + 0.055) / 1.055) ** 2.4));
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const paper = luminance("--paper");
  const found = {};
  const colours = [..."01234567"].map((it) => `--c${it}`);
  for (const name of ["--ink", "--faint", "--good", "--bad", "--fair", "--grey", ...colours]) {
    const [low, high] = [paper, luminance(name)].sort((a, b) => a - b);
    found[name] = (high + 0.05) / (low + 0.05);
  }
  return found;
}
"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report_and_its_pictures_have_contrast(browser: Any, report: str, scheme: str):
    page, _ = opened(browser, report, color_scheme=scheme)
    found = page.evaluate(CONTRAST)
    assert {name: ratio for name, ratio in found.items() if ratio < (3.0 if name.startswith("--c") else 4.5)} == {}
    assert len(found) == 14


def test_report_of_a_mission_is_short(browser: Any, tmp_path: Path):
    """What a reader wants first fits on little more than two screens; the rest is folded away, and unfolds."""
    folder = tmp_path / "run"
    folder.mkdir()
    for agent in ("a", "b"):
        written(folder / f"{agent}.mcap", mission(agent))
    address = make_report(folder, tmp_path / "out").page.as_uri()
    page, faults = opened(browser, address)
    assert page.evaluate("document.documentElement.scrollHeight") < 2250
    expect(page.get_by_text("a & b < c")).to_be_visible()
    expect(page.get_by_text("<lacks> motors")).to_be_hidden()
    page.get_by_text("Who was asked, and what each answered").click()
    expect(page.get_by_text("<lacks> motors")).to_be_visible()
    page.locator("#summary").get_by_text("worst lateness").click()
    assert page.url.endswith("#performance")
    assert faults == []
