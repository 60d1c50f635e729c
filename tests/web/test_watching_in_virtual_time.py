"""A run in virtual time is not changed by being watched; which fleet is watched."""

from __future__ import annotations

import json
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pancakes.config import parse
from pancakes.control import Describe
from pancakes.devices import Load
from pancakes.errors import ControlRefusedError, UnreachableError
from pancakes.simulation.fleet import Fleet
from pancakes.tools.web.virtual_watch import VirtualWatch
from pancakes.tools.web.watch import fleet_among

ENCIRCLEMENT = Path(__file__).parents[2] / "configs" / "encirclement"


def fly(watch: VirtualWatch | None, place: Path) -> list[dict[str, Any]]:
    """Run the first seconds of a mission; return what its agents ended up as."""
    fleet = Fleet(seed=3)
    try:
        for name in ("world", "agent1", "sensor"):
            text = (ENCIRCLEMENT / f"{name}.toml").read_text()
            text = text.replace("trajectory.csv", f"{place}/trajectory.csv")
            sets = ["agent.seed=3", "agent.birth_wait_s=0", "clock.hold=false"]
            fleet.start_config(parse(text, str(ENCIRCLEMENT / f"{name}.toml"), sets), settle=False, probe=False)
        if watch is not None:
            watch.begin(fleet)
        states: list[Any] = []
        fleet.agents["world"].kernel.stream.tap("system", lambda packet: states.append(packet.body))
        until_s = fleet.now() + 8.0
        while fleet.now() < until_s:
            fleet.run_to(min(until_s, fleet.now() + (watch.slice_s() if watch is not None else 8.0)))
            if watch is not None:
                watch.pace()
        return [states[-1], fleet.agents["agent1"].agent.mesh.describe()]
    finally:
        if watch is not None:
            watch.end()
        fleet.close()


def test_virtual_watch_shows_a_run_without_changing_it(tmp_path: Path):
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
    found = {name for words in ("agent1", "world") for name, _, _ in watch.feed.find_series(words, 2000)["rows"]}
    commands, readings = "agent1/client/ScanTarget motors v_mps", "agent1/device/battery battery voltage_v"
    assert {commands, readings, "agent1 late_ms", "world/client/World world_state bodies.agent1.x_m"} <= found
    assert len(watch.feed.plot([commands], [-1.0])[commands][1]) >= 3


def test_virtual_watch_looks_at_tasks_between_turns():
    stopped = threading.Event()
    stopped.set()
    watch = VirtualWatch(5.0, stopped)
    text = 'schema = 1\n[agent]\nname = "a"\nbirth_wait_s = 0\n[device.pose]\ndriver = "null.pose"\nrate_hz = 5\n'
    with closing(Fleet()) as fleet:
        fleet.start_config(parse(text, where="a"), settle=False, probe=False)
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
            with pytest.raises(UnreachableError, match="b cannot be reached"):
                answer.result(0.0)

        late = watch.look("a", Describe("device/pose"), 3.0)
        watch.end()
        for answer in (late, watch.look("a", Describe("device/pose"), 3.0)):
            with pytest.raises(UnreachableError, match="the mission is over"):
                answer.result(0.0)


def test_virtual_watch_keeps_a_run_at_its_pace():
    waits: list[float] = []

    class Stopping(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            return False

    watch = VirtualWatch(100.0, Stopping())
    fleet = Fleet()
    watch.begin(fleet)
    fleet.run_for(500.0)
    watch.pace()

    assert waits[-1] == pytest.approx(5.0, abs=1.0)


def test_watch_needs_a_name_if_there_are_several_fleets():
    rows = [{"fleet": "one"}, {"fleet": "two"}, {"fleet": "one"}]

    assert fleet_among(rows[:1]) == "one"
    assert fleet_among(rows, "two") == "two"
    with pytest.raises(ControlRefusedError, match="several fleets are running, one, two: choose one with --fleet"):
        fleet_among(rows)
    with pytest.raises(UnreachableError, match="no agent of the fleet 'three' was found, only of one, two"):
        fleet_among(rows, "three")


def test_virtual_watch_follows_the_channels_of_tasks():
    stopped = threading.Event()
    stopped.set()
    watch = VirtualWatch(5.0, stopped)
    text = 'schema = 1\n[agent]\nname = "a"\nbirth_wait_s = 0\n[channel.weather]\n'
    with closing(Fleet()) as fleet:
        fleet.start_config(parse(text, where="a"))
        watch.begin(fleet)
        watch.pace()
        fleet.agents["a"].publish("weather", Load(0.25))
        fleet.run_for(1.0)
        watch.pace()

    (row,) = watch.feed.find_series("load cpu", 10)["rows"]
    assert row[0].endswith(" load cpu") and row[2] == 0.25
