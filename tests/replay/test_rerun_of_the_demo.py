"""The debugging loop on a real recording: the virtual encirclement, as it was and with one line changed."""

import subprocess
import sys
from pathlib import Path

import pytest
from replay.runs_again import run_again

from pancakes.tools.replay.comparison import StreamKey
from pancakes.util.plugins import Plugins

ROOT = Path(__file__).parents[2]

scan_target = pytest.importorskip("pancakes_encirclement.scan_target")


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    """The first 20 s of the encirclement, recorded; at about 12 s the robot comes to the circle."""
    out = tmp_path_factory.mktemp("mission")
    command = [
        sys.executable,
        "-m",
        "pancakes.tools.cli.main",
        "demo",
        "encirclement",
        "--virtual",
        "--record",
        "--headless",
    ]
    options = ["--duration", "20", "--out", str(out), "--configs", str(ROOT / "configs" / "encirclement")]
    subprocess.run([*command, *options], capture_output=True, check=False, timeout=100)
    Plugins().load_packets()
    return out / "recording"


def test_unchanged_robot_tasks_agree_with_the_recording(mission):
    again = run_again(mission, "ScanTarget", scan_target.ScanTarget)
    assert again.comparison.differences == []
    assert again.comparison.streams[StreamKey("ctrl", "motors", "")].equal > 150
    from pancakes_encirclement.motion_detection import MotionDetection
    from pancakes_encirclement.pose_sharing import PoseSharing

    assert run_again(mission, "agent1/PoseSharing", PoseSharing).comparison.differences == []
    assert run_again(mission, "MotionDetection", MotionDetection).comparison.differences == []


def test_changed_line_of_the_demo_shows_its_first_effect(mission):
    from pancakes_encirclement.scan_target import ScanTarget

    class Slower(ScanTarget):
        def _speed(self, position, centre):
            return 0.5 * self.settings.speed_mps  # what it drives with on the circle, and only there

    again = run_again(mission, "ScanTarget", Slower)
    (arrived,) = [
        packet for packet in again.script.outputs if packet.type == "event" and packet.body.kind == "on_circle"
    ]
    first = again.comparison.differences[0]
    assert first.packet.stamp_s == pytest.approx(arrived.stamp_s)
    assert {field.field: (field.recorded, field.now) for field in first.fields}["v_mps"] == (0.1, 0.05)
    assert again.kinds == ["different"] * len(again.kinds)
    counts = again.comparison.streams[StreamKey("ctrl", "motors", "")]
    assert counts.equal > 100
    assert counts.different == len(again.kinds) > 20


def test_another_radius_shows_from_the_first_command(mission):
    again = run_again(mission, "ScanTarget", scan_target.ScanTarget, radius_m=0.8)
    counts = again.comparison.streams[StreamKey("ctrl", "motors", "")]
    assert (counts.equal, counts.different) == (0, counts.recorded)
    assert again.comparison.differences[0].fields[0].field == "omega_radps"
