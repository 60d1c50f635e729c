"""Helpers for the tests of the page in a browser."""

from __future__ import annotations

import urllib.request
from typing import Any

from cli.processes import Rig

PATIENCE_MS = 30_000
PHONE = {"width": 360, "height": 740}

WALK = """
from pancakes.task import Task, Tick, every

class Walk(Task):
    @every(hz=4)
    def step(self, tick: Tick) -> None:
        pass
"""
WALKING = '[task.Walk]\ntype = "walk.Walk"\n'


def expect(target: Any) -> Any:
    from playwright.sync_api import expect

    expect.set_options(timeout=PATIENCE_MS)
    return expect(target)


def opened(browser: Any, address: str, faults: list[str], **options: Any) -> Any:
    """Open the page in a context of its own."""
    page = browser.new_context(**{"viewport": {"width": 1280, "height": 860}, **options}).new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.goto(address)
    return page


def chip(page: Any, agent: str, task: str) -> Any:
    return page.locator(f"[data-agent={agent}] [data-task={task}]")


def view(rig: Rig, *options: str) -> str:
    return (
        rig.run("-u", "-m", "pancakes.tools.cli.main", "view", *options, whole=True)
        .hear("the page is at ")
        .rpartition(" ")[2]
    )


def fetched(address: str) -> str:
    """Return the page at an address, without what only a browser would load."""
    with urllib.request.urlopen(address.partition("#")[0], timeout=20.0) as response:
        return str(response.read().decode())


def drag(page: Any, source: Any, target: Any) -> None:
    """Drag one element onto another in small steps, like a hand."""
    start, end = place(source), place(target)
    page.mouse.move(start["x"] + 30, start["y"] + 10)
    page.mouse.down()
    page.mouse.move(end["x"] + 60, end["y"] + 30, steps=8)
    page.mouse.up()


def place(target: Any) -> Any:
    """Return where something is on the page, once it is there: a card that is drawn again may hide it for a moment."""
    while (box := target.bounding_box()) is None:
        target.wait_for()  # to be seen; it has a limit of its own
    return box


def middle(target: Any) -> dict[str, float]:
    box = place(target)
    return {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
