"""`pancakes view`, as a person starts it."""

from __future__ import annotations

import json
import signal
import socket
from typing import Any

from cli.processes import Rig
from web.browsing import WALK, WALKING, chip, expect, fetched, opened


def test_view_serves_its_page_until_stopped(rig: Rig):
    rig.ready("a")
    view = rig.run("-m", "pancakes.tools.cli.main", "view", whole=True)
    address = view.hear("the page is at ").rpartition(" ")[2]

    assert "<title>Pancakes</title>" in fetched(address)
    assert len(address.partition("#token=")[2]) >= 32
    code, took_s = view.signalled(signal.SIGINT)
    assert code == 0 and took_s < 5.0


def test_view_with_control_prints_its_token_as_json(rig: Rig):
    rig.ready("a")
    view = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--control", "--format", "json", whole=True)
    view.hear("]")

    (printed,) = json.loads("\n".join(view.said))
    assert printed["control"] is True
    assert len(printed["address"].partition("#token=")[2]) >= 32


def test_view_names_the_extra_if_its_library_is_missing(rig: Rig):
    rig.ready("a")
    (rig.plugins / "websockets").mkdir()
    (rig.plugins / "websockets" / "__init__.py").write_text("raise ModuleNotFoundError(name='websockets')")
    ended = rig.pancakes("view")

    assert ended.returncode == 1
    assert "pip install 'pancakes-agents[web]'" in ended.stderr


def test_view_names_the_fleets_if_there_are_several(rig: Rig):
    rig.ready("a", fleet="one")
    rig.ready("b", fleet="two")
    ended = rig.pancakes("view")

    assert ended.returncode == 1
    assert "one, two" in ended.stderr and "--fleet" in ended.stderr


def test_view_waits_for_agents(rig: Rig, browser: Any, faults: list[str]):
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    running = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", whole=True)
    running.hear("the page waits for agents: no agent runs")
    page = opened(browser, running.hear("the page is at ").rpartition(" ")[2], faults)
    none = page.locator("#none")
    expect(none).to_contain_text("No agents yet")
    expect(none).to_contain_text("no agent runs on this machine")
    expect(none).to_contain_text("pancakes demo encirclement")
    expect(page.locator("#status")).to_have_text("waiting")

    rig.ready("a", WALKING)
    expect(chip(page, "a", "Walk")).to_have_attribute("data-state", "running")
    expect(none).to_be_hidden()
    expect(page.locator("#status")).to_have_text("live")
    assert faults == []


def test_page_comes_back_after_its_server_has_restarted(rig: Rig, browser: Any, faults: list[str]):
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    rig.ready("a", WALKING)
    port = str(free_port())
    first = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--port", port, whole=True)
    address = first.hear("the page is at ").rpartition(" ")[2]
    page = opened(browser, address, [])
    page.on("pageerror", lambda error: faults.append(str(error)))
    chip(page, "a", "Walk").get_by_role("button").click()
    expect(page.get_by_role("dialog", name="Walk on a")).to_be_visible()
    first.signalled(signal.SIGINT)
    expect(page.locator("#waiting")).to_contain_text("lost its server. It tries again every second")

    again = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--port", port, whole=True)
    assert again.hear("the page is at ").rpartition(" ")[2] == address
    expect(page.locator("#status")).to_have_text("live")
    expect(page.locator("#waiting")).to_be_hidden()
    expect(page.get_by_role("dialog", name="Walk on a")).to_be_visible()
    again.signalled(signal.SIGINT)

    # With control it is another page: what was passed on to look does not let others act.
    acting = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--control", "--port", port, whole=True)
    assert acting.hear("the page is at ").rpartition(" ")[2] != address
    expect(page.locator("#waiting")).to_contain_text("open the page at the address that was printed")
    assert faults == []


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])
