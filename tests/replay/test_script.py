"""The packets that a task got and when it handled them, as far as a recording contains it."""

import pytest
from msgspec.structs import replace

from pancakes.devices import Load, Pose
from pancakes.events import Event
from pancakes.packet import Packet, type_name
from pancakes.recording.records import RecordedPacket, TaskDescription
from pancakes.task import Task, on
from pancakes.tools.replay.recorded_run import Change, Given, choose_stays, find_stays, read_script

ME = "a/client/Me"
EPOCH_NS = 1_700_000_000_000_000_000


class Me(Task):
    @on("system", Pose, queue="latest")
    def pose(self, packet): ...

    @on("system", Load, queue=2)
    def load(self, packet): ...


def described(time_s, began=True):
    began_with = {"time_ns": EPOCH_NS, "mission_s": 5.0, "settings": {}, "state": {}, "periods_s": {}, "rate_hz": None}
    description = TaskDescription(
        "a/Me", ME, "x.Me", 0, 5.0 + time_s, time_ns=at(time_s), began=began_with if began else None
    )  # fmt: skip
    return seen(time_s, description, "a/log/Recorder", channel="recording")


def at(time_s):
    return EPOCH_NS + int(time_s * 1e9)


def seen(time_s, body, source, channel="system", cause=None, stamp=None, to="", seq=1, speed=1.0):
    stamp = 5.0 + time_s * speed if stamp is None else stamp
    return RecordedPacket(at(time_s), "a", Packet(channel, type_name(body), source, to, stamp, seq, body, cause))


def script(entries, speed=1.0, began=True, virtual=False):
    entries = sorted([described(0.01, began), *entries], key=lambda entry: entry.time_ns)
    (stay,) = choose_stays(find_stays(entries), "Me")
    return read_script(entries, stay, Me, speed, virtual)


def given(made):
    return [(pytest.approx(step.time_s, abs=1e-6), step.packet.seq) for step in made.steps if isinstance(step, Given)]


def pose(time_s, seq, **others):
    return seen(time_s, Pose(0, 0, 0), others.pop("source", "a/device/pose"), seq=seq, **others)


def answer(time_s, to_seq, seq=1, source="a/device/pose"):
    return seen(time_s, Load(1.0), ME, channel="ctrl", cause=(source, to_seq), seq=seq)


def test_packet_is_handled_when_its_effect_was_published():
    made = script([pose(1.0, 1), answer(1.25, 1), pose(2.0, 2)])
    assert given(made) == [(6.25, 1), (7.0, 2)]
    assert [packet.cause for packet in made.outputs] == [("a/device/pose", 1)]
    assert made.end_s == pytest.approx(7.0, abs=1e-6)


def test_newer_packet_replaces_one_that_waited():
    # The task was busy with 1 until 1.5 s; 2 waited and was replaced by 3.
    made = script([pose(1.0, 1), pose(1.1, 2), pose(1.2, 3), answer(1.5, 1), answer(1.6, 3, 2)])
    assert given(made) == [(6.5, 1), (6.6, 3)]
    assert made.superseded == 1


def test_longer_queue_drops_only_the_excess():
    loads = [seen(1.0 + n / 10, Load(0.0), "a/device/load", seq=n) for n in range(1, 5)]
    made = script([pose(1.0, 9), *loads, answer(2.0, 9)])
    assert [seq for _, seq in given(made)] == [9, 3, 4]


def test_second_of_two_simultaneous_packets_may_replace_the_first():
    twice = [pose(1.0, 1), pose(1.0001, 2), answer(1.001, 2)]
    assert [seq for _, seq in given(script(twice))] == [2]
    assert [seq for _, seq in given(script([*twice, answer(1.0005, 1, 9)]))] == [1, 2]
    three = [pose(1.0, 1), pose(1.003, 2), pose(1.006, 3), answer(1.007, 3)]
    assert [seq for _, seq in given(script(three))] == [3]
    assert [seq for _, seq in given(script(three, virtual=True))] == [1, 2, 3]
    unanswered = [pose(1.0, 1), pose(1.003, 2), pose(1.006, 3)]
    assert [seq for _, seq in given(script(unanswered))] == [1, 2, 3]
    apart = [pose(1.0, 1), pose(1.1, 2), answer(1.101, 2)]
    assert [seq for _, seq in given(script(apart))] == [1, 2]
    two_sources = [pose(1.0, 1, source="a/device/other"), pose(1.0001, 2), answer(1.001, 2)]
    assert [seq for _, seq in given(script(two_sources))] == [1, 2]


def test_time_of_a_foreign_packet_uses_the_mission_speed():
    own = pose(1.0, 1, speed=4.0)
    foreign = pose(2.0, 2, source="b/client/Talk", stamp=777.0)
    assert given(script([own, foreign], speed=4.0)) == [(9.0, 1), (13.0, 2)]


def test_only_packets_of_the_task_are_in_the_script():
    entries = [
        pose(1.0, 1, to="a/device/pose"),
        pose(1.1, 2, to="a/client"),
        pose(1.2, 3, to="*"),  # on its way to others
        pose(1.3, 4, to="*", source="b/client/Talk"),
        pose(1.4, 5, channel="ctrl"),
        seen(1.5, Event("rate_changed", {"task": "Me"}), "a/client", channel="log"),
        seen(1.6, Event("rate_changed", {"task": "You"}), "a/client", channel="log"),
        seen(1.7, Event("rate_changed", {"task": "Me"}), "a/other", channel="log"),
        pose(2.0, 6),
        seen(2.1, Event("task_stopped", {"task": "Me", "reason": "enough"}), "a/client", channel="log"),
        pose(2.2, 7),
    ]
    made = script(entries)
    assert [seq for _, seq in given(made)] == [2, 4, 6]
    assert [step.time_s for step in made.steps if isinstance(step, Change)] == [pytest.approx(6.5)]
    assert made.end_s == pytest.approx(7.1)


def test_packet_at_the_end_came_too_late():
    ended = seen(2.0, Event("task_stopped", {"task": "Me"}), "a/client", channel="log")
    entries = [pose(1.0, 1), pose(1.98, 2), ended]
    assert [seq for _, seq in given(script(entries))] == [1]
    assert [seq for _, seq in given(script(entries[:2]))] == [1, 2]
    assert [seq for _, seq in given(script([*entries, answer(1.99, 2)]))] == [1, 2]
    assert [seq for _, seq in given(script(entries, virtual=True))] == [1, 2]


def test_effect_of_an_earlier_packet_is_not_missed():
    made = script([pose(0.005, 1), answer(0.02, 1), pose(1.0, 2), answer(1.1, 2, 2)], began=False)
    assert given(made) == [(6.1, 2)]
    assert [packet.seq for packet in made.outputs] == [2]


def test_held_mission_counts_from_its_beginning():
    early = [pose(1.0, 1, stamp=0.0), pose(2.0, 2, source="b/client/Talk")]
    late = [pose(4.0, 3, stamp=1.0), pose(5.0, 4, source="b/client/Talk", stamp=99.0)]
    entries = [described(0.01), *early, *late]
    (stay,) = choose_stays(find_stays(entries), "Me")
    assert stay.task.began is not None
    stay.task = replace(stay.task, began={**stay.task.began, "mission_s": 0.0})
    assert given(read_script(entries, stay, Me, 1.0)) == [(0.0, 1), (0.0, 2), (1.0, 3), (2.0, 4)]


def test_entries_before_a_simultaneous_start_do_not_count():
    started = seen(0.0, Event("task_started", {"task": "Me"}), "a/client", channel="log")
    other = seen(0.0, Event("task_started", {"task": "You"}), "a/client", channel="log")
    assert [seq for _, seq in given(script([pose(0.0, 1), other, pose(0.0, 2), started, pose(0.0, 3)]))] == [3]
    said = seen(0.0, Load(1.0), ME)
    assert [seq for _, seq in given(script([pose(0.0, 1), said, pose(0.0, 2)]))] == [2]
