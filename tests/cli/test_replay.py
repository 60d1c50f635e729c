"""`pancakes replay ...` into agents that run, and into agents in virtual time."""

import json
import shutil
import signal

import pytest

from pancakes.tools.recording.recording_reader import RecordingReader

ANSWER = """
from pancakes.bodies.devices.types import Load, Pose
from pancakes.task import Task, on


class Answer(Task):
    @on("system", Pose)
    def pose(self, packet):
        own = packet.source.startswith(self.agent + "/")
        when = "now" if abs(packet.stamp - self.now()) < 0.1 else packet.stamp
        self.log("info", f"heard {packet.body.x_m:g} of {'its own' if own else packet.source}, {when}")
        self.publish("ctrl", Load(packet.body.x_m))
"""
ENTRY = "[pancakes.tasks]\nreplays.Answer = plugin_replays:Answer\nreplays.Walk = plugin_walk:Walk\n"
WALK = """
from pancakes.bodies.devices.types import Pose
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
    """A recording of an agent `a` that said ten poses, 50 ms apart."""
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


def pose_times(rig):
    """Returns when the poses were seen, in mission time."""
    reader = RecordingReader(rig.directory / "r")
    time = reader.mission_time()
    return [time.at(entry.time_ns) for entry in reader.entries() if entry.packet.type == "pose"]


def test_packets_reach_the_agent_that_they_were_seen_on_in_the_name_of_who_said_them(walk):
    agent = walk.ready("a", LISTENER)
    (plan,) = [row for row in rows(walk, "r", "--dry-run") if row["type"] == "pose"]
    assert plan == {
        "agent": "a", "channel": "system", "type": "pose", "source": "a/client/Walk", "packets": 10, "done": "dry run"
    }  # fmt: skip
    (done,) = [row for row in rows(walk, "r") if row["type"] == "pose"]
    assert done == {**plan, "done": "fed"}
    for number in range(1, 11):
        agent.hear(f"heard {number} of its own, now")
    assert sum("heard" in line for line in agent.so_far()) == 10


def test_another_agent_and_another_speed_and_a_part_only(walk):
    agent = walk.ready("b", LISTENER)
    done = rows(walk, "r", "--as", "b", "--only", "a/system/pose", "--speed", "0.5")
    assert [(row["agent"], row["packets"], row["done"]) for row in done] == [("b", 10, "fed")]
    agent.hear("heard 10 of its own")
    times = [float(line.split()[0]) for line in agent.said if "heard" in line]
    then = pose_times(walk)
    assert times[-1] - times[0] == pytest.approx(2 * (then[-1] - then[0]), abs=0.3)
    part = ("--from", f"{then[3] - 0.001:.6f}", "--to", f"{then[6] + 0.001:.6f}")
    less = rows(walk, "r", "--as", "b", "--only", "*/Walk", *part, "--dry-run")
    assert [row["packets"] for row in less if row["type"] == "pose"] == [4]


def test_what_runs_in_the_fleet_says_it_itself_and_what_is_not_there_is_told(walk):
    walk.ready("a", WALKER.partition("[record]")[0])
    nothing = walk.pancakes("replay", "r")
    assert (nothing.returncode, nothing.stderr) == (1, "nothing is left to be fed: its source runs\n")
    of_walk = {row["channel"]: row["done"] for row in rows(walk, "r", "--only", "a/client/Walk", "--dry-run")}
    assert of_walk == {"log": "left out: agents take log from its publisher alone", "system": "dry run"}
    missing = walk.pancakes("replay", "r", "--as", "c")
    assert (missing.returncode, missing.stderr) == (3, "there is no agent 'c', only a\n")


def test_ctrl_c_ends_it_in_order(walk):
    agent = walk.ready("a", LISTENER)
    running = walk.run("-m", "pancakes.tools.cli.main", "replay", "r", "--speed", "0.1", "--format", "json", whole=True)
    agent.hear("heard 3 of its own")
    running.process.send_signal(signal.SIGINT)
    assert running.ended() == 0, running.everything()
    text = running.everything()
    assert "the replay was ended" in text
    assert next(row["packets"] for row in json.loads(text[text.index("[") :]) if row["type"] == "pose") in (2, 3, 4)


def test_agents_in_virtual_time_are_fed_and_recorded(walk):
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
        (("r", "--config", "x.toml"), 2, "--config and --out go together"),
        (("r", "--from", "3s", "--to", "2s"), 2, "--to 2s is not after --from 3s"),
        (("r", "--config", "x.toml", "--out", "o"), 4, "x.toml"),
        (("r",), 3, "no agent runs on this machine"),
    ],
)
def test_what_cannot_be_is_a_sentence(walk, arguments, code, text):
    result = walk.pancakes("replay", *arguments)
    assert result.returncode == code
    assert text in result.stderr
    assert "Traceback" not in result.stderr
