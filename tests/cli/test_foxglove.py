"""Foxglove's own libraries read a recording and a running fleet (`pancakes view --foxglove`)."""

import fcntl
import json
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig

READER = Path(__file__).parents[1] / "harness" / "foxglove_reader.cjs"
PACKAGES = ("@foxglove/schemas@2", "@foxglove/ws-protocol@0.8", "@mcap/core@2", "ajv@8", "fzstd@0.1", "ws@8")
PATIENCE_S = 120.0
DEVICES = """
[device.pose]
driver = "static.pose"
rate_hz = 20.0
settings = { x_m = 1.0, y_m = 2.0, theta_rad = 0.5 }

[task.Ring]
type = "ring.Ring"
"""
SOURCE = """
from pancakes.devices import Infrared
from pancakes.task import Task, every

class Ring(Task):
    @every(hz=20)
    def tick(self, tick):
        self.publish("system", Infrared((0.5, 0.0, -0.5), (0.2, 0.1, 0.3), 0.3))
        self.log("warning", "the lid is open")
"""
VIEWED = {
    "/viewer/a/pose": "foxglove.PoseInFrame",
    "/viewer/a/pose/path": "foxglove.PosesInFrame",
    "/viewer/a/pose/transform": "foxglove.FrameTransforms",
    "/viewer/a/Ring": "foxglove.LaserScan",
    "/viewer/a/log": "foxglove.Log",
    "/a/system/ir": "pancakes.ir",
}


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a program that reads with Foxglove's libraries; they are installed once for all workers."""
    if shutil.which("npm") is None:
        pytest.skip("Foxglove's libraries are for Node.js, and there is no npm here")
    place = tmp_path_factory.getbasetemp().parent / "foxglove-reader"
    place.mkdir(exist_ok=True)
    with (place / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "node_modules" / "ws").exists():
            install = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(place), *PACKAGES]
            done = subprocess.run(install, capture_output=True, text=True, timeout=PATIENCE_S)
            if done.returncode:
                pytest.skip(f"npm cannot install Foxglove's libraries: {(done.stderr or done.stdout)[-300:]}")
        shutil.copy(READER, place / READER.name)
    return place / READER.name


def read(reader: Path, *arguments: str) -> dict[str, dict[str, Any]]:
    """Return the messages that were read, by topic."""
    command = ["node", str(reader), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    return {row["topic"]: row for row in map(json.loads, done.stdout.splitlines())}


def check(found: dict[str, dict[str, Any]]) -> None:
    for topic, schema in VIEWED.items():
        assert found[topic]["schemaName"] == schema and found[topic]["faults"] == [], found[topic]
    (frame,) = found["/viewer/a/pose/transform"]["last"]["transforms"]
    assert (frame["child_frame_id"], frame["translation"]["x"]) == ("a", 1.0)
    assert 0.1 in found["/viewer/a/Ring"]["last"]["ranges"]
    assert found["/a/system/ir"]["last"]["body"]["ranges_m"] == [0.2, 0.1, 0.3]


def test_foxglove_reads_a_recording_and_a_live_fleet(rig: Rig, reader: Path):
    rig.install("ring", "[pancakes.tasks]\nring.Ring = plugin_ring:Ring\n", SOURCE)
    rig.ready("a", DEVICES)
    began = rig.pancakes("record", "start")
    assert began.returncode == 0, began.stderr
    assert rig.pancakes("channel", "echo", "a/system", "--type", "ir", "--count", "20").returncode == 0
    assert rig.pancakes("record", "stop").returncode == 0
    (path,) = rig.directory.rglob("*.mcap")
    check(read(reader, "file", str(path)))

    view = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--foxglove", whole=True)
    address = view.hear("Foxglove opens the fleet ").rpartition(" ")[2]
    began_ns = time.time_ns()
    found = read(reader, "live", address, *VIEWED)
    check(found)
    assert abs(int(found["/a/system/ir"]["time"]) - began_ns) < 120e9, "times are of the day"
    code, _ = view.signalled(signal.SIGINT)
    assert code == 0


def test_foxglove_refuses_a_used_port(rig: Rig):
    """It also refuses to serve if its library is missing."""
    rig.ready("a")
    first = rig.run("-u", "-m", "pancakes.tools.cli.main", "view", "--foxglove", "--format", "json", whole=True)
    first.hear("]")
    (told,) = json.loads("\n".join(first.said))
    port = told["address"].rpartition(":")[2]
    taken = rig.pancakes("view", "--foxglove", "--port", port)
    sentence = f"Foxglove cannot be served at port {port}: choose another with --port\n"
    assert (taken.returncode, taken.stderr) == (1, sentence)

    (rig.plugins / "foxglove").mkdir(parents=True)
    (rig.plugins / "foxglove" / "__init__.py").write_text("raise ModuleNotFoundError(name='foxglove')")
    ended = rig.pancakes("view", "--foxglove")
    assert ended.returncode == 1 and "pip install 'pancakes-agents[foxglove]'" in ended.stderr
