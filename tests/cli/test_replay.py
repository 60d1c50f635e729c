"""`pancakes replay ...` into running agents, and into agents in virtual time."""

import json
import shutil
import signal

import pytest
from cli.processes import READY

from pancakes.recording.reader import RecordingReader

ANSWER = """
from pancakes.devices import Load, Pose
from pancakes.task import Task, on


class Answer(Task):
    @on("system", Pose)
    def pose(self, packet):
        who = "its own" if packet.source.startswith(self.agent + "/") else packet.source
        self.log("info", f"heard {packet.body.x_m:g} of {who}, said at {packet.stamp_s!r}")
        self.publish("ctrl", Load(packet.body.x_m))
"""
ENTRY = "[pancakes.tasks]\nreplays.Answer = plugin_replays:Answer\nreplays.Walk = plugin_walk:Walk\n"
WALK = """
from pancakes.devices import Pose
from pancakes.task import Task, every


class Walk(Task):
    n = 0

    @every(hz=20)
    def step(self, tick):
        self.n += 1
        if self.n <= 10:
            self.publish("system", Pose(float(self.n), 0.0, 0.0))
        elif self.n == 11:
            self.log("info", "it has walked")
"""
WALKER = '[task.Walk]\ntype = "replays.Walk"\n[record]\npath = "r/{agent}.mcap"\n'
LISTENER = '[task.Answer]\ntype = "replays.Answer"\n'


@pytest.fixture
def walk(rig):
    """Return a recording of an agent `a` that published ten poses, 50 ms apart."""
    rig.install("replays", ENTRY, ANSWER)
    (rig.plugins / "plugin_walk.py").write_text(WALK)
    agent = rig.ready("a", WALKER)
    agent.hear("it has walked")
    assert rig.pancakes("record", "stop").returncode == 0
    agent.close()
    shutil.rmtree(rig.directory / "state")  # another robot of this name has never had that task
    return rig


def rows(rig, *arguments, code=0):
    result = rig.pancakes("replay", *arguments, "--format", "json")
    assert result.returncode == code, result.stderr
    return json.loads(result.stdout)


def stamp_in(line):
    """Return the stamp of the packet in a log line, in mission time like the line's own time."""
    return float(line.rpartition(" said at ")[2])


def pose_times(rig):
    """Return when the poses were received, in mission time."""
    reader = RecordingReader(rig.directory / "r")
    time = reader.mission_time()
    return [time.at(entry.time_ns) for entry in reader.entries() if entry.packet.type == "pose"]


def test_replay_keeps_the_recorded_source(walk):
    """The packets reach the agent on which they were recorded, with present stamps."""
    agent = walk.ready("a", LISTENER)
    (ready,) = [line for line in agent.said if READY in line]
    (plan,) = [row for row in rows(walk, "r", "--dry-run") if row["type"] == "pose"]
    assert plan == {
        "agent": "a", "channel": "system", "type": "pose", "source": "a/client/Walk", "packets": 10, "done": "dry run"
    }  # fmt: skip
    (done,) = [row for row in rows(walk, "r") if row["type"] == "pose"]
    assert done == {**plan, "done": "fed"}
    then = {entry.packet.stamp_s for entry in RecordingReader(walk.directory / "r").entries()}
    for number in range(1, 11):
        line = agent.hear(f"heard {number} of its own")
        assert float(ready.split()[0]) <= stamp_in(line) <= float(line.split()[0]) + 0.001  # lines are rounded
        assert stamp_in(line) not in then
    assert sum("heard" in line for line in agent.so_far()) == 10


def test_replay_as_another_agent_slower_and_in_part(walk):
    agent = walk.ready("b", LISTENER)
    done = rows(walk, "r", "--as", "b", "--only", "a/system/pose", "--speed", "0.2")
    assert [(row["agent"], row["packets"], row["done"]) for row in done] == [("b", 10, "fed")]
    agent.hear("heard 10 of its own")
    stamps = [stamp_in(line) for line in agent.said if "heard" in line]
    then = pose_times(walk)
    # Five times as long, less what the first was late; one that was fed at the recorded speed would take as long.
    assert stamps[-1] - stamps[0] > 2 * (then[-1] - then[0])
    part = ("--start", f"{then[3] - 0.001:.6f}", "--end", f"{then[6] + 0.001:.6f}")
    less = rows(walk, "r", "--as", "b", "--only", "*/Walk", *part, "--dry-run")
    assert [row["packets"] for row in less if row["type"] == "pose"] == [4]


def test_replay_skips_running_sources_and_reports_unknown_agents(walk):
    walk.ready("a", WALKER.partition("[record]")[0])
    nothing = walk.pancakes("replay", "r")
    assert (nothing.returncode, nothing.stderr) == (1, "all packets are left out: its source runs\n")
    of_walk = {row["channel"]: row["done"] for row in rows(walk, "r", "--only", "a/client/Walk", "--dry-run")}
    assert of_walk == {"log": "left out: agents take log only from its publisher", "system": "dry run"}
    missing = walk.pancakes("replay", "r", "--as", "c")
    assert (missing.returncode, missing.stderr) == (3, "there is no agent 'c', only a\n")


def test_replay_ends_in_order_on_ctrl_c(walk):
    agent = walk.ready("a", LISTENER)
    running = walk.run("-m", "pancakes.tools.cli.main", "replay", "r", "--speed", "0.1", "--format", "json", whole=True)
    agent.hear("heard 3 of its own")
    running.process.send_signal(signal.SIGINT)
    assert running.ended() == 130, running.everything()
    text = running.everything()
    assert "the replay was interrupted" in text
    assert next(row["packets"] for row in json.loads(text[text.index("[") :]) if row["type"] == "pose") < 10


def test_replay_into_virtual_agents_records_them(walk):
    config = walk.config("a", LISTENER)
    arguments = ("r", "--config", str(config), "--out", "again")
    assert rows(walk, *arguments, "--dry-run")[0]["done"] == "dry run"
    assert not (walk.directory / "again").exists()
    assert [row["packets"] for row in rows(walk, *arguments) if row["type"] == "pose"] == [10]
    (info,) = json.loads(walk.pancakes("record", "info", "again", "--format", "json").stdout)
    counts = {(topic["channel"], topic["type"]): topic["packets"] for topic in info["topics"]}
    assert counts["ctrl", "load"] == 10
    assert walk.pancakes("rerun", "again", "Answer").returncode == 0


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("none",), 1, "there is no recording none"),
        (("r", "--config", "x.toml"), 2, "--config and --out need each other"),
        (("r", "--start", "3s", "--end", "2s"), 2, "--end 2s is not after --start 3s"),
        (("r", "--config", "x.toml", "--out", "o"), 4, "x.toml"),
        (("r",), 3, "no agent runs on this machine"),
    ],
)
def test_replay_errors_are_sentences(walk, arguments, code, text):
    result = walk.pancakes("replay", *arguments)
    assert result.returncode == code
    assert text in result.stderr
    assert "Traceback" not in result.stderr
