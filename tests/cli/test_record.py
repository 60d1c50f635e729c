"""`pancakes record ...` and `pancakes-agent --record`, with running agents and a killed one."""

import json
import os
import signal
import time

from cli.processes import PATIENCE_S

LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 50\n'
HERE = 'folders = ["."]'
IDLE = """
from pancakes.task import Task


class Idle(Task):
    pass
"""


def rows(rig, *arguments, code=0):
    result = rig.pancakes("record", *arguments, "--format", "json")
    assert result.returncode == code, result.stderr
    return json.loads(result.stdout)


def grown(path, size):
    """Wait until a file has grown to a size."""
    until_s = time.monotonic() + PATIENCE_S
    while not path.exists() or path.stat().st_size < size:
        assert time.monotonic() < until_s, f"{path} does not grow"


def test_record_verbs_start_list_stop_and_show(rig):
    for name in ("a", "b"):
        rig.ready(name, LOAD, agent=HERE)
    assert rows(rig, "start", "--dry-run") == [
        {"agent": "a", "done": "dry run", "path": None},
        {"agent": "b", "done": "dry run", "path": None},
    ]
    assert {row["path"] for row in rows(rig, "list")} == {None}
    started = rows(rig, "start", "--path", "run/{agent}.mcap", "--channel", "system")
    assert started == [
        {"agent": "a", "done": "recording", "path": "run/a.mcap"},
        {"agent": "b", "done": "recording", "path": "run/b.mcap"},
    ]
    assert [row["done"] for row in rows(rig, "list")] == ["recording", "recording"]
    again = rig.pancakes("record", "start", "a")
    assert again.returncode == 1 and "running already" in again.stderr
    for name in ("a", "b"):
        grown(rig.directory / "run" / f"{name}.mcap", 2000)
    assert [row["done"] for row in rows(rig, "stop", "--dry-run")] == ["dry run", "dry run"]
    assert [(row["agent"], row["done"]) for row in rows(rig, "stop")] == [("a", "complete"), ("b", "complete")]
    assert rig.pancakes("record", "stop").stderr == "no agent is recording\n"
    (info,) = rows(rig, "info", "run")
    assert info["whole"]
    assert {(topic["agent"], topic["channel"], topic["type"]) for topic in info["topics"]} == {
        ("a", "system", "load"), ("b", "system", "load")
    }  # fmt: skip
    assert info["packets"] == sum(topic["packets"] for topic in info["topics"]) > 2
    assert "whole" in rig.pancakes("record", "info", "run").stdout


def test_record_start_reports_missing_channels_and_tasks(rig):
    rig.install("records", "[pancakes.tasks]\nrecords.Idle = plugin_records:Idle\n", IDLE)
    rig.ready("a", '[channel.map]\n[task.Idle]\ntype = "records.Idle"\n', agent=HERE)
    rig.ready("b", agent=HERE)
    result = rig.pancakes("record", "start", "--channel", "mapp")
    assert (result.returncode, result.stderr.partition(".")[0]) == (1, "no agent has a channel 'mapp'")
    assert {row["path"] for row in rows(rig, "list")} == {None}
    result = rig.pancakes("record", "start", "--channel", "map", "--channel", "recording", "--path", "{agent}.mcap")
    assert (result.returncode, result.stderr) == (0, "b: no channel 'map', so it is not recorded there\n")
    rows(rig, "stop")

    told = "the task a/Idel does not run there now: its packets are recorded when it arrives\n"
    for task, said in (("a/Idel", told), ("a/Idle", "")):
        result = rig.pancakes("record", "start", "a", "--task", task, "--path", "r.mcap")
        assert (result.returncode, result.stderr) == (0, said)
        rows(rig, "stop")


def test_record_start_reports_unknown_packet_types(rig):
    rig.ready("a", agent=HERE)
    result = rig.pancakes("record", "start", "--type", "tempreature", "--type", "pose", "--dry-run")
    said = "no packet type 'tempreature' is installed here, did you mean 'temperature'?\n"
    assert (result.returncode, result.stderr) == (0, said)


def test_refused_record_start_records_nothing(rig):
    rig.ready("a", "[record]\nstart = false\nfree_mib = 1e9\n", agent='folders = [".", "/proc"]')
    for path in ("r.mcap", "/proc/nowhere/a.mcap"):
        result = rig.pancakes("record", "start", "--path", path)
        assert (result.returncode, result.stdout) == (1, "") and path in result.stderr
        assert rows(rig, "list") == [{"agent": "a", "done": result.stderr.strip().partition(": ")[2], "path": None}]
    assert not (rig.directory / "r.mcap").exists()
    found = json.loads(rig.pancakes("doctor", "--no-machine", "--format", "json").stdout)
    assert not [row["text"] for row in found if "ecord" in row["about"] + row["text"]], "whoever asked was told"


def test_record_resumes_after_a_kill_but_not_after_a_stop(rig):
    agent = rig.ready("a", LOAD, agent=HERE)
    rows(rig, "start", "--path", "run/{agent}.mcap")
    grown(rig.directory / "run" / "a.mcap", 4000)
    os.kill(agent.pid, signal.SIGKILL)
    agent.ended()
    agent = rig.ready("a", LOAD, agent=HERE)
    grown(rig.directory / "run" / "a.002.mcap", 4000)
    assert [(row["done"], row["path"]) for row in rows(rig, "list")] == [
        ("recording", str(rig.directory / "run" / "a.mcap"))
    ]
    assert [row["done"] for row in rows(rig, "stop")] == ["complete"]
    os.kill(agent.pid, signal.SIGKILL)
    agent.ended()
    rig.ready("a", LOAD, agent=HERE)
    assert [row["done"] for row in rows(rig, "list")] == ["stopped"]
    assert not (rig.directory / "run" / "a.003.mcap").exists()


def test_record_repair_recovers_all_but_the_last_moment(rig):
    agent = rig.ready("a", LOAD, "--record", "r.mcap")
    path = rig.directory / "r.mcap"
    grown(path, 20_000)
    os.kill(agent.pid, signal.SIGKILL)
    agent.ended()
    assert rows(rig, "repair", "r.mcap", "--dry-run")[0]["done"] == "dry run"
    info = rig.pancakes("record", "info", "r.mcap", "--format", "json")
    assert "is cut off" in info.stderr
    (told,) = json.loads(info.stdout)
    assert not told["whole"]
    (mended,) = rows(rig, "repair", "r.mcap", "--out", "mended.mcap")
    assert (mended["file"], mended["done"]) == ("mended.mcap", "repaired")
    (whole,) = rows(rig, "info", "mended.mcap")
    assert whole["whole"]
    assert whole["packets"] == told["packets"]
    # What was flushed is all that was written; a flush comes each half second.
    assert whole["duration_s"] > 0.5
    assert rows(rig, "repair", "mended.mcap")[0]["done"] == "whole already"

    (rig.directory / "x.mcap").write_text("hello")
    for verb in ("info", "repair"):
        result = rig.pancakes("record", verb, "x.mcap")
        assert (result.returncode, result.stdout) == (1, "") and "x.mcap is not a recording" in result.stderr
