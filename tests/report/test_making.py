"""A report from end to end: a recording goes in, a page and pictures that others can open come out."""

import json
import math
import re
import sys
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner

from pancakes.devices import Battery, Pose, Twist
from pancakes.errors import PancakesError
from pancakes.events import Event, LogLine
from pancakes.packet import Fence, Packet
from pancakes.recording.mcap_writer import RecordingWriter
from pancakes.recording.records import RecordedPacket
from pancakes.recording.task_statistics import OneLink, OneTask, TaskFigures, TimerFigures
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.tools.cli.main import pancakes
from pancakes.tools.report.html_report import make_report

S = 1_000_000_000
PICTURES = {
    "paths", "tasks", "moves", "batteries", "rates", "lateness", "drops", "traffic-links", "traffic-channels",
    "reactions",
}  # fmt: skip
LINES = [
    {"peer": "b", "answer": "bid", "fate": "won", "cost": 1.5, "terms": {}, "reason": ""},
    {"peer": "c", "answer": "refused", "fate": "refused", "cost": None, "terms": {}, "reason": "<lacks> motors"},
]
MIGRATION = {
    "task": "Scan", "task_id": "a/Scan", "source": "a", "asked_by": "rule", "cost": "tasks", "outcome": "moved",
    "winner": "b", "lines": LINES, "duration_s": 0.5, "offer": "1@a",
}  # fmt: skip


def mission(agent):
    """Return the recording of one of two robots: Scan drives `a` for 30 s, then `b`."""
    mine = agent == "a"
    for second in range(60):
        time_ns, t = second * S, float(second)
        runs = (t < 30) == mine
        angle = t / 10.0

        def see(kind, body, source, channel="system", to="", cause=None, fence=None, later_ms=0, at=time_ns, n=second):
            packet = Packet(channel, kind, source, to, n, n + 1, body, cause, fence)
            return RecordedPacket(at + later_ms * 1_000_000, agent, packet)

        pose = Pose(math.cos(angle) + mine, math.sin(angle), 0.0)
        mocap = "world/client/Mocap"
        yield see("pose", pose, mocap, to=agent)
        yield see("pose", pose, f"{agent}/device/pose", cause=(mocap, second + 1), later_ms=1)
        yield see("battery", Battery(7.0, 1.0 - t / 100), f"{agent}/device/battery", later_ms=1)
        if runs:
            fence = Fence("a/Scan", (0 if mine else 1, "a"))
            cause = (f"{agent}/device/pose", second + 1)
            yield see("motors", Twist(0.1, 0.0), f"{agent}/client/Scan", "ctrl", cause=cause, fence=fence, later_ms=3)
        timer = TimerFigures("tick", 10.0, 10 * second, 0, 0.01 * second, 0.02)
        task = OneTask("client/Scan", "a/Scan", 1, 0, second // 10, (timer,))
        link = OneLink("b" if mine else "a", 0.001, second, 100 * second, second, 100 * second, 0)
        yield see("task_figures", TaskFigures(t, (task,), (link,)), f"{agent}/log/Recorder", "recording", later_ms=4)
        if mine and second == 30:
            yield see("event", Event("migration", MIGRATION), "a/network/TaskMigrator", "log", later_ms=5)
            yield see("line", LogLine("warning", "a & b < c"), "a/network", "log", later_ms=5)


def written(path, entries, clock="time of day"):
    writer = RecordingWriter(path, {"agent": path.stem, "clock": clock, "speed": "1.0"})
    for number, entry in enumerate(entries):
        writer.write(entry)
        if number % 20 == 19:
            writer.flush()
    writer.close()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording of two robots; tests only read it."""
    folder = tmp_path_factory.mktemp("made") / "run"
    folder.mkdir()
    for agent in ("a", "b"):
        written(folder / f"{agent}.mcap", mission(agent))
    return folder


@pytest.fixture(scope="module")
def made(recording, tmp_path_factory):
    """The report on that recording; tests only read it."""
    return make_report(recording, tmp_path_factory.mktemp("report") / "out")


class Page(HTMLParser):
    """Reads a page: its text, what its elements refer to, and whether they are closed."""

    VOID = ("meta", "br", "input", "use", "path", "circle", "image")

    def __init__(self, html):
        super().__init__()
        self.text, self.links, self.ids, self.open = "", [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in ("href", "src", "xlink:href", "action"):
                self.links.append(value)
            if name == "id":
                self.ids.append(value)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_report_has_a_page_figures_and_pictures(made):
    names = {file.name for file, _ in made.files}
    assert names == {"report.html", "report.json"} | {f"{it}{end}" for it in PICTURES for end in (".png", ".svg")}
    out = made.page.parent
    for name in PICTURES:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        root = ElementTree.parse(out / f"{name}.svg").getroot()
        assert float(root.attrib["width"].removesuffix("pt")) <= 72 * 7.2
    assert made.notes == ()
    figures = json.loads((out / "report.json").read_text())
    assert figures["moves"][0]["answers"][1]["reason"] == "<lacks> motors"
    assert figures["reactions"][0]["count"] == 30


def test_report_page_is_self_contained(made):
    page = Page(made.page.read_text())
    assert page.open == []
    assert all(link.startswith("#") for link in page.links)
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    assert "a/Scan at 30.0 s: moved from a to b" in page.text
    assert "<lacks> motors" in page.text
    assert "a & b < c" in page.text
    assert "60 commands to actuators; each of them answers a packet that was recorded." in page.text
    assert "30 times: p50 3 ms, p90 3 ms, p99 3 ms" in page.text
    html = made.page.read_text()
    assert "http://" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", html)
    assert "prefers-color-scheme: dark" in html
    assert "@media print" in html
    assert "currentColor" in html


def test_report_verb_writes_the_same_bytes_beside_the_recording(recording, made):
    result = CliRunner().invoke(pancakes, ["report", str(recording), "--format", "json"])
    assert result.exit_code == 0, result.output
    beside = recording.parent / "run-report"
    assert json.loads(result.stdout)[0] == {"file": str(beside / "report.html"), "shows": "the report"}
    for file, _ in made.files:
        assert file.read_bytes() == (beside / file.name).read_bytes(), file.name
    assert CliRunner().invoke(pancakes, ["report", str(recording / "nothing.mcap")]).exit_code == 1


def test_report_of_a_cut_recording(recording, tmp_path):
    """The verb makes it of one file, and of one task."""
    cut = tmp_path / "a.mcap"
    whole = (recording / "a.mcap").read_bytes()
    cut.write_bytes(whole[: int(len(whole) * 0.6)])
    result = CliRunner().invoke(pancakes, ["report", str(cut), "--task", "a/Scan"])
    assert result.exit_code == 0, result.output
    assert "a.mcap is cut off" in result.output and "this report lacks the rest" in result.output.replace("\n", " ")
    text = Page((tmp_path / "a-report" / "report.html").read_text()).text
    assert "a.mcap is cut off" in text and "a/Scan" in text


def test_report_says_when_a_cut_recording_goes_on(recording, tmp_path):
    entries = list(mission("a"))
    first, part = written(tmp_path / "a.mcap", entries[:100]), tmp_path / "a.002.mcap"
    first.write_bytes(first.read_bytes()[:-400])
    written(part, [entry for entry in entries if entry.time_ns >= 41 * S])
    made = make_report(tmp_path, tmp_path / "out")
    (note,) = made.notes
    assert re.fullmatch(r".*/a\.mcap is cut off at [12]\d\.\d s; a\.002\.mcap goes on at 41\.0 s", note)
    part.unlink()
    assert make_report(tmp_path, tmp_path / "out").notes[0].endswith("this report lacks the rest")


def test_report_crosses_out_an_agent_that_was_lost(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    written(folder / "a.mcap", [entry for entry in mission("a") if entry.time_ns < 20 * S])
    said = Packet("log", "event", "b/kernel", "", 20, 1, Event("peer_down", {"peer": "a", "reason": "it is silent"}))
    written(folder / "b.mcap", [RecordedPacket(20 * S, "b", said), *(it for it in mission("b") if it.time_ns > 21 * S)])
    made = make_report(folder, tmp_path / "out")
    assert "a was lost" in (tmp_path / "out" / "tasks.svg").read_text()
    assert "Crosses: failures, and agents that were lost." in made.page.read_text()


def test_report_of_a_fleet_without_motion(tmp_path):
    say = [
        RecordedPacket(n * S, "solo", Packet("log", "line", "solo/x", "", n, n, LogLine("info", "hm")))
        for n in range(3)
    ]
    made = make_report(written(tmp_path / "solo.mcap", say), tmp_path / "out")
    assert {file.name for file, _ in made.files} == {"report.html", "report.json"}
    text = Page(made.page.read_text()).text
    assert "The recording has no positions." in text
    assert "The recording has no figures of tasks" in text
    assert "No actuator was commanded." in text


def test_report_draws_the_true_paths_of_a_world(tmp_path):
    robot, node = BodyState("a", "robot", 0.0, 0.0, 0.0, 0.1, 0.0), BodyState("n", "sensor", 1.0, 1.0, 0.0, 0.0, 0.0)
    states = []
    for n in range(3):
        packet = Packet("system", "world_state", "world/client/World", "", n, n, WorldState(n, (robot, node)))
        states.append(RecordedPacket(n * S, "world", packet))
    made = make_report(written(tmp_path / "world.mcap", states, "mission time"), tmp_path / "out")
    assert "from the simulated world" in {file.name: shows for file, shows in made.files}["paths.svg"]
    assert "in virtual time" in Page(made.page.read_text()).text


def test_report_refuses_a_task_that_is_not_recorded(recording, tmp_path):
    with pytest.raises(PancakesError, match="has no task 'a/Nobody'"):
        make_report(recording, tmp_path / "out", "a/Nobody")
    assert not (tmp_path / "out").exists()


def test_report_names_the_extra_if_matplotlib_is_missing(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(PancakesError, match=r"drawn without matplotlib: pip install 'pancakes-agents\[demo\]'"):
        make_report(recording, tmp_path / "out")


def test_report_refuses_bad_folder_and_empty_recording(recording, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PancakesError, match="the report cannot be written to .*: Not a directory"):
        make_report(recording, tmp_path / "file" / "out")
    with pytest.raises(PancakesError, match="has no packets"):
        make_report(written(tmp_path / "empty.mcap", []), tmp_path / "out")
