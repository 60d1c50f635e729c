"""The sensor field on real processes, a pseudo-terminal and UDP: short, and gone without a trace however it ends."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from demo.live_demo import LiveDemo
from pancakes_sensor_field.demos import AGENTS

LIMIT_S = 3.0
TINY = "pancakes_sensor_field.tiny_node"
EARLY = (
    "field:task.Field.settings.fires.shed.starts_s=12",
    "field:task.Field.settings.walkers.first.way=[[8, 3.0, 4.0], [30, 9.0, 4.5]]",
    "field:task.Field.settings.nodes.gateway.battery.capacity_j=10",
)
"""The shed burns soon, and the gateway's battery falls below 50 % after some 25 s."""


class LiveField(LiveDemo):
    """`pancakes demo sensor-field --headless`; the programs of its tiny nodes are named by their command lines."""

    name = "sensor-field"

    def name_of(self, words: list[str]) -> str:
        return " ".join(words) if TINY in words else super().name_of(words)

    @property
    def tiny(self) -> list[psutil.Process]:
        return [process for name, process in self.agents.items() if TINY in name]

    @property
    def is_whole(self) -> bool:
        return len(self.tiny) == 2 and set(AGENTS) <= self.agents.keys()


@pytest.fixture
def under_way(tmp_path: Path) -> Iterator[LiveField]:
    """A mission in which the tiny nodes have been heard."""
    demo = LiveField(tmp_path / "out", "--set", EARLY[0], "--set", EARLY[1])
    with demo:
        demo.wait_for("alarm raised")
        yield demo


def test_live_field_hears_tiny_nodes_and_moves_the_alarm(tmp_path: Path) -> None:
    out = tmp_path / "out"
    sets = [word for change in EARLY for word in ("--set", change)]
    with LiveField(out, "--duration", "60", *sets) as demo:
        demo.wait_for("alarm raised")
        demo.ends()
        assert demo.left_after(0.0) == []
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert not any("broke off" in reason for reason in summary["reasons"]), demo.said
    (first, *_) = summary["alarms"]
    assert (first["number"], first["fire"], first["agent"]) == (1, "shed", "gateway") and first["hot"] == ["shed"]
    gateway, heir = summary["holders"]
    assert gateway["agent"] == "gateway" and heir["agent"] in ("north", "east", "west"), demo.said
    assert summary["overlap_s"] <= 0.05 and summary["state_moved"]["alarms"] == 1
    assert all(received == highest for received, highest in summary["reports"].values()), summary["reports"]
    assert {"shed", "gate"} <= summary["reports"].keys(), "over the pseudo-terminal, and over UDP"
    assert not (out / "state" / "shed.tty").is_symlink()
    for agent in AGENTS:
        assert (out / "logs" / f"{agent}.txt").read_text(encoding="utf-8") == "", "an agent wrote to its terminal"


def test_live_field_ends_tiny_nodes_at_sigterm(under_way: LiveField) -> None:
    under_way.process.send_signal(signal.SIGTERM)
    assert under_way.ends() == 130
    assert under_way.left_after(0.0) == []


def test_live_field_leaves_no_process_if_the_launcher_dies(under_way: LiveField) -> None:
    under_way.process.kill()
    assert under_way.left_after(LIMIT_S) == []


def test_live_field_dies_with_its_tiny_nodes(under_way: LiveField) -> None:
    under_way.agents["field"].kill()
    _, left = psutil.wait_procs(under_way.tiny, LIMIT_S)
    assert not left
    assert under_way.ends() == 1 and "the mission broke off: the agent field " in under_way.said
