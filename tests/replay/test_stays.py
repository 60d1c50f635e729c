"""Finding the stays of tasks in a recording, and choosing a task by name."""

import pytest

from pancakes.events import Event
from pancakes.packet import Packet, type_name
from pancakes.recording.records import RecordedPacket, RecordingError, TaskDescription
from pancakes.tools.replay.recorded_run import choose_stays, find_stays


def seen(time_ns, agent, body, source, channel="log"):
    return RecordedPacket(time_ns, agent, Packet(channel, type_name(body), source, "", 0.0, 1, body))


def described(time_ns, address, task_id=None, began_ns=None):
    agent, _, name = address.split("/")
    began = {"time_ns": began_ns, "mission_s": 1.0} if began_ns is not None else None
    task_id = f"{agent}/{name}" if task_id is None else task_id
    description = TaskDescription(task_id, address, "x.X", 0, 2.0, time_ns=time_ns, began=began)
    return seen(time_ns + 5, agent, description, f"{agent}/log/Recorder", "recording")


def event(time_ns, kind, address, **fields):
    agent, service, name = address.split("/")
    return seen(time_ns, agent, Event(kind, {"task": name, **fields}), f"{agent}/{service}")


def stays(*entries):
    return [(it.task.address, it.from_ns, it.to_ns, it.end, it.whole) for it in find_stays(entries)]


def test_stay_ends_with_task_restart_or_recording():
    assert stays(
        described(100, "a/client/X", began_ns=90),
        described(110, "a/client/Y"),
        event(200, "task_stopped", "a/client/X", reason="enough"),
        described(300, "a/client/X", began_ns=290),
        event(400, "task_failed", "a/client/X", error="oh"),
        event(401, "task_given_up", "a/client/X", error="oh"),
        described(500, "a/client/Y", began_ns=480),
        event(600, "task_stopped", "a/other/Y"),
    ) == [
        ("a/client/X", 90, 200, "stopped", True),
        ("a/client/Y", 110, 480, "", False),
        ("a/client/X", 290, 400, "failed", True),
        ("a/client/Y", 480, 600, "", True),
    ]


def test_stay_ignores_other_agents():
    found = stays(
        described(100, "a/client/X"),
        event(150, "task_stopped", "b/client/X"),
        event(160, "task_started", "a/client/Z"),
    )
    assert found == [("a/client/X", 100, 160, "", False)]


def test_stay_ends_between_two_recordings():
    started = Event("recording_started", {"path": "r-2.mcap"})
    found = stays(
        described(100, "a/client/X"),
        event(150, "hello", "a/client/X"),
        seen(900, "a", started, "a/log/Recorder"),
        described(910, "a/client/X"),
    )
    assert found == [("a/client/X", 100, 150, "", False), ("a/client/X", 910, 915, "", False)]


def test_task_is_chosen_by_identity_address_or_name():
    found = find_stays(
        [
            described(1, "a/client/X"),
            described(2, "b/client/X", "a/X"),  # it has moved
            described(3, "c/client/Y"),
            described(4, "d/client/Y"),
            described(5, "e/own/Z", ""),  # no identity for life
        ]
    )

    def names(*arguments):
        return [stay.task.address for stay in choose_stays(found, *arguments)]

    assert names("X") == names("a/X") == names("b/client/X") == ["a/client/X", "b/client/X"]
    assert names("X", "b") == names("X", "", 2) == ["b/client/X"]
    assert names("c/Y") == ["c/client/Y"]
    assert names("Z") == names("e/own/Z") == ["e/own/Z"]
    with pytest.raises(RecordingError, match="several tasks 'Y': choose c/Y or d/Y"):
        names("Y")
    with pytest.raises(RecordingError, match="a/X has only 2 stays in the recording$"):
        names("X", "", 3)
    with pytest.raises(RecordingError, match="the recording has no task 'XX', did you mean 'X'"):
        names("XX")
    with pytest.raises(RecordingError, match="a/X was never on 'c' in the recording, only on a, b$"):
        names("X", "c")
    with pytest.raises(RecordingError, match="the recording has no descriptions of tasks"):
        choose_stays([], "X")
