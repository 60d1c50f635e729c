"""An alarm is set for one time at a time."""

from __future__ import annotations

import math

import pytest

from pancakes.mesh.links import Alarm


@pytest.fixture
def rung():
    return []


@pytest.fixture
def alarm_of(memory_rig, rung):
    transport = memory_rig.transport("a")
    return lambda **more: Alarm(transport, memory_rig.clock.now, lambda: rung.append(memory_rig.clock.now()), **more)


def test_it_rings_once_when_it_is_due(alarm_of, memory_rig, rung):
    alarm = alarm_of()
    alarm.set(2.0)
    assert alarm.due_s == 2.0
    memory_rig.timeline.run_until(9.0)
    assert rung == [2.0] and alarm.due_s == math.inf
    alarm.set(2.0)  # that is over: at once
    memory_rig.timeline.run_until(10.0)
    assert rung == [2.0, 9.0]


@pytest.mark.parametrize("times_s", [(2.0, 5.0), (5.0, 2.0), (5.0, math.inf, 3.0), (2.0, 2.0)])
def test_only_the_newest_time_counts(alarm_of, memory_rig, rung, times_s):
    alarm = alarm_of()
    for due_s in times_s:
        alarm.set(due_s)
    memory_rig.timeline.run_until(9.0)
    assert rung == [times_s[-1]]


def test_it_may_be_called_off(alarm_of, memory_rig, rung):
    alarm = alarm_of()
    alarm.set(2.0)
    alarm.set(math.inf)
    memory_rig.timeline.run_until(9.0)
    assert rung == []


def test_with_some_slack_it_rings_so_much_later(alarm_of, memory_rig, rung):
    alarm_of(slack_s=0.5).set(2.0)
    memory_rig.timeline.run_until(9.0)
    assert rung == [2.5]


def test_it_may_be_set_anew_while_it_rings(memory_rig):
    rung = []

    def ring():
        rung.append(memory_rig.clock.now())
        alarm.set(rung[-1] + 1.0 if len(rung) < 3 else math.inf)

    alarm = Alarm(memory_rig.transport("a"), memory_rig.clock.now, ring)
    alarm.set(1.0)
    memory_rig.timeline.run_until(9.0)
    assert rung == [1.0, 2.0, 3.0]
