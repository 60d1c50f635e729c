"""Agents that run are watched as a client of theirs."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from cli.processes import Rig

from pancakes.control import Reschedule, Stop
from pancakes.errors import UnreachableError
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.watch import Watch

PATIENCE_S = 20.0
LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 5\n'


class Telling(Feed):
    """A feed that tells whenever something may have come."""

    def __init__(self) -> None:
        began_s = time.monotonic()
        super().__init__(lambda: time.monotonic() - began_s)
        self.news = threading.Condition()

    def record(self) -> None:
        super().record()
        self._tell()

    def wait_for(self, reason: str) -> None:
        super().wait_for(reason)
        self._tell()

    def _tell(self) -> None:
        with self.news:
            self.news.notify_all()


class Seen:
    """Waits for what is to be seen."""

    def __init__(self) -> None:
        self.feed = Telling()

    def wait(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait until the frame with everything meets a condition; return it."""
        frame: dict[str, Any] = {}

        def met() -> bool:
            frame.clear()
            frame.update(json.loads(self.feed.frame(None)[0]))
            return condition(frame)

        with self.feed.news:
            assert self.feed.news.wait_for(met, PATIENCE_S), frame
        return frame


@pytest.fixture
def seen() -> Seen:
    return Seen()


@pytest.fixture
def watch(rig: Rig, seen: Seen, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watch]:
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(rig.runtime))
    watch = Watch(seen.feed)
    yield watch
    watch.close()


def test_watch_sees_agents_tasks_links_and_earlier_events(rig: Rig, seen: Seen, watch: Watch):
    first = rig.ready("a", LOAD)
    rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    watch.start()

    frame = seen.wait(lambda it: "link/a/b" in it["set"] and any(e["kind"] == "ready" for e in it.get("events", ())))

    assert frame["set"]["agent/a"]["state"] == "ready"
    assert frame["set"]["agent/a"]["devices"] == ["load"]
    assert frame["set"]["task/a/device/load"]["rate_hz"] == 5.0
    seen.wait(lambda it: (it["set"]["task/a/device/load"]["achieved_hz"] or 0.0) > 3.0)


def test_watch_sees_agents_that_come_and_go(rig: Rig, seen: Seen, watch: Watch):
    watch.start()
    seen.wait(lambda it: "no agent runs" in it.get("waiting", ""))
    running = rig.ready("a", LOAD)
    seen.wait(lambda it: it["set"].get("agent/a", {}).get("state") == "ready" and "waiting" not in it)

    running.close()
    seen.wait(lambda it: it["set"]["agent/a"]["state"] == "no answer")


def test_watch_reports_a_fleet_that_ended_and_came_back(rig: Rig, seen: Seen, watch: Watch):
    running = rig.ready("a", LOAD)
    watch.start()
    seen.wait(lambda it: it["set"].get("agent/a", {}).get("state") == "ready" and "over" not in it)
    running.close()
    ended = seen.wait(lambda it: "over" in it)
    assert "the fleet has ended" in ended["over"]
    assert seen.feed.now() == pytest.approx(ended["t"], abs=0.002), "nothing happens any more, so no time passes"
    assert json.loads(seen.feed.chunk(ended["t"])), "what was can still be looked at"

    rig.ready("a", LOAD)
    back = seen.wait(lambda it: "over" not in it and it["set"]["agent/a"]["state"] == "ready")
    assert back["t"] >= ended["t"]


STEER = """
from pancakes.devices import Load
from pancakes.task import Task, on

class Steer(Task):
    @on("system", Load)
    def steer(self, packet):
        if packet.destination or not packet.source.startswith(self.agent):
            self.publish("ctrl", Load(packet.body.cpu))

class Tell(Task):
    @on("system", Load)
    def tell(self, packet):
        self.publish("system", Load(packet.body.cpu), to="*")
"""


def test_watch_explains_commands_across_agents(rig: Rig, seen: Seen, watch: Watch):
    rig.install("steer", "[pancakes.tasks]\nsteer.Steer = plugin_steer:Steer\nsteer.Tell = plugin_steer:Tell\n", STEER)
    first = rig.ready("a", LOAD + '[task.Tell]\ntype = "steer.Tell"\n')
    second = rig.ready("b", '[task.Steer]\ntype = "steer.Steer"\n', agent=f'peers = ["{rig.address(first)}"]')
    watch.start()
    seen.wait(lambda it: it["set"].get("commands/b") == ["load"])

    def explained(**asked: Any) -> dict[str, Any]:
        found = watch.explain("b", **asked)
        assert found is not None
        return found

    seen.wait(lambda it: explained()["count"] >= 5 and len(explained()["steps"]) == 3)
    steps = explained()["steps"]
    assert [(step["source"], step["type"]) for step in steps] == [
        ("a/device/load", "load"), ("a/client/Tell", "load"), ("b/client/Steer", "load"),
    ]  # fmt: skip
    assert steps[1]["travel_ms"] > 0.0 and steps[0]["travel_ms"] == 0.0
    assert sum(step["travel_ms"] + step["handling_ms"] for step in steps) == pytest.approx(steps[-1]["at_ms"], abs=0.01)
    newest = explained()
    before = explained(command=(newest["source"], newest["seq"]), step=-1)
    assert (before["seq"], before["place"]) == (newest["seq"] - 1, newest["place"] - 1)
    assert explained(t=before["t"] + 0.01)["seq"] == before["seq"]

    second.close()
    first.close()
    seen.wait(lambda it: "over" in it)
    assert explained(command=(newest["source"], newest["seq"]))["mission_s"] == newest["mission_s"]


def test_watch_passes_orders_on(rig: Rig, seen: Seen, watch: Watch):
    rig.ready("a", LOAD)
    watch.start()
    seen.wait(lambda it: "task/a/device/load" in it["set"])

    assert watch.order("a", Reschedule("device/load", 7.0), PATIENCE_S).result(PATIENCE_S).ok
    frame = seen.wait(lambda it: it["set"]["task/a/device/load"]["rate_hz"] == 7.0)
    assert any(it["kind"] == "rate_changed" and it["task"] == "load" for it in frame["events"])
    refused = watch.order("a", Stop("client/Nobody"), PATIENCE_S).result(PATIENCE_S)
    assert not refused.ok and "Nobody" in refused.reason
    with pytest.raises(UnreachableError, match="b cannot be reached"):
        watch.order("b", Stop("client/T"), PATIENCE_S).result(PATIENCE_S)


KEEP = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Keep(Task):
    @dataclass
    class State:
        count: int = 41

    def on_start(self):
        self.state.count += 1
"""


def test_watch_keeps_states_on_the_timeline(rig: Rig, seen: Seen, watch: Watch):
    rig.install("keep", "[pancakes.tasks]\nkeep.Keep = plugin_keep:Keep\n", KEEP)
    rig.ready("a", '[task.Keep]\ntype = "keep.Keep"\n')
    watch.start()

    def kept() -> Any:
        with seen.feed.lock:
            return seen.feed.states.at("a/client/Keep", seen.feed.now())

    seen.wait(lambda it: kept() is not None)
    assert kept()[1].rows == (("count", "42"),)


def test_watch_that_has_ended_asks_nobody(rig: Rig, seen: Seen, watch: Watch):
    rig.ready("a", LOAD)
    watch.start()
    seen.wait(lambda it: "agent/a" in it["set"])
    watch.close()

    with pytest.raises(UnreachableError, match="its agents no longer answer"):
        watch.order("a", Stop("device/load"), PATIENCE_S).result(PATIENCE_S)


TALK = """
import msgspec
from pancakes import Task, every, packet_type

@packet_type("gust")
class Gust(msgspec.Struct, frozen=True):
    speed_mps: float

class Talk(Task):
    @every(hz=10)
    def talk(self, tick):
        self.publish("weather", Gust(3.5))
"""


def test_watch_follows_packets_that_a_page_plots(rig: Rig, seen: Seen, watch: Watch):
    """Also of a channel that a task made, and of a type that is unknown here."""
    rig.install("talk", "[pancakes.tasks]\ntalk.Talk = plugin_talk:Talk\n", TALK)
    rig.ready("a", LOAD + '[channel.weather]\n[task.Talk]\ntype = "talk.Talk"\n')
    watch.start()
    seen.wait(lambda it: "agent/a" in it["set"])
    assert seen.feed.find_series("gust", 10)["rows"] == []

    names = ["a/client/Talk gust speed_mps", "a/device/load load cpu"]
    seen.wait(lambda it: len(seen.feed.plot(names, [-1.0, -1.0])) == 2)
    assert seen.feed.find_series("talk gust", 10)["rows"] == [("a/client/Talk gust speed_mps", "m/s", 3.5)]
    assert seen.feed.plot(names, [-1.0, -1.0])["a/device/load load cpu"][2][0] >= 0.0
