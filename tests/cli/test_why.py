"""`pancakes why ...` on a recording of two agents, one of which received a pose from the other."""

import json

import pytest
from cli.invoked import invoked

from pancakes.devices import Pose, Twist
from pancakes.events import Event
from pancakes.packet import Fence, Packet
from pancakes.recording.mcap_writer import RecordingWriter
from pancakes.recording.records import RecordedPacket

MS = 1_000_000
POSE = Pose(1.0, 2.0, 0.0)
COMMANDS = 20


def reactions(agent):
    """Return the records of `agent`: poses take 4 ms from `world` to `a`, where a task answers ever more slowly."""
    for n in range(1, COMMANDS + 1):
        t_ms = 100 * n
        fence = Fence("a/Scan", (0, "a"))

        def see(ms, kind, source, body, channel="system", cause=None, fence=None, t_ms=t_ms, n=n):
            stamp = (t_ms + ms) / 1000
            return RecordedPacket(
                (t_ms + ms) * MS, agent, Packet(channel, kind, source, "", stamp, n, body, cause, fence)
            )

        if agent == "world":
            yield see(0, "pose", "world/client/Mocap", POSE)
            continue
        yield see(4, "pose", "world/client/Mocap", POSE)
        yield see(5, "pose", "a/device/pose", POSE, cause=("world/client/Mocap", n))
        cause = ("a/device/pose", n)
        yield see(5 + n, "motors", "a/client/Scan", Twist(0.1, 0.2), "ctrl", cause, fence)
    if agent == "a":
        late = Packet("ctrl", "gripper", "a/client/Grip", "", 2.5, 1, {"force_n": 3.0})
        yield RecordedPacket(2500 * MS, "a", late)


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for agent in ("world", "a"):
        writer = RecordingWriter(folder / f"{agent}.mcap", {"agent": agent, "clock": "time of day", "speed": "1.0"})
        for entry in reactions(agent):
            writer.write(entry)
        writer.close()
    return folder


@pytest.fixture
def why(recording):
    def run(*options, code=0):
        result = invoked("why", str(recording), *options)
        assert result.exit_code == code, result.output
        return result

    return run


@pytest.fixture
def found(why):
    return lambda *options: json.loads(why(*options, "--format", "json").stdout)


def test_why_shows_kinds_of_chains_with_latencies(why, found):
    assert found() == {
        "commands": 21,
        "uncaused": 1,
        "left_out": 0,
        "kinds": [
            {
                "count": 20,
                "p50_ms": 16.0,
                "p90_ms": 24.0,
                "p99_ms": 25.0,
                "max_ms": 25.0,
                "step_means_ms": [5.0, 10.5],
                "steps": ["world/client/Mocap pose", "a/device/pose pose", "a/client/Scan motors"],
            }
        ],
    }
    shown = why().stdout
    assert "21 commands; 1 of them answer no packet that was recorded" in shown
    assert "world/client/Mocap pose → a/device/pose pose → a/client/Scan motors" in shown


def test_why_at_a_time_shows_the_command_in_force(found):
    (it,) = found("--time", "720ms")
    assert (it["mission_s"], it["agent"], it["type"], it["source"], it["seq"]) == (
        0.712, "a", "motors", "a/client/Scan", 7,
    )  # fmt: skip
    assert (it["task_id"], it["latency_ms"]) == ("a/Scan", 12.0)
    assert [step["source"] for step in it["chain"]] == ["world/client/Mocap", "a/device/pose", "a/client/Scan"]
    assert [step["at_ms"] for step in it["chain"]] == [0.0, 5.0, 12.0]
    assert [step["travel_ms"] for step in it["chain"]] == [4.0, 0.0, 0.0]
    assert [step["handling_ms"] for step in it["chain"]] == [1.0, 7.0, 0.0]
    assert [step["seen_ns"] for step in it["chain"]] == [700 * MS, 705 * MS, 712 * MS]
    assert it["chain"][0]["body"] == {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.0}
    assert it["alike"]["p90_ms"] == 24.0

    assert [(it["type"], it["seq"]) for it in found("--time", "1min")] == [("gripper", 1), ("motors", 20)]
    assert [it["type"] for it in found("--time", "1min", "--type", "motors")] == ["motors"]
    assert [it["latency_ms"] for it in found("--seq", "3")] == [8.0]
    assert [it["seq"] for it in found("--slowest", "3")] == [20, 19, 18]


def test_why_shows_a_chain_as_a_table(why):
    lines = [line.split() for line in why("--seq", "3").stdout.splitlines()]
    text = why("--seq", "3").stdout
    assert "a motors at 0.308 s, from a/client/Scan for a/Scan (#3)" in text
    assert ["0", "world/client/Mocap", "pose", "#3", "4", "1", "x_m", "1,", "y_m", "2,", "theta_rad", "0"] in lines
    assert ["5", "a/device/pose", "pose", "#3", "0", "3", "x_m", "1,", "y_m", "2,", "theta_rad", "0"] in lines
    assert "8 ms from the first cause to the command. Of 20 commands with such a chain: p50 16" in text

    assert "it answers no recorded packet" in why("--type", "gripper", "--seq", "1").stdout


def test_why_says_what_a_filter_did(tmp_path):
    """At the third command it begins to change commands, at the sixth it lets them pass."""
    writer = RecordingWriter(tmp_path / "a.mcap", {"agent": "a", "clock": "time of day", "speed": "1.0"})
    for n in range(1, 9):
        command = Packet("ctrl", "motors", "a/client/Scan", "", n / 10, n, Twist(0.1, 0.2))
        writer.write(RecordedPacket(100 * n * MS, "a", command))
        if doing := {3: "changes", 6: "passes"}.get(n):
            reason = "keeps clear of b" if doing == "changes" else ""
            fields = {"device": "motors", "filter": "apart", "doing": doing, "reason": reason, "by": "a/client/Scan"}
            event = Packet(
                "log",
                "event",
                "a/device/motors",
                "",
                n / 10,
                n,
                Event("command_filtered", fields),
                ("a/client/Scan", n),
            )
            writer.write(RecordedPacket((100 * n + 1) * MS, "a", event))
    writer.close()
    for number, does in ((2, False), (3, True), (5, True), (6, False)):
        (row,) = json.loads(invoked("why", str(tmp_path), "--seq", str(number), "--format", "json").output)
        does_what = {"device": "motors", "filter": "apart", "doing": "changes", "reason": "keeps clear of b"}
        assert row["filtered"] == ([does_what] if does else [])
    said = invoked("why", str(tmp_path), "--seq", "4").output
    assert "the filter apart of motors changes commands at this moment: keeps clear of b" in said


def test_why_lists_commands(why, found):
    assert [row["seq"] for row in found("--list", "--agent", "a", "--type", "motors")] == list(range(1, 21))
    lines = why("--list").stdout.splitlines()
    assert lines[0] == "    0.106 s  a motors  from a/client/Scan #1      6.000 ms after world/client/Mocap pose"
    assert lines[-1] == "    2.500 s  a gripper  from a/client/Grip #1  answers no packet"


def test_why_without_matching_commands_is_an_error(why, tmp_path):
    for options, code, sentence in (
        (("--agent", "b"), 1, "has no such command. It has commands to a gripper, a motors of a/Scan"),
        (("--task", "a/Other"), 1, "has no such command"),
        (("--time", "0s"), 1, "the recording has no such command before 0 s of mission time"),
        (("--time", "10ms"), 1, "the recording has no such command before 0.01 s of mission time"),
        (("--seq", "99"), 1, "the recording has no such command with the number 99"),
        (("--type", "gripper", "--slowest", "1"), 1, "no such command that answers a recorded packet"),
        (("--time", "1s", "--list"), 2, "use only one of them"),
        (("--time", "soon"), 2, "is not a time"),
    ):
        assert sentence in " ".join(why(*options, code=code).output.split())
    result = invoked("why", str(tmp_path / "none.mcap"))
    assert result.exit_code == 1 and "there is no recording" in result.output


def test_why_begins_a_chain_where_the_packet_arrived(recording):
    arguments = ["why", str(recording / "a.mcap"), "--seq", "3", "--format", "json"]
    (it, *_) = json.loads(invoked(*arguments, "--type", "motors").stdout)
    assert it["latency_ms"] == 4.0 and it["chain"][0]["travel_ms"] is None
    shown = invoked("why", str(recording / "a.mcap"), "--seq", "3").stdout
    assert "no agent recorded when the packet left" in shown


def test_why_uses_mission_time_across_restarts(recording, found):
    writer = RecordingWriter(recording / "a.002.mcap", {"agent": "a", "clock": "time of day", "speed": "1.0"})
    again = Packet("ctrl", "motors", "a/client/Scan", "", 0.25, 1, Twist(0.0, 0.0))
    writer.write(RecordedPacket(5000 * MS, "a", again))
    writer.close()
    assert [(it["mission_s"], it["seq"]) for it in found("--time", "3s", "--type", "motors")] == [(2.025, 20)]
    assert [(it["mission_s"], it["seq"]) for it in found("--time", "6s", "--type", "motors")] == [(5.0, 1)]
