"""The Log Service: what is said on `log`, on the console and in a file."""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from pancakes.control import Configure, Describe, History, Start, Stop
from pancakes.devices import Pose
from pancakes.events import Event, LogLine, line_of, record_of
from pancakes.kernel.payload_size import weigh
from pancakes.packet import Packet, packet_type
from pancakes.services.log import REMEMBERED_BYTES
from pancakes.task import Task, every
from pancakes.testing import Fleet, threaded_agent


@packet_type("test_log.note")
@dataclass(frozen=True)
class Note:
    """Something else that a task may say on `log`."""

    text: str


class Talkative(Task):
    @every(hz=1)
    def talk(self, tick):
        for level in ("debug", "info", "warning", "error"):
            self.log(level, f"{level} at {tick.time_s:g}")
        self.event("talked", times=int(tick.time_s), nothing=None)
        self.publish("log", Note("by the way"))


def talk(capsys, **settings):
    with Fleet(1) as fleet:
        fleet.start("a", tasks={"Talkative": Talkative}, services={"log": {"settings": settings}})
        fleet.run_for(1.5)
    return capsys.readouterr().err


def test_the_console_shows_lines_and_events_with_their_time_and_place(capsys):
    shown = talk(capsys).splitlines()
    assert "    1.000 warning a/client/Talkative: warning at 1" in shown
    assert "    1.000 info    a/client/Talkative: talked times=1" in shown
    assert any("by the way" in line for line in shown)
    assert not any("debug at" in line for line in shown)


def test_the_console_shows_what_is_of_its_level_or_above(capsys):
    shown = talk(capsys, level="error")
    assert "error at 1" in shown
    assert "warning at" not in shown and "talked" not in shown
    assert "debug at 1" in talk(capsys, level="debug")


def test_the_console_may_be_silent(capsys):
    assert talk(capsys, console=False) == ""


def test_the_file_has_everything_one_object_a_line_to_the_last(tmp_path):
    path = tmp_path / "logs" / "a.jsonl"
    services = {"log": {"settings": {"console": False, "file": str(path)}}}
    with threaded_agent("a", tasks={"Talkative": Talkative}, services=services, speed=50.0) as agent:
        agent.wait_for(Event, lambda event: event.kind == "talked")
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    kinds = {record["kind"] for record in records}
    assert {"line", "talked", "service_started", "ready", "test_log.note", "task_stopped"} <= kinds
    assert all({"t_s", "agent", "source"} <= set(record) for record in records)
    talked = [record for record in records if record["kind"] == "talked"]
    assert {(record["agent"], record["source"]) for record in talked} == {("a", "a/client/Talkative")}
    assert talked[0]["times"] >= 1 and talked[0]["t_s"] >= talked[0]["times"]  # of its tick, and of its event
    # It is appended to at the next start.
    with threaded_agent("a", services=services):
        pass
    assert len(path.read_text(encoding="utf-8").splitlines()) > len(records)


def test_a_record_is_json_whatever_is_said():
    packet = Packet("log", "event", "a/client/T", "", 1.25, 3, Event("odd", {"what": Pose(1.0, 2.0, 3.0), "ü": {1, 2}}))
    record = json.loads(line_of(record_of(packet)))
    assert (record["t_s"], record["kind"]) == (1.25, "odd")
    line = Packet("log", "line", "a/client/T", "", 0.1 + 0.2, 3, LogLine("info", 'a "quote"\nand a line'))
    assert json.loads(line_of(record_of(line)))["t_s"] == 0.3
    assert "\n" not in line_of(record_of(line))


def test_a_record_has_lists_where_an_event_has_arrays():
    body = Event("settings_changed", {"settings": {"gains": np.array([1.5, 2.0])}, "sum": np.int64(3)})
    record = record_of(Packet("log", "event", "a/client", "", 0.3, 1, body))
    assert (record["settings"], record["sum"]) == ({"gains": [1.5, 2.0]}, 3)
    assert json.loads(line_of(record))["settings"] == {"gains": [1.5, 2.0]}


def test_the_log_may_be_turned_off_and_the_rest_goes_on():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Talkative": Talkative})
        assert agent.ask(Stop("log")).ok
        fleet.run_for(3.0)
        assert len(agent.events("talked")) == 3


def remembered(agent):
    return [record for record in agent.ask(History()).result if record["kind"] == "said"]


def test_so_many_lines_are_remembered_as_its_settings_say():
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": False, "remembered": 3}}})
        for number in range(5):
            agent.publish("log", Event("said", {"number": number}))
        assert [record["number"] for record in remembered(agent)] == [2, 3, 4]


def test_the_first_line_that_is_remembered_has_the_number_1():
    with Fleet(1) as fleet:
        agent = fleet.start("a")
        assert agent.ask(History()).result[0]["entry"] == 1


def test_4_mib_are_remembered():
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": False}}})
        for number in range(20):
            agent.publish("log", Event("said", {"number": number, "map": "x" * 256 * 1024}))
        seen: list[int] = []
        while page := agent.ask(History(after=seen[-1] if seen else 0)).result:
            seen += [record["entry"] for record in page]
        assert len(seen) == 15


def test_a_page_ends_before_the_first_line_that_does_not_fit():
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": False, "remembered": 8}}})
        for number in range(7):
            agent.publish("log", Event("said", {"number": number, "text": "x" * 9_000}))
        agent.publish("log", Event("said", {"number": 7, "text": ""}))
        page = agent.ask(History()).result
        assert [record["number"] for record in page] == [0, 1, 2, 3, 4, 5]


def test_of_what_is_large_less_is_remembered_but_always_the_last():
    with Fleet(1) as fleet:
        agent = fleet.start("a")
        for _ in range(5):
            agent.publish("log", Event("seen", {"image": bytes(REMEMBERED_BYTES // 3 + 1)}))
        last = agent.ask(History()).result[-1]["entry"]
        assert [record["entry"] for record in agent.ask(History()).result] == [last - 1, last]
        agent.publish("log", Event("seen", {"image": bytes(2 * REMEMBERED_BYTES)}))
        assert [record["entry"] for record in agent.ask(History()).result] == [last + 1]


def test_a_recording_is_as_the_configuration_says_and_not_as_it_was_started_last(tmp_path):
    with Fleet(1) as fleet:
        agent = fleet.start("a")
        first = {"path": str(tmp_path / "1.mcap"), "channels": ["system"]}
        assert agent.ask(Start("log/Recorder", first)).ok
        assert agent.ask(Describe("log/Recorder")).result["settings"]["channels"] == ("system",)
        assert agent.ask(Stop("log/Recorder")).ok
        assert agent.ask(Start("log/Recorder", {"path": str(tmp_path / "2.mcap")})).ok
        assert agent.ask(Describe("log/Recorder")).result["settings"]["channels"] == ()


def test_what_waits_for_the_disk_before_a_recording_begins_is_told_so(tmp_path):
    with Fleet(1) as fleet:
        agent = fleet.start("a")
        fleet.faults.slow_disk("a", 6.0)
        begun_s = fleet.now()
        told = agent.ask(Start("log/Recorder", {"path": str(tmp_path / "1.mcap")}), timeout_s=10.0)
        assert told.reason == (
            "a/log/Recorder waits for the disk; what was asked for is done as soon as that can write"
        )
        assert fleet.now() - begun_s == pytest.approx(2.5, abs=0.1)
        agent.wait_until(lambda: agent.ask(Describe("log/Recorder")).result["state"] == "running")


def test_what_waits_for_a_disk_or_a_terminal_has_a_thread_of_its_own():
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": True}}})
        console = agent.component("log/Console")
        assert console is not None and console.facade.blocking


def test_the_console_goes_on_as_it_was_set():
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": True}}})
        assert agent.ask(Configure("log/Console", {"level": "error"})).ok
        assert agent.ask(Stop("log/Console")).ok
        assert agent.ask(Start("log/Console")).ok
        assert agent.ask(Describe("log/Console")).result["settings"]["level"] == "error"


@pytest.mark.parametrize(("length", "said"), [(20_000, "line"), (20_001, "20001 characters left out")])
def test_a_line_is_told_up_to_20_000_characters(length, said):
    with Fleet(1) as fleet:
        agent = fleet.start("a")
        empty = agent.publish("log", LogLine("info", ""))
        agent.publish("log", LogLine("info", "line".ljust(length - len(line_of(record_of(empty))))))
        assert agent.ask(History()).result[-1]["text"].rstrip() == said


@pytest.mark.parametrize(("last", "count"), [(15_000, 4), (15_001, 3)])
def test_a_page_has_up_to_60_000_characters(last, count):
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": False, "remembered": 4}}})
        empty = line_of(record_of(agent.publish("log", LogLine("info", ""))))
        for length in (15_000, 15_000, 15_000, last):
            agent.publish("log", LogLine("info", "x" * (length - len(empty))))
        assert len(agent.ask(History()).result) == count


def test_what_takes_4_mib_to_the_byte_is_remembered():
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": False}}})
        quarter = REMEMBERED_BYTES // 4
        image = bytes(quarter - weigh(Event("said", {"image": b""})))
        for _ in range(4):
            agent.publish("log", Event("said", {"image": image}))
        assert weigh(Event("said", {"image": image})) == quarter == 1024 * 1024
        assert len(agent.ask(History()).result) == 4


def test_a_console_that_is_slow_for_a_moment_shows_4096_lines_and_loses_the_oldest_of_more(capsys):
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"share_kib_s": 0.0}}})
        for count, first in ((4096, 0), (4097, 1)):
            capsys.readouterr()
            for number in range(count):
                agent.publish("log", LogLine("info", f"line {number}"))
            fleet.run_for(0.1)
            shown = [line for line in capsys.readouterr().err.splitlines() if "a/test/Probe: line" in line]
            assert [int(line.rpartition(" ")[2]) for line in shown] == list(range(first, count))


def test_a_recording_that_goes_on_keeps_its_settings_and_the_file_and_the_console_keep_theirs(tmp_path):
    with Fleet(1) as fleet:
        settings = {"level": "error", "file": str(tmp_path / "a.jsonl")}
        agent = fleet.start("a", services={"log": {"settings": settings}})
        path = str(tmp_path / "r.mcap")
        assert agent.ask(Start("log/Recorder", {"path": path, "channels": ["system"]})).ok
        fleet.run_for(0.1)
        fleet.stop("a")
        agent = fleet.restart("a")
        assert agent.running("log") == ["Console", "File", "Recorder"]
        recorder = agent.ask(Describe("log/Recorder")).result["settings"]
        assert (recorder["path"], recorder["channels"]) == (path, ("system",))
        assert agent.ask(Describe("log/Console")).result["settings"]["level"] == "error"
        assert sorted(found.name for found in tmp_path.iterdir()) == ["a.jsonl", "r.002.mcap", "r.mcap"]


class Pipe:
    """A pipe whose reader goes away."""

    def __init__(self):
        self.written, self.broken = [], False

    def write(self, text):
        if self.broken:
            raise BrokenPipeError(32, "Broken pipe")
        self.written.append(text)

    def flush(self):
        pass


def test_a_console_whose_reader_has_gone_stops_and_its_service_goes_on(monkeypatch):
    pipe = Pipe()
    monkeypatch.setattr("sys.stderr", pipe)
    with Fleet(1) as fleet:
        agent = fleet.start("a", services={"log": {"settings": {"console": True}}})
        agent.publish("log", LogLine("warning", "read"))
        assert any("read" in text for text in pipe.written) and agent.running("log") == ["Console"]
        pipe.broken = True
        agent.publish("log", LogLine("warning", "not read"))
        fleet.run_for(0.1)
        assert agent.running("log") == [] and agent.events("task_failed") == []
        assert any(record.get("text") == "not read" for record in agent.ask(History()).result)
