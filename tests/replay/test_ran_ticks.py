"""Which ticks ran, as far as a recording contains it."""

import math

import pytest

from pancakes.events import Event
from pancakes.packet import Packet, type_name
from pancakes.recording.records import RecordedPacket, TaskDescription
from pancakes.recording.task_statistics import TaskTicks, TickRun, TimerTicks
from pancakes.task import Tick
from pancakes.tools.replay.recorded_run import STOPPED, RanTicks, Stay, TicksReader

ME = "a/client/Me"
SECOND = 1_000_000_000


def ran(*runs, complete=True):
    return RanTicks(0.1, [TickRun(*run) for run in runs], complete)


def missed(ticks, *deadlines_s, period_s=0.1):
    found = [ticks.tick_at(deadline_s, period_s) for deadline_s in deadlines_s]
    return [None if tick is None else tick.missed for tick in found]


def test_only_ticks_of_runs_ran():
    ticks = ran((0.9, 0.1, 2, 3), (0.3, 0.1, 3, 0))
    assert missed(ticks, 0.2, 3 * 0.1, 0.4, 0.5, 0.6, 0.8, 0.9, 1.0, 1.1) == [None, 0, 0, 0, None, None, 3, 0, None]
    assert missed(ticks, 1234.5) == [None]


def test_late_tick_is_as_late_again():
    ticks = ran((0.3, 0.1, 2, 1, 0.08))
    assert ticks.tick_at(0.3, 0.1) == Tick(0.3, 1, 0.08)
    assert ticks.tick_at(0.4, 0.1) == Tick(0.4)


def test_ticks_after_the_last_known_ran():
    """The recording was cut off: a tick counts as missed only if a later tick ran."""
    assert missed(ran((0.3, 0.1, 1, 0), (0.6, 0.1, 1, 2), complete=False), 0.2, 0.5, 0.7) == [None, None, 0]
    assert missed(ran(complete=False), 0.1) == [0]


def test_ticks_at_another_rate_ran():
    """The changed code has other ticks, so the recorded misses do not apply."""
    ticks = ran((0.3, 0.1, 3, 0), (0.75, 0.25, 2, 0))
    assert missed(ticks, 0.05, 0.35, 0.45, 1.25, period_s=0.05) == [0] * 4
    assert missed(ticks, 0.2, 0.6, 0.7, 1.1) == [None, None, None, 0]
    assert missed(ticks, 0.25, 1.25, period_s=0.25) == [0, None]
    assert missed(ran(), 0.1) == [None]
    assert missed(ran(), 0.1, period_s=0.2) == [0]


def test_tick_of_a_stopped_timer_ran():
    assert missed(ran((0.3, 0.0, 1, 1)), 0.3, 0.4, period_s=0.1) == [1, 0]


def stay(end=STOPPED):
    timers = ({"timer": "tick", "rate_hz": 10.0}, {"timer": "rests", "rate_hz": 0.0})
    return Stay("a", TaskDescription("a/Me", ME, "x.Me", 0, 0.0, timers=timers), 10 * SECOND, 12 * SECOND, end)


def ticks_message(time_s, number, first_s=None, address=ME, agent="a"):
    runs = () if first_s is None else (TimerTicks(address, "tick", ((first_s, 0.1, 3, 0, 0.0),)),)
    return seen(time_s, TaskTicks(number, runs), agent)


def began(time_s):
    return seen(time_s, Event("recording_started", {}))


def seen(time_s, body, agent="a"):
    packet = Packet("recording", type_name(body), f"{agent}/log/Recorder", "", 0.0, 1, body)
    return RecordedPacket(int(time_s * SECOND), agent, packet)


def read(*entries, end=STOPPED):
    reader = TicksReader(stay(end))
    for entry in entries:
        reader.take(entry)
    return reader.ticks()


def test_ticks_of_a_stay_are_read_past_its_end():
    ticks = read(
        began(1),
        ticks_message(9.5, 1, 0.1),
        ticks_message(10.5, 2, 1.0),
        ticks_message(11, 7, 5.0, agent="b"),
        ticks_message(11.5, 3, 2.0, address="a/client/You"),
        ticks_message(12.5, 4, 3.0),
        ticks_message(13.5, 6, 4.0),
    )
    assert missed(ticks["tick"], 0.1, 0.9, 1.0, 2.0, 3.0, 3.2, 3.3, 4.0) == [None, None, 0, None, 0, 0, None, None]
    assert missed(ticks["rests"], 1.0, period_s=math.inf) == [None]


@pytest.mark.parametrize(
    "entries",
    [
        [],
        [began(1), ticks_message(9.5, 1, 0.1)],
        [began(1), ticks_message(10.5, 1, 1.0), ticks_message(11.5, 3, 2.0), ticks_message(12.5, 4)],
        [began(1), ticks_message(9.5, 1), ticks_message(10.5, 3, 1.0), ticks_message(12.5, 4)],
        [began(1), ticks_message(10.5, 2, 1.0), ticks_message(12.5, 3)],
    ],
)
def test_incomplete_ticks_are_unknown(entries):
    """The stay has no message about ticks; or a message is missing, in the stay or at its beginning."""
    assert read(*entries) is None


def test_ticks_of_the_next_recording_do_not_count():
    """The agent was killed, and its mission time begins again."""
    first = [began(1), ticks_message(10.5, 1, 1.0), ticks_message(11.5, 2, 2.0)]
    for end in (STOPPED, ""):
        assert missed(read(*first, began(13), ticks_message(14, 1, 0.1), end=end)["tick"], 0.1, 2.3) == [None, 0]


def test_last_ticks_message_makes_ticks_complete():
    assert missed(read(began(1), ticks_message(12, 1, 1.0), end="")["tick"], 1.2, 1.3) == [0, None]
