"""`Measure`: what an agent's processor time went to, between one moment and another, and only while it is asked."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import pytest

from pancakes.control import Measure, Restart
from pancakes.events import Event
from pancakes.packet import SYSCTRL, SYSTEM, Packet
from pancakes.services import root
from pancakes.task import Task, Tick, every, on
from pancakes.tools.forecast import MeasuredAgent
from pancakes.util import codecs


class Burn(Task):
    """Notes how much processor time its own ticks and packets took."""

    @dataclass
    class State:
        ticks: int = 0
        tick_s: float = 0.0

    state: State

    @every(hz=50)
    def burn(self, tick: Tick) -> None:
        begun_s = time.thread_time()
        sum(number & 7 for number in range(20_000))
        self.state.ticks += 1
        self.state.tick_s += time.thread_time() - begun_s

    @on(SYSTEM, Event)
    def heard(self, packet: Packet) -> None:
        sum(number & 7 for number in range(100_000))


class Idle(Task):
    """Has no more to do than to tick once a second."""

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        pass


def measured(agent, for_s: float = 0.5) -> MeasuredAgent:
    reply = agent.ask(Measure(for_s), timeout_s=30.0)
    assert reply.ok, reply.reason
    return codecs.convert(reply.result, MeasuredAgent)


def test_a_task_s_ticks_are_what_they_took(threaded_agent):
    agent = threaded_agent(tasks={"Burn": Burn})
    figures = measured(agent, 1.0)
    (timer,) = figures.task("Burn").timers
    state = agent.task("Burn").state
    assert (timer.timer, timer.rate_hz) == ("burn", 50.0) and 0 < timer.ticks <= 60
    assert timer.tick_s / timer.ticks == pytest.approx(state.tick_s / state.ticks, rel=0.5)
    assert timer.tick_s2 >= timer.tick_s**2 / timer.ticks * 0.999
    task = figures.task("Burn")
    assert timer.tick_s <= task.turn_s <= figures.turn_s <= figures.processor_s + 0.02
    assert figures.span_s >= 1.0 and figures.speed == 1.0 and figures.turns >= task.turns >= timer.ticks
    assert figures.host.processors <= (os.cpu_count() or 1)
    assert 0.0 < figures.host.busy_share <= 1.0
    assert 1e-5 < figures.host.yardstick_s < 0.1


def test_packets_count_as_turns_and_not_as_ticks(threaded_agent):
    agent = threaded_agent(tasks={"Burn": Burn})
    asked = agent.publish(SYSCTRL, Measure(2.0))
    agent.wait_until(lambda: agent.kernel.meter is not None)
    for _ in range(5):
        agent.publish(SYSTEM, Event("burn", {}))
    figures = codecs.convert(agent.reply_to(asked, 30.0).result, MeasuredAgent)
    task = figures.task("Burn")
    each_s = sum(timer.tick_s for timer in task.timers) / sum(timer.ticks for timer in task.timers)
    assert task.turn_s - sum(timer.tick_s for timer in task.timers) > 5 * 2.0 * each_s


def test_turns_are_timed_while_something_measures_and_at_no_other_time(threaded_agent):
    agent = threaded_agent(tasks={"Burn": Burn})
    assert agent.kernel.meter is None
    long, short = agent.publish(SYSCTRL, Measure(1.0)), agent.publish(SYSCTRL, Measure(0.2))
    assert agent.reply_to(short, 30.0).ok and agent.kernel.meter is not None
    figures = codecs.convert(agent.reply_to(long, 30.0).result, MeasuredAgent)
    assert agent.kernel.meter is None and figures.span_s >= 1.0
    assert figures.task("Burn").timers[0].ticks > 0


def test_one_that_begins_later_counts_only_the_turns_since_then(threaded_agent):
    agent = threaded_agent(tasks={"Burn": Burn})
    long = agent.publish(SYSCTRL, Measure(2.0))
    agent.wait_until(lambda: agent.kernel.meter is not None)
    before = agent.task("Burn").state.ticks
    agent.wait_until(lambda: agent.task("Burn").state.ticks > before + 40)
    late = measured(agent, 0.4).task("Burn")
    whole = codecs.convert(agent.reply_to(long, 30.0).result, MeasuredAgent).task("Burn")
    (timer,) = late.timers
    assert timer.ticks <= late.turns < whole.turns / 2


def test_a_task_that_begins_anew_meanwhile_is_counted_on(threaded_agent):
    agent = threaded_agent(tasks={"Burn": Burn})
    asked = agent.publish(SYSCTRL, Measure(1.0))
    agent.wait_until(lambda: agent.kernel.meter is not None)
    assert agent.ask(Restart("Burn")).ok
    (timer,) = codecs.convert(agent.reply_to(asked, 30.0).result, MeasuredAgent).task("Burn").timers
    assert timer.ticks > 0 and timer.missed >= 0


def test_of_a_task_at_rest_nothing_is_told_but_that_it_is_there(threaded_agent):
    agent = threaded_agent(tasks={"Burn": {"type": Burn, "start": False}})
    task = measured(agent, 0.1).task("Burn")
    assert (task.state, task.turns, task.turn_s, task.timers) == ("stopped", 0, 0.0, ())


def test_a_tick_that_is_not_missed_is_not_told_as_missed(threaded_agent):
    agent = threaded_agent(tasks={"Idle": Idle})
    (timer,) = measured(agent, 1.5).task("Idle").timers
    assert timer.missed == 0


def test_where_the_system_counts_no_processor_time_no_share_of_it_is_busy(threaded_agent, monkeypatch):
    monkeypatch.setattr(root, "processor_times", lambda: (1.0, 1.0))
    assert measured(threaded_agent(), 0.1).host.busy_share == 0.0


@pytest.mark.parametrize("for_s", [0.0, -1.0, 601.0, float("nan"), float("inf")])
def test_a_measurement_takes_some_time_and_not_for_ever(for_s: float, threaded_agent):
    reply = threaded_agent().ask(Measure(for_s))
    assert "a measurement takes from 0.1 to 600 s" in reply.reason


def test_in_virtual_time_there_is_nothing_to_measure(virtual_agent):
    reply = virtual_agent().ask(Measure(1.0))
    assert reply.reason == "a lives in virtual time, in which no processor time is measured"
