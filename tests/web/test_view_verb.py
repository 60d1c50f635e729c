"""`pancakes view` and `pancakes demo --view`, as a person starts them."""

from __future__ import annotations

import json
import signal
import urllib.request
from pathlib import Path
from typing import Any

from cli.processes import Rig
from websockets.sync.client import connect
from websockets.typing import Origin

PATIENCE_S = 30.0
CONFIGS = Path(__file__).parents[2] / "configs" / "encirclement"


def fetched(address: str) -> str:
    with urllib.request.urlopen(address.partition("#")[0], timeout=20.0) as response:
        return str(response.read().decode())


def test_the_address_is_printed_and_the_page_is_there_until_it_is_ended(rig: Rig):
    rig.ready("a")
    view = rig.run("-m", "pancakes.tools.cli.main", "view", whole=True)
    address = view.hear("the page is at ").rpartition(" ")[2]

    assert "<title>Pancakes</title>" in fetched(address)
    assert len(address.partition("#token=")[2]) >= 32
    code, took_s = view.signalled(signal.SIGINT)
    assert code == 0 and took_s < 5.0


def test_with_control_the_address_has_a_token_and_programs_get_it_as_json(rig: Rig):
    rig.ready("a")
    view = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--control", "--format", "json", whole=True)
    view.hear("]")

    (told,) = json.loads("\n".join(view.said))
    assert told["control"] is True
    assert len(told["address"].partition("#token=")[2]) >= 32


def test_without_agents_there_is_nothing_to_show(rig: Rig):
    ended = rig.pancakes("view")

    assert ended.returncode == 3
    assert "no agent runs" in ended.stderr


def test_of_several_fleets_one_has_to_be_named(rig: Rig):
    rig.ready("a", fleet="one")
    rig.ready("b", fleet="two")
    ended = rig.pancakes("view")

    assert ended.returncode == 1
    assert ended.stderr == "there are several fleets, one, two: name one with --fleet\n"


def test_where_the_library_is_missing_it_is_named(rig: Rig):
    rig.ready("a")
    (rig.plugins / "websockets").mkdir()
    (rig.plugins / "websockets" / "__init__.py").write_text("raise ModuleNotFoundError(name='websockets')")
    ended = rig.pancakes("view")

    assert ended.returncode == 1
    assert "pip install 'pancakes-agents[web]'" in ended.stderr


def test_a_demo_with_a_page_says_where_it_is_and_stays_after_its_end(rig: Rig):
    arguments = ["encirclement", "--virtual", "--view", "--speed", "50", "--duration", "5", "--configs", str(CONFIGS)]
    demo = rig.run("-u", "-m", "pancakes.tools.cli.main", "demo", *arguments, whole=True)
    address = demo.hear("the page is at ").rpartition(" ")[2]
    demo.hear("verdict: ")
    demo.hear(f"the page stays at {address} until Ctrl-C")

    assert "<title>Pancakes</title>" in fetched(address)
    code, _ = demo.signalled(signal.SIGINT)
    assert code == 1  # so short a mission fails


def test_a_live_demo_is_seen_from_its_beginning_to_its_end_and_not_how_its_agents_stop(rig: Rig):
    arguments = ["encirclement", "--view", "--headless", "--speed", "5", "--duration", "30", "--configs", str(CONFIGS)]
    demo = rig.run("-u", "-m", "pancakes.tools.cli.main", "demo", *arguments, whole=True)
    address, _, token = demo.hear("the page is at ").rpartition(" ")[2].partition("/#token=")
    seen: dict[str, Any] = {}
    events: list[str] = []
    with connect(address.replace("http", "ws") + "/news", origin=Origin(address), compression=None) as page:
        page.send(json.dumps({"ask": "hello", "token": token}))
        news: dict[str, Any] = {}
        while "over" not in news:
            news = json.loads(page.recv(PATIENCE_S))
            seen.update(news.get("set", {}))
            events += [event["kind"] for event in news.get("events", ())]

    assert {"arena", "body/agent1", "battery/agent2", "rays/agent1/ir", "link/agent1/world"} <= set(seen)
    assert seen["task/agent1/client/ScanTarget"]["state"] == "running"
    assert "new_centre" in events and "service_stopped" not in events
    assert 25.0 < news["m"] < 75.0  # a busy machine sees the end late, five times as fast


def test_options_that_make_no_sense_together_are_refused(rig: Rig):
    alone = rig.pancakes("demo", "encirclement", "--control")
    virtual = rig.pancakes("demo", "encirclement", "--view", "--control", "--virtual")

    assert alone.returncode == virtual.returncode == 2
    assert "they need --view" in alone.stderr
    assert "--control does not go with --virtual" in virtual.stderr
