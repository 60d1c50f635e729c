"""The pad of the page with which a person drives a robot by hand."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from cli.processes import PATIENCE_S, Rig
from web.browsing import chip, expect, middle, opened, view

WHEELS = """
import json
from pathlib import Path

from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.task import Task, every

class Wheels(Actuator):
    type = "motors"

    def open(self):
        self.path = Path(__file__).with_name("told.json")

    def write(self, command, ttl_s, source):
        self.path.write_text(json.dumps([command.v_mps, command.omega_radps, source]))

    def safe_stop(self):
        self.path.write_text(json.dumps([0.0, 0.0, ""]))

class Go(Task):
    requires = ("motors",)

    @every(hz=10)
    def go(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))
"""
POINTS = "[pancakes.tasks]\nwheels.Go = plugin_wheels:Go\n[pancakes.drivers]\nwheels = plugin_wheels:Wheels\n"
ROBOT = '[device.motors]\ndriver = "wheels"\n[task.Go]\ntype = "wheels.Go"\n'


@pytest.fixture
def robot(rig: Rig) -> Iterator[Rig]:
    rig.install("wheels", POINTS, WHEELS)
    rig.ready("a", ROBOT)
    yield rig


def told(rig: Rig) -> list[Any]:
    """Return what the wheels were told last: two velocities and who did; empty: nothing yet, or it is being written."""
    try:
        v_mps, omega_radps, source = json.loads((rig.plugins / "told.json").read_text())
    except (FileNotFoundError, ValueError):
        return []
    return [round(v_mps, 6), round(omega_radps, 6), source]


def wheels_hear(rig: Rig, v_mps: float, omega_radps: float, task: str) -> bool:
    until_s = time.monotonic() + PATIENCE_S
    wanted = [v_mps, omega_radps, task]
    while (found := told(rig)) != wanted and time.monotonic() < until_s:
        time.sleep(0.02)
    assert found == wanted
    return True


def panel(page: Any) -> Any:
    """Open the panel of the motors, and return the part with which they are driven."""
    page.get_by_role("button", name="Drive …", exact=True).click()
    return page.get_by_role("region", name="Drive by hand")


DRIVE, GO = "a/device/drive-motors", "a/client/Go"


def test_person_drives_with_keys_and_pointer(robot: Rig, browser: Any, faults: list[str]):
    assert wheels_hear(robot, 0.1, 0.0, GO)
    page = opened(browser, view(robot, "--control"), faults)
    drive = panel(page)
    drive.get_by_label("Speed").fill("0.4")
    drive.get_by_role("button", name="Drive", exact=True).click()
    pad = drive.get_by_role("application")
    expect(pad).to_be_focused()
    assert wheels_hear(robot, 0.0, 0.0, DRIVE)
    expect(drive).to_contain_text("a/client/Go waits")
    page.keyboard.down("ArrowUp")
    assert wheels_hear(robot, 0.4, 0.0, DRIVE)
    page.keyboard.down("a")
    assert wheels_hear(robot, 0.4, 1.0, DRIVE)
    page.keyboard.up("ArrowUp")
    page.keyboard.up("a")
    assert wheels_hear(robot, 0.0, 0.0, DRIVE)
    at = middle(pad)
    page.mouse.move(at["x"], at["y"])
    page.mouse.down()
    page.mouse.move(at["x"], at["y"] + 500, steps=4)
    assert wheels_hear(robot, -0.4, 0.0, DRIVE)
    page.mouse.up()
    assert wheels_hear(robot, 0.0, 0.0, DRIVE)
    expect(page.locator("#events")).to_contain_text("drives motors of a by hand: a/client/Go waits")
    page.keyboard.press("Escape")
    assert wheels_hear(robot, 0.1, 0.0, GO)
    expect(drive.get_by_role("button", name="Drive", exact=True)).to_be_visible()
    assert faults == []


@pytest.mark.parametrize("leaves", ["closes the page", "closes the panel", "loses the network"])
def test_robot_stops_and_goes_on_if_the_person_leaves(robot: Rig, browser: Any, faults: list[str], leaves: str):
    page = opened(browser, view(robot, "--control"), faults)
    drive = panel(page)
    drive.get_by_role("button", name="Drive", exact=True).click()
    expect(drive.get_by_role("application")).to_be_focused()
    page.keyboard.down("w")
    assert wheels_hear(robot, 0.2, 0.0, DRIVE)
    if leaves == "closes the page":
        page.close()
    elif leaves == "closes the panel":
        page.get_by_role("button", name="Close").first.click()
    else:
        page.evaluate("() => { WebSocket.prototype.send = () => {}; }")
    assert wheels_hear(robot, 0.1, 0.0, GO)
    assert faults == []


def test_page_only_asks_to_stand_while_an_answer_is_missing(robot: Rig, browser: Any, faults: list[str]):
    """The network may deliver all that it sent meanwhile at once."""
    page = opened(browser, view(robot, "--control"), faults)
    drive = panel(page)
    drive.get_by_role("button", name="Drive", exact=True).click()
    expect(drive.get_by_role("application")).to_be_focused()
    page.keyboard.down("w")
    assert wheels_hear(robot, 0.2, 0.0, DRIVE)
    page.evaluate(
        """() => {
          window.lost = [];
          const whole = WebSocket.prototype.send;
          WebSocket.prototype.send = function (text) {
            const { do: what, v_mps } = JSON.parse(text);
            if (what !== "drive") return whole.call(this, text);
            lost.push(v_mps);
            if (lost.length === 3) WebSocket.prototype.send = whole;
          };
        }"""
    )
    page.wait_for_function("() => lost.length === 3")
    assert page.evaluate("() => lost") == [0.2, 0, 0]
    assert wheels_hear(robot, 0.2, 0.0, DRIVE), "it is back, and the key is still held"
    assert faults == []


def test_second_page_sees_who_drives_and_takes_over(robot: Rig, browser: Any, faults: list[str]):
    address = view(robot, "--control")
    pages = [opened(browser, address, faults) for _ in range(2)]
    first, second = map(panel, pages)
    first.get_by_role("button", name="Drive", exact=True).click()
    expect(first.get_by_role("application")).to_be_visible()
    take = second.get_by_role("button", name="Take over from")
    take.click()
    expect(second.get_by_role("application")).to_be_visible()
    expect(first).to_contain_text("has taken over motors")
    expect(first.get_by_role("application")).to_be_hidden()
    second.get_by_role("button", name="End the drive").click()
    assert wheels_hear(robot, 0.1, 0.0, GO)
    assert faults == []


def test_page_without_control_cannot_drive(robot: Rig, browser: Any, faults: list[str]):
    page = opened(browser, view(robot), faults)
    expect(chip(page, "a", "Go")).to_be_visible()
    expect(page.get_by_role("button", name="Drive …", exact=True)).to_be_hidden()
    page.locator("summary").first.click()
    chip(page, "a", "motors").get_by_role("button").click()
    expect(page.locator("#inspector")).to_contain_text("motors on a")
    expect(page.locator("section.drive")).to_be_hidden()
    assert faults == []
