"""The demo of the sensor field in virtual time: judged by its demo, and by what these tests read from its files."""

from __future__ import annotations

import contextlib
import csv
import json
import socket
import threading
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from pancakes_sensor_field.demos import AGENTS, SENSOR_FIELD
from pancakes_sensor_field.verdict import judge_sensor_field

from pancakes.config import Config, load
from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.launcher import NetworkFaults, find_configs, fresh, judge, make_plan, run_of, run_virtual
from pancakes.util.plugins import Plugins

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "sensor-field"
RESULTS = ("events.jsonl", "field.csv", "trajectory.csv", "summary.json")
ALARM = "Alarm"


@dataclass(frozen=True)
class Flown:
    """A mission's results."""

    out: Path
    run: Any
    summary: dict[str, Any]
    events: list[dict[str, Any]]
    rows: list[dict[str, str]]

    def told(self, kind: str, **fields: Any) -> list[dict[str, Any]]:
        return [
            event
            for event in self.events
            if event["kind"] == kind and all(event.get(key) == value for key, value in fields.items())
        ]


def fly(out: Path, seed: int = 1, faults: bool = False, duration_s: float = 240.0, sets: tuple[str, ...] = ()) -> Flown:
    """Runs the mission."""
    plan = make_plan(SENSOR_FIELD, find_configs(SENSOR_FIELD), out, seed, 1.0, duration_s, sets, live=False)
    fresh(out, tuple(SENSOR_FIELD.records.values()))
    mission = Mission(SENSOR_FIELD.agents, duration_s)
    timing = run_virtual(plan, mission, threading.Event(), NetworkFaults(seed) if faults else None)
    run = run_of(plan, mission)
    summary = judge(plan, run, timing)
    events = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    with (out / "field.csv").open(encoding="utf-8", newline="") as file:
        return Flown(out, run, summary, events, list(csv.DictReader(file)))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """One whole mission over a network with latency and links that break; the tests only read it."""
    return fly(tmp_path_factory.mktemp("field") / "out", seed=2, faults=True)


def test_field_mission_passes_with_faults(flown: Flown) -> None:
    assert flown.told("peer_down"), "no link broke, so this shows nothing"
    assert flown.summary["reasons"] == [] and flown.summary["verdict"] == "PASS"


def test_field_fires_raise_one_alarm_each_and_a_fox_none(flown: Flown) -> None:
    raised = flown.told("alarm_raised")
    assert [(event["number"], event["agent"]) for event in raised] == [(1, "gateway"), (2, "north")]
    hot: dict[str, float] = {}
    for row in flown.rows:
        if float(row["celsius"]) >= 45.0:
            hot.setdefault(row["node"], float(row["t_s"]))
    assert list(hot) == ["shed", "south"]
    assert raised[0]["t_s"] - hot["shed"] < 10.0 and raised[1]["t_s"] - hot["south"] < 10.0
    fox = [row for row in flown.rows if row["node"] == "north" and row["moving"] == "1"]
    assert fox and all(float(row["t_s"]) < 60.0 for row in fox), "it was seen, and was no reason"
    assert raised[0]["hot"] == ["shed"] and "shed" in raised[0]["moving"], "it takes a tiny node's word"


def test_field_alarm_migrates_when_the_gateway_runs_low(flown: Flown) -> None:
    (moved,) = flown.told("migration", task=ALARM, outcome="moved")
    assert (moved["agent"], moved["winner"], moved["asked_by"]) == ("gateway", "north", "rule")
    level = [
        float(row["level"]) for row in flown.rows if row["node"] == "gateway" and float(row["t_s"]) <= moved["t_s"]
    ]
    assert level[-1] == pytest.approx(0.5, abs=0.01)
    refused = {line["peer"]: line["reason"] for line in moved["lines"] if line["answer"] == "refused"}
    assert list(refused) == ["south"] and "too near to the 50%" in refused["south"]
    assert not flown.told("task_started", task=ALARM, agent="gateway")
    assert len(flown.told("task_started", task=ALARM)) == 1
    (arrived,) = flown.told("task_arrived", task=ALARM)
    assert arrived["state"]["open"] and arrived["state"]["alarms"] == 1, "it came with the alarm that was open"


def test_field_reports_are_counted_exactly_once(flown: Flown) -> None:
    tally = flown.told("tally")[-1]["heard"]
    assert set(tally) == {"north", "east", "south", "west", "shed", "gate"}
    assert all(received == highest > 10 for received, highest in tally.values())
    assert tally == flown.summary["reports"]


def test_field_nodes_that_sleep_save_energy(flown: Flown) -> None:
    for node in ("north", "east", "south", "west"):
        rows = [row for row in flown.rows if row["node"] == node]
        levels = [float(row["level"]) for row in rows]
        assert all(later <= earlier for earlier, later in pairwise(levels))
        asleep = sum(row["radio"] == "0" for row in rows) / len(rows)
        told = flown.summary["energy"][node]
        assert told["listened_share"] == pytest.approx(1.0 - asleep, abs=1e-6)
        spent = sum(float(rows[-1][f"{cause}_j"]) for cause in ("idle", "sensing", "listening", "sending"))
        assert told["spent_j"] == pytest.approx(spent, abs=1e-3)
        assert spent < (0.9 if node == "north" else 0.7) * told["always_on_j"]
    assert set(flown.summary["energy"]) == {"north", "east", "south", "west"}


def test_field_noisy_line_loses_frames_only(flown: Flown) -> None:
    said = [event["text"] for event in flown.told("line", agent="gateway") if "wrong CRC" in event["text"]]
    assert said and all(text.startswith("shed_line: ") for text in said), "only the shed's line is noisy"


def test_field_mission_repeats_byte_for_byte(tmp_path: Path) -> None:
    one, again, other = (
        fly(tmp_path / name, seed, duration_s=40.0, sets=FIRE_SOON) for name, seed in (("a", 4), ("b", 4), ("c", 5))
    )
    for name in RESULTS:
        assert (one.out / name).read_bytes() == (again.out / name).read_bytes(), name
    assert (one.out / "events.jsonl").read_bytes() != (other.out / "events.jsonl").read_bytes()


FIRE_SOON = ("field:task.Field.settings.fires.shed.starts_s=12",)
NO_ALARM = ("gateway:task.Alarm.settings.hot_c=400", "gateway:task.Alarm.settings.raise_at=9")
NO_MOVE = ("gateway:task.Alarm.migrate.below=0.95",)
FALSE_ALARM = ("gateway:task.Alarm.settings.raise_at=1",)
ALWAYS_AWAKE = tuple(f"{node}:task.DutyCycle.settings.awake_s=500" for node in AGENTS[2:])


@pytest.mark.parametrize(
    ("sets", "wanted"),
    [
        ((), ("there never was an alarm", "the battery of gateway never fell")),
        ((*FIRE_SOON, *NO_ALARM, *NO_MOVE), ("no alarm told of the fire shed", "Alarm never moved")),
        ((*FALSE_ALARM, *ALWAYS_AWAKE), ("alarm 1 was false", "% of its energy")),
    ],
    ids=["nothing happens", "no alarm", "false alarm"],
)
def test_field_verdict_names_what_went_wrong(sets: tuple[str, ...], wanted: tuple[str, ...], tmp_path: Path) -> None:
    mission = fly(tmp_path, duration_s=60.0, sets=sets)
    assert mission.summary["verdict"] == "FAIL"
    for reason in wanted:
        assert any(reason in said for said in mission.summary["reasons"]), mission.summary["reasons"]


def test_field_verdict_names_bad_reports_and_a_second_copy(flown: Flown, tmp_path: Path) -> None:
    """The judge must see what should never happen: so a good mission's events are spoilt."""
    last = max(index for index, event in enumerate(flown.events) if event["kind"] == "tally")
    heard = dict(flown.events[last]["heard"], shed=[9, 10], gate=[11, 10])
    spoilt = [*flown.events[:last], {**flown.events[last], "heard": heard}, *flown.events[last + 1 :]]
    spoilt.append({"t_s": 150.0, "agent": "east", "source": "east/client", "kind": "task_started", "task": ALARM})
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in spoilt), encoding="utf-8")
    (tmp_path / "field.csv").write_bytes((flown.out / "field.csv").read_bytes())
    run = type(flown.run)(tmp_path, 2, 240.0, 240.0, "", flown.run.configs)
    reasons = judge_sensor_field(run)["reasons"]
    assert "1 of 10 reports of shed were lost" in reasons
    assert "1 reports of gate came twice" in reasons
    assert any(reason.startswith("two agents ran Alarm at once, for 9") for reason in reasons)


def test_field_figure_is_drawn_of_any_mission(flown: Flown, tmp_path: Path) -> None:
    for mission in (flown, fly(tmp_path, duration_s=5.0)):
        assert SENSOR_FIELD.draw is not None
        SENSOR_FIELD.draw(mission.run, mission.summary)
        assert (mission.out / "paths.png").read_bytes().startswith(b"\x89PNG")


def read_configs() -> dict[str, Config]:
    return {agent: load(CONFIGS / f"{agent}.toml", plugins=Plugins()) for agent in AGENTS}


def test_field_configurations_find_each_other() -> None:
    configs = read_configs()
    addresses = {address for config in configs.values() for address in config.agent.listen}
    for agent, config in configs.items():
        assert config.agent.name == agent and set(config.agent.peers) == addresses
    bus = configs["field"].tasks["Field"].settings["bus"]
    simulated = [
        device for config in configs.values() for device in config.devices.values() if "world" in device.settings
    ]
    assert len(simulated) == 4 * 3 + 1 and {device.settings["world"] for device in simulated} == {bus}


def test_field_tiny_nodes_are_where_the_gateway_listens() -> None:
    configs = read_configs()
    nodes, devices = configs["field"].tasks["TinyNodes"].settings["nodes"], configs["gateway"].devices
    assert nodes["shed"]["line"] == "pty:" + devices["shed_line"].settings["port"]
    assert nodes["gate"]["line"] == devices["gate_line"].settings["listen"]
    for name, node in nodes.items():
        assert devices[f"{name}_line"].settings["nodes"] == {name: node["number"]}
        assert {f"{name}_temperature", f"{name}_motion"} <= devices.keys()


@pytest.mark.parametrize("local", [False, True])
def test_field_lines_move_if_ports_are_taken(tmp_path: Path, local: bool) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        with contextlib.suppress(OSError):  # then somebody else has it, which does as well
            taken.bind(("127.0.0.1", 7521))
        plan = make_plan(SENSOR_FIELD, CONFIGS, tmp_path, 1, 5.0, 240.0, (), live=True, local=local)
    assert plan.claim is None
    listens = plan.configs["gateway"].devices["gate_line"].settings["listen"]
    assert listens.startswith("udp://127.0.0.1:") and listens != "udp://127.0.0.1:7521"
    assert plan.configs["field"].tasks["TinyNodes"].settings["nodes"]["gate"]["line"] == listens
