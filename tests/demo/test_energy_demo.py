"""`pancakes demo energy` as a person runs it, shortened by a smaller battery."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner

from pancakes.tools.cli.verbs.demo import demo

SHORTER = (
    "world:task.World.settings.robots.agent1.battery.capacity_j=200.0",
    "agent1:task.EnergyGovernor.settings.feedback.until_s=112",
    "agent1:task.EnergyGovernor.settings.feedback.period_s=5",
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, int]:
    out = tmp_path_factory.mktemp("energy")
    # The command takes these signals for itself; the tests want them back. If they still woke its thread, the second
    # signal in a later test would end the worker.
    woken = signal.set_wakeup_fd(-1)
    signals = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    changes = [part for change in SHORTER for part in ("--set", change)]
    result = CliRunner().invoke(
        demo, ["energy", "--virtual", "--duration", "150", "--seed", "2", "--out", str(out), *changes]
    )
    for number, handler in signals.items():
        signal.signal(number, handler)
    signal.set_wakeup_fd(woken)
    return out, result.output, result.exit_code


def test_energy_governor_makes_the_mission_last_longer(flown: tuple[Path, str, int]) -> None:
    out, said, code = flown
    assert code == 0, said
    assert "verdict: PASS" in said
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    variants = summary["variants"]
    assert list(variants) == ["plain", "thresholds", "feedback"]
    # 200 J at what the plain mission takes each second; the battery is what the world says, not what tasks say.
    power_w = sum(variants["plain"]["mean_power_w"].values())
    assert variants["plain"]["lasted_s"] == pytest.approx(200.0 / power_w, rel=0.01)
    for name in ("thresholds", "feedback"):
        assert variants[name]["lasted_s"] > 1.25 * variants["plain"]["lasted_s"]
        assert variants[name]["off_circle_m"]["mean"] > 0.0
        assert all(variants[name]["mean_power_w"][kind] < variants["plain"]["mean_power_w"][kind] for kind in KINDS)
        assert variants[name]["mean_power_w"]["idle"] == pytest.approx(
            variants["plain"]["mean_power_w"]["idle"], abs=0.01
        )
    assert variants["feedback"]["lasted_s"] >= 112.0
    assert variants["feedback"]["left"] <= 0.12


KINDS = ("motion", "sensing", "listening", "sending")


def test_energy_leaves_a_table_a_picture_and_records(flown: tuple[Path, str, int]) -> None:
    out, said, _ = flown
    assert {path.name for path in out.iterdir()} == {
        "summary.json",
        "timing.json",
        "energy.png",
        "plain",
        "thresholds",
        "feedback",
    }
    assert (out / "energy.png").read_bytes().startswith(b"\x89PNG")
    rows = [line.split() for line in said.splitlines()]
    assert {row[0] for row in rows if row} >= {"plain", "thresholds", "feedback"}
    for name in ("plain", "thresholds", "feedback"):
        files = {path.name for path in (out / name).iterdir()}
        assert files == {"summary.json", "timing.json", "events.jsonl", "trajectory.csv", "consumption.csv"}


def test_energy_events_survive_a_sleeping_network(flown: tuple[Path, str, int]) -> None:
    out = flown[0] / "thresholds" / "events.jsonl"
    events = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    stopped = [event for event in events if event["kind"] == "service_stopped"]
    started = [event for event in events if event["kind"] == "service_started"]
    assert len(stopped) >= 3
    assert all(event["service"] == "network" and event["agent"] == "agent1" for event in stopped + started)
    assert len(stopped) - len(started) in (0, 1), "it was asleep when it said that it had fallen asleep"
    lines = [json.dumps(event, sort_keys=True) for event in events]
    assert len(lines) == len(set(lines)), "nothing is told twice"
