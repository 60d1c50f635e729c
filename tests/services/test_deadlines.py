"""A deadline that is put off: it comes once, at the time that was set last, and takes few timers."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from pancakes.durable.deadlines import Deadlines
from pancakes.kernel.timer import OneShot


class Host:
    """A host clock with its timers, and when the deadline came."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.timers: list[tuple[float, OneShot]] = []
        self.came_s: list[float] = []
        self.fired = 0
        self.deadlines = Deadlines(self.after_host, lambda: self.now_s)
        self.deadline = self.deadlines.new(lambda: self.came_s.append(self.now_s))

    def after_host(self, delay_s: float, function: Callable[[], None]) -> OneShot:
        shot = OneShot(function)
        self.timers.append((self.now_s + delay_s, shot))
        return shot

    def run_until(self, time_s: float) -> None:
        done: set[int] = set()
        while left := [it for it in self.timers if id(it) not in done and self.now_s <= it[0] <= time_s]:
            self.now_s, shot = first = min(left, key=lambda it: it[0])
            done.add(id(first))
            self.fired += 1
            shot()
        self.now_s = time_s
        self.timers = [it for it in self.timers if id(it) not in done]


@pytest.fixture
def host() -> Host:
    return Host()


def test_it_comes_once(host: Host) -> None:
    host.deadline.set(2.0)
    host.run_until(10.0)
    assert host.came_s == [2.0]


def test_one_that_is_put_off_comes_later_and_takes_one_timer_for_each_time_that_passes(host: Host) -> None:
    made = 0
    for quarter in range(40):
        host.run_until(quarter * 0.5)
        before = len(host.timers)
        host.deadline.set(2.0)
        made += len(host.timers) - before
    assert host.came_s == [] and made == 1
    host.run_until(100.0)
    assert host.came_s == [21.5]


def test_one_that_is_set_to_an_earlier_time_comes_then_and_not_again(host: Host) -> None:
    host.deadline.set(5.0)
    host.deadline.set(1.0)
    host.run_until(10.0)
    assert host.came_s == [1.0]


def test_one_that_is_called_off_does_not_come_and_may_be_set_again(host: Host) -> None:
    host.deadline.set(1.0)
    host.deadline.cancel()
    host.run_until(2.0)
    host.deadline.set(1.0)
    host.run_until(10.0)
    assert host.came_s == [3.0]


def test_one_that_is_called_off_while_its_call_waits_in_a_mailbox_does_not_come() -> None:
    waiting: list[Callable[[], None]] = []
    came: list[int] = []

    def after_host(delay_s: float, function: Callable[[], None]) -> OneShot:
        waiting.append(function)
        return OneShot(function)

    deadline = Deadlines(after_host, lambda: 0.0).new(lambda: came.append(1))
    deadline.set(0.0)
    deadline.cancel()
    waiting[0]()
    assert came == []


def test_many_share_a_timer_and_each_comes_at_its_time(host: Host) -> None:
    came: list[tuple[float, int]] = []
    many = [host.deadlines.new(lambda number=number: came.append((host.now_s, number))) for number in range(20)]  # type: ignore[misc]
    for quarter in range(8):
        host.run_until(quarter * 0.5)
        for one in many:
            one.set(2.0)
    assert not came and host.fired <= 3
    many[3].set(0.5)
    many[7].cancel()
    host.run_until(20.0)
    assert came[0] == (4.0, 3) and came[1:] == [(5.5, number) for number in range(20) if number not in (3, 7)]


def test_one_may_set_and_call_off_others_that_are_due_with_it(host: Host) -> None:
    came: list[tuple[float, str]] = []

    def first() -> None:
        came.append((host.now_s, "first"))
        second.set(1.0)
        third.cancel()
        fourth.set(0.0)

    made = [host.deadlines.new(first)]
    second = host.deadlines.new(lambda: came.append((host.now_s, "second")))
    third = host.deadlines.new(lambda: came.append((host.now_s, "third")))
    fourth = host.deadlines.new(lambda: came.append((host.now_s, "fourth")))
    for one in (*made, second, third, fourth):
        one.set(2.0)
    host.run_until(10.0)
    assert came == [(2.0, "first"), (2.0, "fourth"), (3.0, "second")]
