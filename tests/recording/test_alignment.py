"""Recordings of agents whose clocks differ, merged in order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from clocks.pulses import PulseTeller, PulseTold

from pancakes.mesh.memory_network import Quality
from pancakes.recording.clock_alignment import Alignment, ClockLife, ClockNote, row_of
from pancakes.recording.reader import RecordingReader, repair
from pancakes.recording.records import NANOSECONDS
from pancakes.recording.settings import RecordingSettings
from pancakes.recording.virtual_recorder import VirtualRecorder
from pancakes.testing import Fleet
from pancakes.util.plugins import Plugins

S = NANOSECONDS
RATES = {"a": (1.0005, 5000.0), "b": (1.0, 0.0), "c": (0.999, 10.0)}
LATENCY_S = 0.002


def life(agent, epoch_s=0.0, **notes):
    made = ClockLife(f"life of {agent}", agent, round(epoch_s * S))
    for peer, rows in notes.items():
        made.notes[f"life of {peer}"] = [ClockNote(round(at * S), round(off * S), 1_000_000, 0.0) for at, off in rows]
    return made


@pytest.fixture
def folder(tmp_path) -> Path:
    """A recording of three agents, 25 s long, each on a clock of its own."""
    with Fleet(3, Quality(LATENCY_S, 0.001)) as fleet:
        for name, (rate, ahead_s) in RATES.items():
            fleet.start(name, tasks={"Teller": PulseTeller}, clock_rate=rate, clock_ahead_s=ahead_s)
        fleet.connect()
        recorders = [
            VirtualRecorder(agent.kernel, RecordingSettings(path=str(tmp_path / f"{name}.mcap")), pytest.fail)
            for name, agent in fleet.agents.items()
        ]
        fleet.run_for(25.0)
        for recorder in recorders:
            recorder.end()
    return tmp_path


def test_what_was_recorded_on_several_clocks_comes_in_order(folder):
    Plugins().load_packets()
    reader = RecordingReader(folder)
    rate, ahead_s = RATES["a"]
    pulses = [entry for entry in reader.entries() if isinstance(entry.packet.body, PulseTold)]
    assert [entry.time_ns for entry in pulses] == sorted(entry.time_ns for entry in pulses)
    seen: dict[tuple[str, int], int] = {}
    for entry in pulses:
        source, true_s = entry.packet.source, entry.packet.body.true_s
        if source.startswith(f"{entry.agent}/"):
            error_s = abs(entry.time_ns / S - (ahead_s + rate * true_s))
            assert error_s < LATENCY_S + 0.0005 + 0.0002, "half a round trip, and a fifth of a millisecond"
            seen[source, entry.packet.seq] = entry.time_ns
        else:
            assert (source, entry.packet.seq) in seen, "it comes before it was sent"
    assert len(seen) > 700
    moved = [note for note in reader.notes() if "were moved by" in note]
    assert len(moved) == 2 and all("onto the clock of a (to within" in note for note in moved)


def test_a_recording_that_was_cut_off_and_repaired_keeps_its_clocks(folder):
    for path in folder.glob("*.mcap"):
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) * 3 // 4])
    times = [entry.time_ns for entry in RecordingReader(folder).entries()]
    assert times == sorted(times) and min(times) > 5000 * S
    for path in folder.glob("*.mcap"):
        assert not repair(path).whole
    assert [entry.time_ns for entry in RecordingReader(folder).entries()] == times


def test_agents_on_one_virtual_clock_write_nothing_of_clocks(tmp_path):
    with Fleet() as fleet:
        for name in "ab":
            fleet.start(name)
        fleet.connect()
        kernel = fleet.agents["a"].kernel
        recorder = VirtualRecorder(kernel, RecordingSettings(path=str(tmp_path / "a.mcap")), pytest.fail)
        fleet.run_for(15.0)
        recorder.end()
    assert b"pancakes.clocks" not in (tmp_path / "a.mcap").read_bytes()


# How times are moved


def test_times_are_moved_by_what_either_side_knew():
    for lives in (
        [life("a", 100.0, b=[(10.0, 50.0)]), life("b", 100.0)],
        [life("a", 100.0), life("b", 100.0, a=[(60.0, -50.0)])],
    ):
        found = Alignment(lives)
        shift = found.shifts[lives[1].key]
        assert shift(160 * S) == 110 * S  # 60 s on b's clock are 10 s on that of a
        assert lives[0].key not in found.shifts
        assert "the times of b were moved by -50.000000 s onto the clock of a" in found.remarks[0]


def test_a_clock_that_drifts_is_followed_between_two_notes_and_held_outside_of_them():
    one, other = life("a", 0.0, b=[(10.0, 50.0), (20.0, 51.0)]), life("b")
    shift = Alignment([one, other]).shifts[other.key]
    assert [shift(round(at * S)) / S for at in (60.0, 65.5, 71.0)] == [pytest.approx(at) for at in (10.0, 15.0, 20.0)]
    assert shift(81 * S) / S == pytest.approx(30.0)


def test_times_of_day_that_agree_stay_as_they_are():
    found = Alignment([life("a", 1000.0, b=[(10.0, 50.0005)]), life("b", 950.0)])
    assert (found.shifts, found.remarks) == ({}, [])


def test_an_agent_is_reached_by_way_of_another():
    lives = [life("a", 0.0, b=[(10.0, 50.0)]), life("b"), life("c", 0.0, b=[(10.0, -7.0)])]
    found = Alignment(lives)
    assert found.shifts[lives[2].key](67 * S) == 10 * S


def test_agents_that_never_met_stay_as_they_are():
    lives = [life("a", 0.0, x=[(1.0, 2.0)]), life("b")]
    assert Alignment(lives).shifts == {}


def test_a_later_life_on_another_clock_is_moved_by_itself():
    first, later = life("b"), ClockLife("another life of b", "b", 0)
    one = life("a", 0.0, b=[(10.0, 50.0)])
    one.notes[later.life] = [ClockNote(100 * S, -90 * S, 1000, 0.0)]
    found = Alignment([one, first, later])
    assert (found.shifts[first.key](60 * S), found.shifts[later.key](10 * S)) == (10 * S, 100 * S)


@pytest.mark.parametrize("row", [{}, {"host_ns": "x"}, {"host_ns": "1", "b": "nonsense"}, {"host_ns": "1", "b": "1 2"}])
def test_what_is_no_note_is_left_out(row):
    made = life("a")
    made.take(row)
    assert made.notes == {}


def test_what_is_written_is_what_is_read():
    clock = {"offset_s": 1.5, "bound_s": 0.00025, "drift": 1e-6}
    links: list[dict[str, Any]] = [
        {"life": "life of b", "role": "agent", "clock": clock},
        {"life": "t", "role": "client", "clock": clock},
        {"life": "new", "role": "agent", "clock": None},
    ]
    made = life("a")
    made.take(row_of(3.0, links))
    assert made.notes == {"life of b": [ClockNote(3 * S, 1_500_000_000, 250_000, 1e-6)]}
    assert row_of(3.0, links[1:]) == {}
    assert ClockLife.of({"life": "l", "agent": "a", "epoch_ns": "x"}) is None
