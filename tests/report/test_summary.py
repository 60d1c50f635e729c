"""The summary at the beginning of a report, and the verdict that a demo left beside its recording."""

import json
import re

import msgspec
import pytest

from pancakes.events import Event, LogLine
from pancakes.migration import MigrationReport
from pancakes.packet import Packet
from pancakes.recording.task_statistics import OneLink
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.losses import AgentLoss
from pancakes.tools.report.mission import TaskMove
from pancakes.tools.report.page import make_page
from pancakes.tools.report.performance import Drops, TimerRates
from pancakes.tools.report.plots import Picture
from pancakes.tools.report.summary import Summary, Verdict, verdict_beside


def ledger(outcome):
    return msgspec.convert(
        {
            "task": "Scan", "task_id": "a/Scan", "source": "a", "asked_by": "rule", "cost": "tasks", "outcome": outcome,
            "winner": "b", "lines": [], "duration_s": 0.5, "offer": "1@a",
        },
        MigrationReport,
    )  # fmt: skip


@pytest.fixture
def findings():
    """Two migrations, of which one failed; a late timer; lost packets; a warning three times, and two failures."""
    found = Findings()
    found.rates.samples = 1
    found.timeline.seen_s = {"a": 9.0, "b": 9.0}
    found.moves.moves += [TaskMove(5.0, ledger("moved"), 4.9, 5.0), TaskMove(7.0, ledger("stayed"))]
    late = found.rates.timers["a", "client/Scan", "tick"] = TimerRates("a", "client/Scan", "", "tick")
    late.lateness_max_s, late.missed = 0.0123, 4
    found.rates.timers["b", "client/Load", "tick"] = TimerRates("b", "client/Load", "", "tick", lateness_max_s=0.002)
    found.rates.drops["a", "client/Scan"] = Drops("a", "client/Scan", 5)
    found.rates.links["a", "b"] = OneLink("b", 0.001, 1, 1, 1, 1, 7)
    found.rates.dead_letters["a"] = 2
    log = [LogLine("warning", "no fix")] * 3 + [LogLine("error", "no disk"), Event("task_failed", {"task": "Scan"})]
    for number, body in enumerate(log):
        kind = "event" if isinstance(body, Event) else "line"
        found.events.add("a", Packet("log", kind, "a/client", "", 1.0, number, body), float(number))
    return found


def tiles(html):
    """Return name, value and text of each figure of the summary."""
    return re.findall(r"<span>([^<]*)</span> <b>([^<]*)</b> <small>([^<]*)</small>", html)


def test_summary_counts_what_matters(findings):
    it = Summary.of(findings, Verdict("FAIL", ("too slow",)))
    assert (it.agents, it.moved, it.stayed, it.missed) == (2, 1, 1, 4)
    assert it.longest_pause_s == pytest.approx(0.1)
    assert it.worst is not None and it.verdict is not None
    assert (it.worst.agent, it.worst.task, it.worst.lateness_s) == ("a", "client/Scan", 0.0123)
    assert (it.errors, it.warnings, it.lost) == (2, 3, 14)
    assert not it.verdict.passed and Verdict("PASS").passed


def test_page_begins_with_the_summary(findings):
    html = make_page("Report", {}, [], findings, {}, Verdict("FAIL", ("a <collision>",)))
    assert html.index('id="summary"') < html.index("<h2>")
    assert tiles(html) == [
        ("verdict", "FAIL", "a &lt;collision&gt;"),
        ("duration", "0 s", "of 2 agents"),
        ("migrations", "1", "1 came to nothing; paused for 100 ms at most"),
        ("worst lateness", "12.3 ms", "a client/Scan; 4 ticks missed"),
        ("errors", "2", "3 warnings"),
        ("packets lost", "14", "dropped, or their handlers failed"),
    ]
    assert html.count('<li class="bad">') == 5


def test_lost_agents_and_take_overs_are_told(findings):
    findings.losses.losses = [AgentLoss("a", 5.0, "a was lost"), AgentLoss("b", 6.0, "b was lost")]
    report = MigrationReport("a/Scan", "a", "guardians", "tasks", "moved", "b", (), 0.1)
    findings.moves.moves.append(TaskMove(6.0, report))
    findings.rates.timers["a", "client/Scan", "tell"] = TimerRates("a", "client/Scan", "", "tell")
    html = make_page("Report", {}, [], findings, {})
    told = {name: (value, text) for name, value, text in tiles(html)}
    assert told["errors"][1] == "a and b were lost; 3 warnings"
    assert told["migrations"] == ("2", "1 came to nothing; 1 task taken over; paused for 100 ms at most")
    assert told["worst lateness"][1] == "a client/Scan.tick; 4 ticks missed"
    assert "a/Scan at 6.0 s: taken over from a to b" in html and "<td>taken over</td>" in html


def test_summary_of_a_quiet_recording_is_good():
    found = Findings()
    html = make_page("Report", {}, [], found, {})
    assert [value for _, value, _ in tiles(html)] == ["0 s", "0", "unknown", "0", "unknown"]
    found.rates.samples = 1
    assert tiles(make_page("Report", {}, [], found, {}))[2:] == [
        ("worst lateness", "none", "no tick was late"),
        ("errors", "0", "no warnings"),
        ("packets lost", "0", "none was dropped"),
    ]


def test_worst_entries_of_the_log_come_first(findings):
    html = make_page("Report", {}, [], findings, {})
    rows = re.findall(r"<td>a</td><td>(\w+)</td>", html[html.index('id="log"') :])
    assert rows == ["error", "task_failed", "warning"]


def test_pictures_have_the_colours_of_the_page(findings):
    svg = '<svg style="fill: #0072b2; stroke: #ffffff"><path style="stroke: #9a9a9a"/></svg>'
    html = make_page("Report", {}, [], findings, {"paths": Picture("paths", "Paths.", svg)})
    assert "fill: var(--c0); stroke: var(--paper)" in html and "stroke: var(--grey)" in html


def test_verdict_is_read_beside_the_recording(tmp_path):
    folder = tmp_path / "recording"
    folder.mkdir()
    file = folder / "a.mcap"
    file.touch()
    assert verdict_beside(folder) is None
    summary = tmp_path / "summary.json"
    summary.write_text(json.dumps({"verdict": "FAIL", "reasons": ["slow", "late"]}))
    assert verdict_beside(folder) == verdict_beside(file) == Verdict("FAIL", ("slow", "late"))
    for odd in ("", "[1]", "{", '{"verdict": 7}', '{"verdict": ""}', "[" * 100_000):
        summary.write_text(odd)
        assert verdict_beside(folder) is None, odd
    summary.write_bytes(b'{"verdict": "\xff"}')
    assert verdict_beside(folder) is None
    summary.write_text('{"verdict": "PASS", "reasons": 3}')
    assert verdict_beside(folder) == Verdict("PASS")
    other = tmp_path / "other"
    other.mkdir()
    assert verdict_beside(other) is None, "only a demo's own recording"
