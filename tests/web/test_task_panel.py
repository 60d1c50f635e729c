"""The state, settings and rates of a task of a real agent on the page, in a real browser."""

from __future__ import annotations

import re
from typing import Any

import pytest
from cli.processes import Rig
from web.browsing import PHONE, chip, expect, opened, view

STROLL = """
from dataclasses import dataclass, field
from typing import Annotated, Literal

import msgspec
import numpy as np

from pancakes.task import Task, every

@dataclass
class Legs:
    length_m: Annotated[float, msgspec.Meta(gt=0)] = 0.5
    count: int = 4

class Stroll(Task):
    @dataclass
    class Settings:
        '''How it strolls.

        Attributes:
            step_m: how far it goes at once.
        '''

        step_m: Annotated[float, msgspec.Meta(ge=0.1, le=2.0)] = 0.5
        gait: Literal["trot", "pace"] = "trot"
        careful: bool = False
        most_steps: int | None = None
        route: tuple[float, ...] = (1.0, 2.0)
        legs: Legs = field(default_factory=Legs)

    @dataclass
    class State:
        step_m: float = 0.0
        steps: int = 0
        looks: int = 0
        how: str = ""
        grid: np.ndarray = field(default_factory=lambda: np.zeros((40, 25)))

    @every(hz=20)
    def step(self, tick):
        self.state.steps += 1
        self.state.step_m = self.settings.step_m
        self.state.how = f"{self.settings.gait} {self.settings.careful} {self.settings.legs.count}"

    @every(hz=0)
    def look(self, tick):
        self.state.looks += 1
"""


@pytest.fixture
def strolling(rig: Rig) -> Rig:
    rig.install("stroll", "[pancakes.tasks]\nstroll.Stroll = plugin_stroll:Stroll\n", STROLL)
    rig.ready("a", '[task.Stroll]\ntype = "stroll.Stroll"\nsettings = { legs = { length_m = 0.75 } }\n')
    return rig


def described(rig: Rig) -> dict[str, Any]:
    (row,) = rig.listed("task", "info", "a/Stroll")
    return row


def settings_of(rig: Rig) -> dict[str, Any]:
    settings: dict[str, Any] = described(rig)["settings"]
    return settings


def shown(part: Any, name: str) -> Any:
    """Return the text of a field of the state."""
    return part.locator(f"dt:text-is('{name}') + dd")


def opened_task(browser: Any, address: str, faults: list[str], **options: Any) -> Any:
    page = opened(browser, address, faults, **options)
    expect(chip(page, "a", "Stroll")).to_have_attribute("data-state", "running")
    chip(page, "a", "Stroll").get_by_role("button").press("Enter")
    return page


def test_settings_and_rates_are_changed_on_the_page(strolling: Rig, browser: Any, faults: list[str]):
    page = opened_task(browser, view(strolling, "--control"), faults)
    dialog = page.get_by_role("dialog")
    state = dialog.get_by_role("region", name="State", exact=True)
    form = dialog.get_by_role("form", name="Settings")
    step, said = form.get_by_role("spinbutton", name="step_m"), form.get_by_role("status")
    check, change = form.get_by_role("button", name="Check"), form.get_by_role("button", name="Apply")
    field = form.locator("[data-setting=step_m]")

    # What it keeps in its state is seen as it changes, and how old that is.
    expect(shown(state, "step_m")).to_have_text("0.5")
    expect(state).to_contain_text(re.compile(r"State \d+\.\d s old"))
    first = int(shown(state, "steps").inner_text())
    page.wait_for_function(
        "(first) => [...document.querySelectorAll('.state dt')].some("
        "(it) => it.textContent === 'steps' && Number(it.nextSibling.textContent) > first)",
        arg=first,
    )

    # A setting has its bounds, its default and its words; the agent refuses what lies beyond them.
    expect(field).to_contain_text("how far it goes at once · number, ≥ 0.1, ≤ 2 · default 0.5")
    expect(step).to_have_attribute("max", "2")
    step.fill("7")
    form.get_by_role("checkbox", name="careful").check()
    change.click()
    expect(field.locator(".refusal")).to_have_text("expected a number <= 2, not 7")
    expect(step).to_be_focused()
    expect(step).to_have_attribute("aria-invalid", "true")
    expect(said).to_contain_text("nothing has changed")
    before = settings_of(strolling)
    assert (before["step_m"], before["careful"]) == (0.5, False), "one of them is bad, so none is taken"

    # A dry run changes nothing.
    step.fill("1.5")
    check.click()
    expect(said).to_have_text("the agent would take step_m, careful; nothing has changed yet")
    expect(field.locator(".refusal")).to_be_hidden()
    assert settings_of(strolling) == before
    expect(shown(state, "how")).to_have_text("trot False 4")

    # All at once: number, choice, truth, what may be nothing, a list, and one of a table; the task goes by them.
    form.get_by_label("gait").select_option("pace")
    form.get_by_label("most_steps").fill("9")
    form.get_by_label("legs.count").fill("6")
    route = form.get_by_label("route")
    route.fill("[1, 2")
    change.click()
    expect(form.locator("[data-setting=route] .refusal")).to_contain_text("this is not JSON")
    route.fill("[9007199254740993]")
    change.click()
    expect(form.locator("[data-setting=route] .refusal")).to_contain_text("a browser cannot represent this integer")
    route.fill("[3, 4.5]")
    change.click()
    expect(said).to_have_text("set: step_m, gait, careful, most_steps, route, legs.count")
    expect(shown(state, "step_m")).to_have_text("1.5")
    expect(shown(state, "how")).to_have_text("pace True 6")
    assert settings_of(strolling) == {
        "step_m": 1.5, "gait": "pace", "careful": True, "most_steps": 9, "route": [3.0, 4.5],
        "legs": {"length_m": 0.75, "count": 6},
    }  # fmt: skip

    # What another person sets is seen; what may be nothing is so again, by an empty field; a slider does as well.
    assert strolling.pancakes("param", "set", "a/Stroll", "gait=trot").returncode == 0
    expect(form.get_by_label("gait")).to_have_value("1")
    form.get_by_label("most_steps").fill("")
    field.locator("input[type=range]").fill("1")
    change.click()
    expect(said).to_have_text("set: step_m, most_steps")
    after = settings_of(strolling)
    assert (after["step_m"], after["most_steps"], after["gait"]) == (1.0, None, "trot")

    # Rates are checked first as well, each timer's by itself.
    rates = dialog.get_by_role("form", name="Rates")
    look = rates.get_by_role("spinbutton", name="look")
    look.fill("20000")
    rates.get_by_role("button", name="Apply").click()
    expect(rates.locator("[data-setting=look] .refusal")).to_contain_text("between 0 and 10,000 ticks a second")
    look.fill("5")
    rates.get_by_role("button", name="Check").click()
    expect(rates.get_by_role("status")).to_have_text("the agent would take look; nothing has changed yet")
    assert [timer["rate_hz"] for timer in described(strolling)["timers"]] == [20.0, 0.0]
    look.press("Enter")
    expect(rates.get_by_role("status")).to_have_text("set: look")
    expect(shown(state, "looks")).not_to_have_text("0")
    assert faults == []


def test_panel_without_control_shows_past_states(strolling: Rig, browser: Any, faults: list[str]):
    page = opened_task(browser, view(strolling), faults, viewport=PHONE, color_scheme="dark")
    dialog = page.get_by_role("dialog")
    state = dialog.get_by_role("region", name="State", exact=True)
    form = dialog.get_by_role("form", name="Settings")

    expect(form.locator("[data-setting=step_m]")).to_contain_text("number, ≥ 0.1, ≤ 2 · default 0.5")
    expect(form.locator("[data-setting='legs.count'] .value")).to_have_text("4")
    expect(dialog.get_by_role("form", name="Rates").locator("[data-setting=step] .value")).to_have_text("20")
    assert dialog.locator("input, select, textarea").count() == 0
    expect(dialog.get_by_role("button")).to_have_text(["Close", "Plot its rate", "Plot its lateness"])
    expect(shown(state, "grid")).to_have_text(re.compile(r"^\[\[0, 0, .*… \(float64, 40 x 25\)$"))
    expect(state).to_contain_text("pancakes task info a/client/Stroll --state --format json")
    assert page.evaluate("document.querySelector('dialog[open]').scrollWidth") <= PHONE["width"]

    # A task that does not run has settings, and no state.
    assert strolling.pancakes("task", "stop", "a/Stroll").returncode == 0
    expect(state).to_contain_text("a/client/Stroll is stopped, not running")
    expect(form.locator("[data-setting=gait] .value")).to_have_text("trot")
    page.keyboard.press("Escape")

    # What was seen of it is in the past.
    page.get_by_role("slider", name="Time").focus()
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#status")).to_have_text("past")
    chip(page, "a", "Stroll").get_by_role("button").press("Enter")
    expect(state).to_contain_text(re.compile(r"as seen \d+\.\d s before this moment"))
    expect(shown(state, "step_m")).to_have_text("0.5")
    expect(form).to_contain_text("Go back to live to see its settings.")
    assert faults == []
