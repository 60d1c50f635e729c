"""A recording's time as the mission's."""

import pytest

from pancakes.devices import Load
from pancakes.packet import Packet
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import RecordedPacket

S = 1_000_000_000


def life(agent, from_s, held_s=0.0, speed=1.0, late_s=0.0, source=""):
    """An agent from a time on: its mission is held for a while; it says something ten times a second."""
    entries = []
    for number in range(50):
        passed_s = number / 10
        stamp = max(0.0, passed_s - held_s) * speed
        packet = Packet("system", "load", source or f"{agent}/device/load", "", stamp, number + 1, Load(0.5))
        entries.append(RecordedPacket(round((from_s + passed_s + (late_s if number % 3 else 0.0)) * S), agent, packet))
    return {"speed": str(speed)}, entries


def test_the_mission_begins_where_its_clock_does_and_is_0_before():
    time = MissionTime.of([life("a", 100.0, held_s=2.0), life("b", 100.5, held_s=1.5)])
    assert (time.zero_ns, time.known, time.name) == (102 * S, True, "mission time")
    assert [time.at(round(at * S)) for at in (100.0, 102.0, 104.5)] == [0.0, 0.0, 2.5]


def test_it_may_be_faster_than_the_recordings():
    time = MissionTime.of([life("a", 100.0, held_s=2.0, speed=5.0)])
    assert (time.zero_ns, time.at(103 * S)) == (102 * S, 5.0)


def test_what_is_seen_late_does_not_count():
    assert MissionTime.of([life("a", 100.0, late_s=0.02)]).zero_ns == 100 * S


def test_a_recording_may_begin_in_the_course_of_a_mission():
    about, entries = life("a", 100.0)
    time = MissionTime.of([(about, entries[30:])])
    assert (time.zero_ns, time.at(entries[30].time_ns)) == (100 * S, pytest.approx(3.0))


def test_an_agent_that_was_started_again_counts_from_its_first_life():
    first, again, other = life("a", 100.0), life("a", 130.0), life("b", 100.1)
    assert MissionTime.of([again, first, other]).zero_ns == 100 * S
    assert MissionTime.of([again, first]).zero_ns == 100 * S


def test_what_others_say_does_not_tell_when_the_mission_of_an_agent_began():
    time = MissionTime.of([life("a", 100.0, source="b/device/load")])
    assert (time.zero_ns, time.known, time.name) == (100 * S, False, "time since the recording began")


def test_where_missions_did_not_begin_together_or_not_at_all_time_counts_from_the_first_packet():
    for files in ([life("a", 100.0), life("b", 107.0)], [life("a", 100.0, held_s=99.0)]):
        time = MissionTime.of(files)
        assert (time.known, time.at(103 * S)) == (False, 3.0)
    most = MissionTime.of([life("a", 100.0), life("b", 100.2), life("c", 107.0)])
    assert (most.known, most.zero_ns) == (True, 100 * S)
    assert MissionTime.of([]).at(5 * S) == 5.0
