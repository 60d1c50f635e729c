"""Agents that run are watched as a client of theirs; a run in virtual time is not changed by being watched."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig

from pancakes.control import Describe, Reschedule, Stop
from pancakes.errors import ControlRefused, Unreachable
from pancakes.fleet import VirtualFleet
from pancakes.runtime.config import parse
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.virtual_watch import VirtualWatch
from pancakes.tools.web.watch import Watch, fleet_among

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
        """Waits until the frame with everything meets a condition; returns it."""
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


def test_agents_their_tasks_and_links_are_seen_and_what_was_said_before(rig: Rig, seen: Seen, watch: Watch):
    first = rig.ready("a", LOAD)
    rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    watch.start()

    frame = seen.wait(lambda it: "link/a/b" in it["set"] and any(e["kind"] == "ready" for e in it.get("events", ())))

    assert frame["set"]["agent/a"]["state"] == "ready"
    assert frame["set"]["agent/a"]["devices"] == ["load"]
    assert frame["set"]["task/a/device/load"]["rate_hz"] == 5.0
    seen.wait(lambda it: (it["set"]["task/a/device/load"]["achieved_hz"] or 0.0) > 3.0)


def test_an_agent_that_comes_later_is_seen_and_one_that_goes_is_seen_to_be_silent(rig: Rig, seen: Seen, watch: Watch):
    watch.start()
    seen.wait(lambda it: "no agent runs" in it.get("waiting", ""))
    running = rig.ready("a", LOAD)
    seen.wait(lambda it: it["set"].get("agent/a", {}).get("state") == "ready" and "waiting" not in it)

    running.close()
    seen.wait(lambda it: it["set"]["agent/a"]["state"] == "no answer")


def test_a_fleet_that_has_ended_is_said_to_have_ended_until_somebody_comes_back(rig: Rig, seen: Seen, watch: Watch):
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
from pancakes.bodies.devices.types import Load
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


def test_any_command_is_led_back_over_agents_and_is_still_known_when_the_fleet_has_gone(
    rig: Rig, seen: Seen, watch: Watch
):
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


def test_what_is_asked_for_is_done_and_seen(rig: Rig, seen: Seen, watch: Watch):
    rig.ready("a", LOAD)
    watch.start()
    seen.wait(lambda it: "task/a/device/load" in it["set"])

    assert watch.order("a", Reschedule("device/load", 7.0), PATIENCE_S).result(PATIENCE_S).ok
    frame = seen.wait(lambda it: it["set"]["task/a/device/load"]["rate_hz"] == 7.0)
    assert any(it["kind"] == "rate_changed" and it["task"] == "load" for it in frame["events"])
    refused = watch.order("a", Stop("client/Nobody"), PATIENCE_S).result(PATIENCE_S)
    assert not refused.ok and "Nobody" in refused.reason
    with pytest.raises(Unreachable, match="b cannot be reached"):
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


def test_the_timeline_has_what_tasks_keep_in_their_state(rig: Rig, seen: Seen, watch: Watch):
    rig.install("keep", "[pancakes.tasks]\nkeep.Keep = plugin_keep:Keep\n", KEEP)
    rig.ready("a", '[task.Keep]\ntype = "keep.Keep"\n')
    watch.start()

    def kept() -> Any:
        with seen.feed.lock:
            return seen.feed.states.at("a/client/Keep", seen.feed.now())

    seen.wait(lambda it: kept() is not None)
    assert kept()[1].rows == (("count", "42"),)


def test_nobody_is_asked_any_more_once_the_watch_has_ended(rig: Rig, seen: Seen, watch: Watch):
    rig.ready("a", LOAD)
    watch.start()
    seen.wait(lambda it: "agent/a" in it["set"])
    watch.close()

    with pytest.raises(Unreachable, match="no agent can be asked any more"):
        watch.order("a", Stop("device/load"), PATIENCE_S).result(PATIENCE_S)


def test_the_fleet_has_to_be_named_where_there_are_several():
    rows = [{"fleet": "one"}, {"fleet": "two"}, {"fleet": "one"}]

    assert fleet_among(rows[:1]) == "one"
    assert fleet_among(rows, "two") == "two"
    with pytest.raises(ControlRefused, match="several fleets, one, two: name one with --fleet"):
        fleet_among(rows)
    with pytest.raises(Unreachable, match="no agent of the fleet 'three', only of one, two"):
        fleet_among(rows, "three")


# In virtual time

ENCIRCLEMENT = Path(__file__).parents[2] / "configs" / "encirclement"


def fly(watch: VirtualWatch | None, place: Path) -> list[dict[str, Any]]:
    """Runs the first seconds of a mission; returns what its agents ended up as."""
    fleet = VirtualFleet(seed=3)
    try:
        for name in ("world", "agent1", "sensor"):
            text = (ENCIRCLEMENT / f"{name}.toml").read_text().replace("hold = true", "hold = false")
            text = text.replace("[agent]", "[agent]\nseed = 3\nbirth_wait_s = 0").replace(
                "trajectory.csv", f"{place}/trajectory.csv"
            )
            fleet.start(parse(text, where=name))
        if watch is not None:
            watch.begin(fleet)
        states: list[Any] = []
        fleet.agents["world"].kernel.stream.tap("system", lambda packet: states.append(packet.body))
        until_s = fleet.now() + 8.0
        while fleet.now() < until_s:
            fleet.run_until(min(until_s, fleet.now() + (watch.slice_s() if watch is not None else 8.0)))
            if watch is not None:
                watch.pace()
        return [states[-1], fleet.agents["agent1"].mesh.describe()]
    finally:
        if watch is not None:
            watch.end()
        fleet.close()


def test_a_virtual_run_is_shown_and_stays_the_same_run(tmp_path: Path):
    stopped = threading.Event()
    stopped.set()  # nobody watches, so it need not wait
    watch = VirtualWatch(5.0, stopped)

    assert fly(watch, tmp_path) == fly(None, tmp_path)

    frame = json.loads(watch.feed.frame(None)[0])
    assert frame["set"]["arena"] == [4.0, 3.0]
    assert {"body/agent1", "rays/agent1/ir", "motion/sensor", "battery/agent1"} <= set(frame["set"])
    assert frame["set"]["circle/agent1/ScanTarget"][2] == 0.55
    assert frame["t"] == pytest.approx(8.0 / 5.0, abs=0.1)
    assert frame["set"]["task/agent1/client/ScanTarget"]["state"] == "running"  # that it was stopped is no part of it
    assert json.loads(watch.feed.chunk(1.0))["frames"]
    seen = watch.feed.states.at("agent1/client/ScanTarget", 1.5)
    assert seen is not None and "centre_m" in dict(seen[1].rows), "the timeline has what it kept in its state"
    explained = watch.explain("agent1")
    assert explained is not None
    assert [step["type"] for step in explained["steps"][-2:]] == ["pose", "motors"]


def test_in_a_virtual_run_a_task_is_looked_at_between_two_turns():
    stopped = threading.Event()
    stopped.set()
    watch = VirtualWatch(5.0, stopped)
    text = 'schema = 1\n[agent]\nname = "a"\nbirth_wait_s = 0\n[device.pose]\ndriver = "null.pose"\nrate_hz = 5\n'
    with closing(VirtualFleet()) as fleet:
        fleet.start(parse(text, where="a"))
        watch.begin(fleet)
        asked = [
            watch.look(agent, Describe(target, state=state), 3.0)
            for agent, target in (("a", "device/pose"), ("a", "device/sonar"), ("b", "device/pose"))
            for state in (True, False)
        ]
        fleet.run_for(1.0)
        assert not any(answer.done() for answer in asked)
        watch.pace()

        with_state, plain = (answer.result(0.0) for answer in asked[:2])
        assert (with_state.result["state"], plain.result["state"]) == ({}, "running")
        assert with_state.result["timers"][0]["rate_hz"] == 5.0
        assert [answer.result(0.0).reason for answer in asked[2:4]] == ["a has no task 'device/sonar'"] * 2
        for answer in asked[4:]:
            with pytest.raises(Unreachable, match="b cannot be reached"):
                answer.result(0.0)

        late = watch.look("a", Describe("device/pose"), 3.0)
        watch.end()
        for answer in (late, watch.look("a", Describe("device/pose"), 3.0)):
            with pytest.raises(Unreachable, match="the mission is over"):
                answer.result(0.0)


def test_a_virtual_run_goes_no_faster_than_it_can_be_watched():
    waits: list[float] = []

    class Stopping(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            return False

    watch = VirtualWatch(100.0, Stopping())
    fleet = VirtualFleet()
    watch.begin(fleet)
    fleet.run_for(500.0)
    watch.pace()

    assert waits[-1] == pytest.approx(5.0, abs=1.0)
