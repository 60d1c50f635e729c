"""A report from end to end: a recording goes in, a page and pictures that others can open come out."""

import json
import math
import re
import sys
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner

from pancakes.bodies.devices.types import Battery, Pose, Twist
from pancakes.bodies.sim.state import BodyState, WorldState
from pancakes.errors import PancakesError
from pancakes.events import Event, LogLine
from pancakes.packet import Fence, Packet
from pancakes.tools.cli.main import pancakes
from pancakes.tools.recording.figures import OneLink, OneTask, TaskFigures, TimerFigures
from pancakes.tools.recording.recorded_packet import RecordedPacket
from pancakes.tools.recording.writer import RecordingWriter
from pancakes.tools.report.making import make_report

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
    """What a recorder of one of two robots sees: Scan drives `a` for 30 s, then `b`."""
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


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for agent in ("a", "b"):
        written(folder / f"{agent}.mcap", mission(agent))
    return folder


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


def test_a_report_has_a_page_figures_and_each_picture_as_png_and_svg(recording, tmp_path):
    made = make_report(recording, tmp_path / "out")
    names = {file.name for file, _ in made.files}
    assert names == {"report.html", "report.json"} | {f"{it}{end}" for it in PICTURES for end in (".png", ".svg")}
    for name in PICTURES:
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        root = ElementTree.parse(tmp_path / "out" / f"{name}.svg").getroot()
        assert float(root.attrib["width"].removesuffix("pt")) <= 72 * 7.2
    assert made.notes == ()
    figures = json.loads((tmp_path / "out" / "report.json").read_text())
    assert figures["moves"][0]["answers"][1]["reason"] == "<lacks> motors"
    assert figures["reactions"][0]["count"] == 30


def test_the_page_needs_nothing_but_itself_and_says_what_was_found(recording, tmp_path):
    page = Page(make_report(recording, tmp_path / "out").page.read_text())
    assert page.open == []
    assert all(link.startswith("#") for link in page.links)
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    assert "a/Scan at 30.0 s: moved from a to b" in page.text
    assert "<lacks> motors" in page.text
    assert "a & b < c" in page.text
    assert "60 commands to actuators; each of them answers a packet that was recorded." in page.text
    assert "30 times: p50 3 ms, p90 3 ms, p99 3 ms" in page.text
    html = (tmp_path / "out" / "report.html").read_text()
    assert "http://" not in re.sub(r'xmlns(:xlink)?="[^"]+"', "", html)
    assert "prefers-color-scheme: dark" in html
    assert "@media print" in html
    assert "currentColor" in html


def test_the_same_recording_gives_the_same_bytes(recording, tmp_path):
    for out in ("one", "two"):
        make_report(recording, tmp_path / out)
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes(), file.name


def test_a_recording_that_was_cut_off_is_reported_as_far_as_it_goes(recording, tmp_path):
    cut = recording / "a.mcap"
    cut.write_bytes(cut.read_bytes()[: int(cut.stat().st_size * 0.6)])
    made = make_report(cut, tmp_path / "out")
    (note,) = made.notes
    assert "a.mcap is cut off" in note
    assert "is not in this report" in note
    assert "a.mcap is cut off" in Page(made.page.read_text()).text


def test_a_fleet_without_a_world_or_anything_that_moves_has_a_report_too(tmp_path):
    say = [
        RecordedPacket(n * S, "solo", Packet("log", "line", "solo/x", "", n, n, LogLine("info", "hm")))
        for n in range(3)
    ]
    made = make_report(written(tmp_path / "solo.mcap", say), tmp_path / "out")
    assert {file.name for file, _ in made.files} == {"report.html", "report.json"}
    text = Page(made.page.read_text()).text
    assert "Nothing in the recording has a place." in text
    assert "The recording has no figures of tasks" in text
    assert "No actuator was commanded." in text


def test_a_world_gives_the_true_paths(tmp_path):
    robot, node = BodyState("a", "robot", 0.0, 0.0, 0.0, 0.1, 0.0), BodyState("n", "sensor", 1.0, 1.0, 0.0, 0.0, 0.0)
    states = []
    for n in range(3):
        packet = Packet("system", "world_state", "world/client/World", "", n, n, WorldState(n, (robot, node)))
        states.append(RecordedPacket(n * S, "world", packet))
    made = make_report(written(tmp_path / "world.mcap", states, "mission time"), tmp_path / "out")
    assert "as the simulated world knew them" in {file.name: shows for file, shows in made.files}["paths.svg"]
    assert "in virtual time" in Page(made.page.read_text()).text


def test_a_report_on_a_task_that_is_not_there_is_refused(recording, tmp_path):
    with pytest.raises(PancakesError, match="no task 'a/Nobody' is in"):
        make_report(recording, tmp_path / "out", "a/Nobody")
    assert not (tmp_path / "out").exists()
    made = make_report(recording, tmp_path / "out", "a/Scan")
    assert "a/Scan" in Page(made.page.read_text()).text


def test_without_matplotlib_it_says_what_to_install(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(PancakesError, match=r"drawn without matplotlib: pip install 'pancakes-agents\[demo\]'"):
        make_report(recording, tmp_path / "out")


def test_a_place_that_cannot_be_written_and_an_empty_recording_are_sentences(recording, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PancakesError, match="the report cannot be written to .*: Not a directory"):
        make_report(recording, tmp_path / "file" / "out")
    with pytest.raises(PancakesError, match="has no packets"):
        make_report(written(tmp_path / "empty.mcap", []), tmp_path / "out")


def test_the_verb_lists_the_files_and_puts_them_beside_the_recording(recording):
    result = CliRunner().invoke(pancakes, ["report", str(recording), "--format", "json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert rows[0] == {"file": str(recording.parent / "run-report" / "report.html"), "shows": "the report"}
    result = CliRunner().invoke(pancakes, ["report", str(recording / "a.mcap")])
    assert (recording / "a-report" / "report.html").exists()
    result = CliRunner().invoke(pancakes, ["report", str(recording / "nothing.mcap")])
    assert result.exit_code == 1
    assert "there is no recording" in result.output
