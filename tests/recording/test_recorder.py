"""The recorder in an agent: it is started and stopped by packets, sees everything, and harms nobody."""

import os
import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import pytest
from recording.files import made_files

from pancakes.control import Describe, Migrate, Reschedule, Restart, Start, Stop
from pancakes.devices import Load, Pose
from pancakes.events import Event
from pancakes.kernel.kernel import Counter
from pancakes.kernel.stream import InformationStream
from pancakes.packet import NEIGHBOURS, packet_type
from pancakes.recording.mcap_writer import RecordingParts, parts_of
from pancakes.recording.reader import RecordingReader, Summary, TopicCount
from pancakes.recording.recording import Recording
from pancakes.recording.records import NANOSECONDS, TaskDescription
from pancakes.recording.settings import RecordingSettings
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, threaded_agent

RECORDER = "log/Recorder"


class Count(Task):
    """Count its ticks, and answers poses."""

    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += self.settings.step
        self.publish("system", Load(float(self.state.n)))

    @on("system", Pose)
    def pose(self, packet):
        self.publish("ctrl", Load(-1.0))


@packet_type("test_recorder.picture")
@dataclass
class Picture:
    """A body that may be large."""

    pixels: bytes


class Talk(Task):
    """Tell the neighbours."""

    @every(hz=2)
    def tell(self, tick):
        self.publish("system", Pose(tick.time_s, 0.0, 0.0), to="*")


@pytest.fixture
def fleet():
    with Fleet() as fleet:
        yield fleet


def record(agent, path, **settings):
    reply = agent.ask(Start(RECORDER, {"path": str(path), **settings}))
    assert reply.ok, reply.reason


def finish(agent, path):
    assert agent.ask(Stop(RECORDER)).ok
    return list(RecordingReader(path).entries())


def test_everything_that_is_seen_on_an_agent_is_recorded_with_its_causes(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count})
    begun_s = agent.kernel.mission.now()
    record(agent, tmp_path / "r.mcap")
    sent = agent.publish("system", Pose(1.0, 2.0, 3.0))
    fleet.run_for(2.0)
    entries = finish(agent, tmp_path / "r.mcap")
    loads = [entry for entry in entries if entry.topic == "/a/system/load"]
    assert len(loads) == 20
    assert all(abs(entry.time_ns / 1e9 - entry.packet.stamp_s) < 0.05 for entry in loads)
    (answer,) = [entry.packet for entry in entries if entry.topic == "/a/ctrl/load"]
    assert answer.cause == (sent.source, sent.seq)
    assert {entry.packet.channel for entry in entries} >= {"system", "ctrl", "sysctrl", "log"}
    assert all(entry.time_ns / 1e9 >= begun_s for entry in entries)


def test_what_goes_to_others_is_seen_where_it_leaves_and_where_it_arrives(fleet, tmp_path):
    a, b = fleet.start("a", tasks={"Talk": Talk}), fleet.start("b")
    fleet.connect()
    record(a, tmp_path / "{agent}.mcap")
    record(b, tmp_path / "{agent}.mcap")
    fleet.run_for(2.0)
    finish(a, tmp_path / "a.mcap")
    finish(b, tmp_path / "b.mcap")
    seen = [entry for entry in RecordingReader(tmp_path).entries() if entry.packet.type == "pose"]
    assert {entry.agent for entry in seen} == {"a", "b"}
    left = {entry.packet.seq for entry in seen if entry.agent == "a"}
    assert left >= {entry.packet.seq for entry in seen if entry.agent == "b"} != set()


def test_only_some_channels_and_types_are_recorded_where_that_is_asked_for(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap", channels=["system"], types=["load"])
    agent.publish("system", Pose(1.0, 2.0, 3.0))
    fleet.run_for(1.0)
    assert {entry.topic for entry in finish(agent, tmp_path / "r.mcap")} == {"/a/system/load"}


def test_a_channel_that_is_added_later_is_recorded_too(fleet, tmp_path):
    agent = fleet.start("a")
    record(agent, tmp_path / "r.mcap")
    agent.kernel.stream.open("map")
    fleet.run_for(1.0)
    agent.publish("map", Load(0.5))
    fleet.run_for(1.0)
    assert "/a/map/load" in {entry.topic for entry in finish(agent, tmp_path / "r.mcap")}


def test_what_tasks_are_is_recorded_at_the_beginning_and_when_they_start(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count, "Later": {"type": Count, "start": False, "settings": {"step": 5}}})
    fleet.run_for(1.0)
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(1.0)
    agent.ask(Start("Later"))
    fleet.run_for(1.0)
    entries = finish(agent, tmp_path / "r.mcap")
    count, later = [entry.packet.body for entry in entries if isinstance(entry.packet.body, TaskDescription)]
    assert (count.task_id, count.address, count.settings) == ("a/Count", "a/client/Count", {"step": 1})
    assert count.state["n"] >= 10
    assert count.timers[0]["rate_hz"] == 10.0
    assert count.reads_packet("system", "pose")
    assert not count.reads_packet("system", "load")
    assert (later.task_id, later.settings) == ("a/Later", {"step": 5})


def test_what_another_agent_says_of_its_tasks_is_not_taken_for_its_own(fleet, tmp_path):
    agent, other = fleet.start("a", tasks={"Count": Count}), fleet.start("b")
    fleet.connect()
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(1.0)
    other.publish("log", Event("task_started", {"service": "client", "task": "Count"}), to=NEIGHBOURS)
    fleet.run_for(1.0)
    entries = finish(agent, tmp_path / "r.mcap")
    assert any(entry.packet.source.startswith("b/") and entry.packet.type == "event" for entry in entries)
    (only,) = [entry.packet.body for entry in entries if isinstance(entry.packet.body, TaskDescription)]
    assert only.task_id == "a/Count"


def test_once_a_second_it_is_noted_how_tasks_and_links_fare(fleet, tmp_path):
    a = fleet.start("a", tasks={"Count": Count, "Talk": Talk})
    fleet.start("b")
    fleet.connect()
    record(a, tmp_path / "r.mcap")
    fleet.run_for(3.5)
    found = [entry.packet.body for entry in finish(a, tmp_path / "r.mcap") if entry.packet.type == "task_figures"]
    assert len(found) == 3
    assert [later.mission_s - earlier.mission_s for earlier, later in pairwise(found)] == [pytest.approx(1.0)] * 2
    counts = [task for figures in found for task in figures.tasks if task.task == "client/Count"]
    assert [count.task_id for count in counts] == ["a/Count"] * 3
    (timer,) = counts[0].timers
    assert (timer.timer, timer.rate_hz, timer.missed) == ("tick", 10.0, 0)
    assert counts[-1].timers[0].ticks - timer.ticks == 20
    (link,) = found[-1].links
    assert (link.peer, link.packets_out - found[0].links[0].packets_out) == ("b", 4)


def test_a_recording_follows_one_task_over_agents(fleet, tmp_path):
    a, b = fleet.start("a", tasks={"Count": Count}), fleet.start("b")
    fleet.connect()
    for agent in (a, b):
        record(agent, tmp_path / "{agent}.mcap", task="a/Count")
    fleet.run_for(1.0)
    a.publish("system", Pose(0.0, 0.0, 0.0))
    assert a.ask(Migrate("Count", to="b")).ok
    fleet.run_for(1.0)
    b.publish("system", Pose(1.0, 0.0, 0.0))
    b.publish("system", Load(0.0))
    fleet.run_for(1.0)
    finish(a, tmp_path / "a.mcap")
    finish(b, tmp_path / "b.mcap")
    entries = list(RecordingReader(tmp_path).entries())
    outputs = [entry.packet.body.cpu for entry in entries if entry.topic.endswith("/system/load")]
    assert outputs == [float(n) for n in range(int(outputs[0]), int(outputs[0]) + len(outputs))]
    inputs = [(entry.agent, entry.packet.body.x_m) for entry in entries if entry.packet.type == "pose"]
    assert inputs == [("a", 0.0), ("b", 1.0)]
    stays = Summary.of(entries).stays
    assert [(stay.task_id, stay.agent, stay.epoch) for stay in stays] == [("a/Count", "a", 0), ("a/Count", "b", 1)]


def test_at_any_moment_all_but_the_last_second_is_in_the_file_of_who_is_killed_then(fleet, tmp_path, monkeypatch):
    agent = fleet.start("a", tasks={"Count": Count})
    synced_s = []

    def sync(parts: RecordingParts) -> str:
        synced_s.append(agent.kernel.host.now())
        return ""

    monkeypatch.setattr(RecordingParts, "sync", sync)
    begun_s = agent.kernel.mission.now()
    record(agent, tmp_path / "r.mcap")
    missing_s = []
    for _ in range(60):
        fleet.run_for(0.187)
        entries = [it for it in RecordingReader(tmp_path / "r.mcap").entries() if it.packet.type == "load"]
        newest_s = entries[-1].packet.stamp_s if entries else begun_s
        missing_s.append(agent.kernel.mission.now() - newest_s)
    assert max(missing_s) < 0.75
    # To bring it to the disk costs more, and is only for a power cut.
    assert [later - earlier for earlier, later in pairwise(synced_s)] == [pytest.approx(5.0)]


def test_what_one_task_reads_waits_until_the_agent_has_said_what_it_is(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count})
    settings = RecordingSettings(path=str(tmp_path / "r.mcap"), task="a/Count")
    recording = Recording(agent.kernel, settings, lambda level, text: None, Counter(1).take, "a/log/Recorder")
    recording.asking = lambda: True
    fleet.run_for(0.7)
    assert recording.write() == ""
    assert list(RecordingReader(tmp_path / "r.mcap").entries()) == []
    fleet.run_for(0.1)
    assert recording.write() == ""
    in_time = list(RecordingReader(tmp_path / "r.mcap").entries())
    assert len(in_time) >= 7, "a question without an answer must not keep it from the file"
    recording.end()


def test_a_full_disk_ends_the_recording_with_a_warning_and_never_the_agent(fleet, tmp_path, monkeypatch):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap")

    def full(self):
        raise OSError(28, "No space left on device")

    untapped = []
    untap = InformationStream.untap

    def noted(stream, channel, tap):
        untapped.append(channel)
        untap(stream, channel, tap)

    monkeypatch.setattr(InformationStream, "untap", noted)
    monkeypatch.setattr(RecordingParts, "flush", full)
    agent.wait_for_event("recording_stopped")
    fleet.run_for(1.0)
    (warning,) = [line for line in agent.lines("warning") if "recording" in line]
    assert warning.endswith("r.mcap ends: its disk failed: No space left on device")
    assert agent.ask(Describe(RECORDER)).result["state"] == "stopped"
    assert agent.running() == ["Count"]
    assert "system" in untapped


def test_a_recording_whose_file_is_moved_goes_on_in_a_further_file_and_says_so(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(2.0)
    (tmp_path / "away").mkdir()
    (tmp_path / "r.mcap").rename(tmp_path / "away" / "r.mcap")
    fleet.run_for(2.0)
    (tmp_path / "r.002.mcap").unlink()
    fleet.run_for(2.0)
    assert agent.ask(Stop(RECORDER)).ok
    told = [line for line in agent.lines("warning") if "moved or removed" in line]
    assert len(told) == 2 and str(tmp_path / "r.002.mcap") in told[0] and str(tmp_path / "r.003.mcap") in told[1]
    before, after = RecordingReader(tmp_path / "away"), RecordingReader(tmp_path / "r.003.mcap")
    moved = [entry.packet.body.cpu for entry in before.entries() if entry.topic == "/a/system/load"]
    assert moved[-1] >= 20 and all(reading.whole for reading in before.readings)
    assert len([entry for entry in after.entries() if entry.topic == "/a/system/load"]) >= 15


@pytest.mark.parametrize("left", [0, 100])
def test_a_recording_whose_file_is_truncated_goes_on_in_a_further_file_and_says_so(fleet, tmp_path, left):
    """As `: > r.mcap` does, and `copytruncate` of logrotate."""
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(2.0)
    os.truncate(tmp_path / "r.mcap", left)
    fleet.run_for(2.0)
    assert agent.ask(Stop(RECORDER)).ok
    (told,) = [line for line in agent.lines("warning") if "truncated" in line]
    assert str(tmp_path / "r.mcap") in told and str(tmp_path / "r.002.mcap") in told
    assert (tmp_path / "r.mcap").stat().st_size == left, "no hole is written behind what is left"
    for path in (tmp_path / "r.002.mcap", tmp_path):
        after = RecordingReader(path)
        assert len([entry for entry in after.entries() if entry.topic == "/a/system/load"]) >= 8
        assert after.readings[-1].whole


def test_a_recording_that_began_before_the_clock_was_set_is_dated_once_it_is(tmp_path, monkeypatch):
    """A board without a battery for its clock: in 1970 until it has reached a time server."""
    true_ns, ahead_ns = time.time_ns, -time.time_ns()
    monkeypatch.setattr(time, "time_ns", lambda: true_ns() + ahead_ns)
    path = tmp_path / "r.mcap"
    with threaded_agent("a", tasks={"Count": Count}) as agent:
        assert agent.ask(Start(RECORDER, {"path": str(path)})).ok
        agent.wait_until(lambda: any(True for _ in RecordingReader(path).entries()))
        early = RecordingReader(path)
        assert next(iter(early.entries())).time_ns < 100 * NANOSECONDS
        assert any("has no dates: the clock of a was not set" in note for note in early.notes())
        ahead_ns = 0
        agent.wait_until(lambda: any("clock of this machine was set" in line for line in agent.lines("warning")))
        n = agent.task("Count").state.n
        agent.wait_until(lambda: agent.task("Count").state.n > n + 5)
        assert agent.ask(Stop(RECORDER)).ok
    reader = RecordingReader(path)
    entries = list(reader.entries())
    assert len(reader.files) == 2
    assert 0 < true_ns() - entries[0].time_ns < 60 * NANOSECONDS and entries[-1].time_ns < true_ns()
    counts = [(entry.time_ns, entry.packet.body.cpu) for entry in entries if entry.topic == "/a/system/load"]
    assert [count for _, count in counts] == list(range(int(counts[0][1]), int(counts[0][1]) + len(counts)))
    assert all(0 < after - before < NANOSECONDS // 2 for (before, _), (after, _) in pairwise(counts))
    assert any("before its clock was set were moved by +" in note for note in reader.notes())
    described = [it.packet.body for it in entries if isinstance(it.packet.body, TaskDescription)]
    assert all(0 < true_ns() - body.time_ns < 60 * NANOSECONDS for body in described)
    # Also by themselves the files of the second kind are right, for other programs.
    (later,) = [file for file in reader.files if file != path]
    assert 0 < true_ns() - next(iter(RecordingReader(later).entries())).time_ns < 60 * NANOSECONDS


def test_a_disk_too_slow_for_large_packets_costs_packets_and_not_the_memory(fleet, tmp_path, monkeypatch):
    agent = fleet.start("a")
    record(agent, tmp_path / "r.mcap", types=["test_recorder.picture"])
    monkeypatch.setattr(Recording, "write", lambda recording: "")
    for _ in range(70):
        agent.publish("system", Picture(bytes(2**20)))
    monkeypatch.undo()
    fleet.run_for(2.0)
    (warning,) = [line for line in agent.lines("warning") if "lacks" in line]
    assert "the recording lacks" in warning and "the disk is too slow" in warning
    assert len(finish(agent, tmp_path / "r.mcap")) == 64


def test_a_pose_that_is_none_costs_a_warning_and_not_the_recording(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap")
    wrong: tuple[Any, ...] = (object(), "north", None)
    for theta_rad in wrong:
        agent.task("Count").publish("system", Pose(0.0, 0.0, theta_rad))
    fleet.run_for(1.0)
    assert agent.ask(Describe(RECORDER)).result["state"] == "running"
    (warning,) = [line for line in agent.lines("warning") if "cannot be recorded" in line]
    assert "its body.theta_rad is of the type object" in warning
    assert any(entry.packet.type == "load" for entry in finish(agent, tmp_path / "r.mcap"))


@pytest.fixture
def kill(fleet, monkeypatch):
    """End an agent as a kill does, and closes the file that was being written as the operating system does."""
    made = made_files(monkeypatch)

    def ended(name):
        fleet.crash(name)
        made[-1].raw.close()

    return ended


def parts(path):
    return [file.name for file in parts_of(path)]


def test_a_recording_that_was_asked_for_goes_on_in_a_further_file_after_a_kill(fleet, tmp_path, kill):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap", types=["load"])
    fleet.run_for(2.0)
    for boot in (2, 3):
        kill("a")
        agent = fleet.restart("a")
        fleet.run_for(2.0)
        assert parts(tmp_path / "r.mcap") == ["r.mcap", "r.002.mcap", "r.003.mcap"][:boot]
        assert agent.ask(Describe(RECORDER)).result["settings"]["types"] == ("load",)
    entries = finish(agent, tmp_path / "r.mcap")
    assert {entry.topic for entry in entries} == {"/a/system/load"}
    assert len(entries) > 40  # of 60, less than a second's at each kill
    fleet.crash("a")
    agent = fleet.restart("a")
    assert agent.ask(Describe(RECORDER)).result["state"] == "stopped"
    assert len(parts(tmp_path / "r.mcap")) == 3


def test_what_the_configuration_records_begins_anew_with_each_start_whatever_went_on(fleet, tmp_path, kill):
    config = f'[record]\npath = "{tmp_path}/c.mcap"\n'
    agent = fleet.start("a", config)
    assert agent.ask(Stop(RECORDER)).ok
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(1.0)
    kill("a")
    fleet.restart("a")
    fleet.run_for(1.0)
    assert parts(tmp_path / "r.mcap") == ["r.mcap"]
    assert sorted(path.name for path in tmp_path.glob("c*")) == ["c-2.mcap", "c.mcap"]


def test_it_goes_on_where_the_agent_was_stopped_in_good_order_too(fleet, tmp_path):
    agent = fleet.start("a")
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(1.0)
    fleet.stop("a")
    fleet.restart("a")
    assert parts(tmp_path / "r.mcap") == ["r.mcap", "r.002.mcap"]


def test_a_recorder_that_went_on_and_is_restarted_begins_a_new_recording(fleet, tmp_path, kill):
    agent = fleet.start("a")
    record(agent, tmp_path / "r.mcap")
    fleet.run_for(1.0)
    kill("a")
    agent = fleet.restart("a")
    assert agent.ask(Restart(RECORDER)).ok
    assert parts(tmp_path / "r.mcap") == ["r.mcap", "r.002.mcap"]
    assert parts(tmp_path / "r-2.mcap") == ["r-2.mcap"]


def test_that_a_recording_may_not_go_on_or_may_go_on_is_told_where_the_journal_cannot_write(
    fleet, tmp_path, monkeypatch
):
    agent = fleet.start("a")
    path = tmp_path / "r.mcap"

    def fail(entry, then, failed, may=None):
        failed("the disk is full")

    with monkeypatch.context() as broken:
        broken.setattr(agent.agent.store, "persist", fail)
        record(agent, path)
        assert agent.lines("warning")[-1] == (
            f"the recording {path} will not go on when a is started again: the disk is full"
        )
    assert agent.ask(Stop(RECORDER)).ok
    record(agent, path)
    with monkeypatch.context() as broken:
        broken.setattr(agent.agent.store, "persist", fail)
        assert agent.ask(Stop(RECORDER)).reason == (
            "a/log/Recorder is stopped, but may record again after a crash: the disk is full"
        )
        assert agent.lines("warning")[-1] == "a recording may go on when a is started again: the disk is full"
    fleet.crash("a")
    agent = fleet.restart("a")
    assert agent.ask(Describe(RECORDER)).result["state"] == "running"


def test_a_stop_that_was_not_written_is_written_with_the_next_end(fleet, tmp_path, monkeypatch):
    agent = fleet.start("a")
    record(agent, tmp_path / "r.mcap")
    with monkeypatch.context() as broken:
        broken.setattr(agent.agent.store, "persist", lambda entry, then, failed, may=None: failed("the disk is full"))
        assert not agent.ask(Stop(RECORDER)).ok
    assert not agent.ask(Start(RECORDER, {"path": str(tmp_path / "s.mcap"), "free_mib": 1e9})).ok
    fleet.run_for(0.1)
    fleet.crash("a")
    assert fleet.restart("a").ask(Describe(RECORDER)).result["state"] == "stopped"


def test_what_the_configuration_recorded_once_ends_what_went_on_before(fleet, tmp_path, kill):
    agent = fleet.start("a")
    record(agent, tmp_path / "r.mcap")
    kill("a")
    fleet.start("a", f'[record]\npath = "{tmp_path}/c.mcap"\n')
    fleet.run_for(1.0)
    kill("a")
    agent = fleet.start("a")
    assert agent.ask(Describe(RECORDER)).result["state"] == "stopped"


def test_a_recording_that_ended_by_itself_does_not_go_on(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap", limit_mib=0.01)
    assert "its limit of 0.01 MiB" in agent.wait_for_event("recording_stopped")["reason"]
    fleet.run_for(0.1)
    fleet.crash("a")
    assert fleet.restart("a").ask(Describe(RECORDER)).result["state"] == "stopped"


def test_what_goes_on_keeps_to_the_limit_of_the_whole(fleet, tmp_path, kill):
    agent = fleet.start("a", tasks={"Count": Count})
    record(agent, tmp_path / "r.mcap", limit_mib=0.05)
    fleet.run_for(2.0)
    size = sum(path.stat().st_size for path in parts_of(tmp_path / "r.mcap"))
    assert size < 0.05 * 2**20
    while agent.ask(Describe(RECORDER)).result["state"] == "running":
        kill("a")
        agent = fleet.restart("a")
        fleet.run_for(2.0)
    assert sum(path.stat().st_size for path in parts_of(tmp_path / "r.mcap")) < 0.1 * 2**20


def test_what_is_not_said_at_a_start_is_as_the_configuration_says(fleet, tmp_path):
    agent = fleet.start("a", '[record]\nstart = false\ntypes = ["pose"]\n')
    record(agent, tmp_path / "r.mcap", channels=["system"], split_mib=1)
    finish(agent, tmp_path / "r.mcap")
    record(agent, tmp_path / "s.mcap")
    settings = agent.ask(Describe(RECORDER)).result["settings"]
    assert (settings["channels"], settings["types"], settings["split_mib"]) == ((), ("pose",), 256.0)


def test_too_little_room_on_the_disk_is_refused_at_once(fleet, tmp_path):
    agent = fleet.start("a")
    reply = agent.ask(Start(RECORDER, {"path": str(tmp_path / "r.mcap"), "free_mib": 1e9}))
    assert not reply.ok
    assert f"r.mcap does not begin: less than 1e+09 MiB are free on the disk of {tmp_path} (" in reply.reason
    assert not (tmp_path / "r.mcap").exists()


def test_a_place_that_cannot_be_written_is_refused_with_the_reason(fleet, tmp_path):
    agent = fleet.start("a")
    (tmp_path / "file").write_text("")
    reply = agent.ask(Start(RECORDER, {"path": str(tmp_path / "file" / "r.mcap")}))
    assert "r.mcap cannot be written: File exists" in reply.reason
    assert "limit_mib: expected a number >= 0" in agent.ask(Start(RECORDER, {"limit_mib": -1})).reason
    reason = agent.ask(Start(RECORDER, {"path": str(tmp_path / "r.mcap"), "task": "Count"})).reason
    assert "'Count' is no task id: it must read birthplace/name" in reason
    assert not (tmp_path / "r.mcap").exists()


def test_packets_that_came_at_once_have_no_rate():
    def topic(last_s):
        return TopicCount("a", "sysctrl", "command", packets=3, first_ns=0, last_ns=round(last_s * 1e9)).row()

    assert topic(0.001)["rate_hz"] is None
    assert topic(1.0)["rate_hz"] == 2.0


def test_the_table_record_starts_it_with_the_agent(fleet, tmp_path):
    agent = fleet.start("a", f'[record]\npath = "{tmp_path}/x.mcap"\nchannels = ["system"]\n', tasks={"Count": Count})
    assert agent.ask(Reschedule("Count", 20.0)).ok
    fleet.run_for(1.0)
    assert len(finish(agent, tmp_path / "x.mcap")) >= 20
    waiting = fleet.start("b", '[record]\nstart = false\npath = "never.mcap"\n')
    assert waiting.ask(Describe(RECORDER)).result["state"] == "stopped"
    assert waiting.ask(Describe(RECORDER)).result["settings"]["path"] == "never.mcap"


def test_of_a_recording_that_the_configuration_starts_nothing_is_written_down(fleet, tmp_path):
    fleet.start("a", f"[record]\npath = '{tmp_path / 'r.mcap'}'\n")
    fleet.run_for(1.0)
    fleet.stop("a")
    assert (tmp_path / "r.mcap").exists()
    assert not [name for name in fleet.disk("a") if name.startswith("recording.")]
