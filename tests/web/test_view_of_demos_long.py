"""`pancakes demo --view`, in virtual time and live."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

from cli.processes import Rig
from web.browsing import fetched
from websockets.sync.client import connect
from websockets.typing import Origin

PATIENCE_S = 30.0
CONFIGS = Path(__file__).parents[2] / "configs" / "encirclement"


def test_demo_page_stays_after_the_end(rig: Rig):
    arguments = ["encirclement", "--virtual", "--view", "--speed", "50", "--duration", "5", "--configs", str(CONFIGS)]
    demo = rig.run("-u", "-m", "pancakes.tools.cli.main", "demo", *arguments, whole=True)
    address = demo.hear("the page is at ").rpartition(" ")[2]
    demo.hear("verdict: ")
    demo.hear(f"the page stays at {address} until Ctrl-C")

    assert "<title>Pancakes</title>" in fetched(address)
    code, _ = demo.signalled(signal.SIGINT)
    assert code == 1  # so short a mission fails


def test_demo_page_shows_a_live_mission_to_its_end(rig: Rig):
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
