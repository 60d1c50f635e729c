"""Permits: which guarded tasks may act, by two clocks."""

from __future__ import annotations

import pytest
from kernel.virtual_rig import VirtualRig, Word

from pancakes.errors import NoPermitError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.permits import PermitEnd, Permits
from pancakes.packet import Fence

FIRST = Fence("a/Scan", (1, "a"))
LATER = Fence("a/Scan", (2, "b"))


class Clocks:
    """Two clocks that a test moves.

    Attributes:
        boot_s: the one that counts a suspend.
        wall_s: the time of day.
        lines: what was said.
    """

    def __init__(self) -> None:
        self.boot_s, self.wall_s = 100.0, 1000.0
        self.lines: list[tuple[str, str]] = []

    def moment(self) -> PermitEnd:
        return PermitEnd(self.boot_s, self.wall_s)

    def permits(self) -> Permits:
        return Permits(self.moment, lambda level, text: self.lines.append((level, text)))

    def pass_s(self, boot_s: float, wall_s: float | None = None) -> None:
        self.boot_s += boot_s
        self.wall_s += boot_s if wall_s is None else wall_s


def test_what_is_not_guarded_may_always_act() -> None:
    permits = Clocks().permits()
    assert permits.may_act(None) and permits.may_act(FIRST) and permits.left_s(FIRST) is None
    permits.revoke(Fence("b/Other", (0, "b")))
    assert permits.may_act(None) and permits.may_act(FIRST)
    assert permits.limited(FIRST, 0.5) is FIRST


def test_a_permit_lasts_until_its_end() -> None:
    clocks = Clocks()
    permits = clocks.permits()
    permits.give(FIRST, clocks.moment().later(2.0))
    clocks.pass_s(1.5)
    assert permits.may_act(FIRST) and permits.left_s(FIRST) == pytest.approx(0.5)
    clocks.pass_s(0.5)
    assert not permits.may_act(FIRST) and permits.left_s(FIRST) == 0.0
    permits.free(FIRST.task_id)
    assert permits.may_act(FIRST)


@pytest.mark.parametrize("by", [(3.0, 0.0), (0.0, 3.0), (3.0, -50.0)], ids=["suspended", "set forward", "set back"])
def test_a_permit_is_over_as_soon_as_either_clock_says_so(by: tuple[float, float]) -> None:
    clocks = Clocks()
    permits = clocks.permits()
    permits.give(FIRST, clocks.moment().later(2.0))
    clocks.pass_s(*by)
    assert not permits.may_act(FIRST)


def test_a_step_of_the_time_of_day_alone_is_told_from_other_ends_and_counted() -> None:
    clocks = Clocks()
    permits = clocks.permits()
    permits.give(FIRST, clocks.moment().later(2.0))
    clocks.pass_s(1.0)
    assert permits.ended_by_step(FIRST) == 0.0
    clocks.pass_s(0.5, 8.5)
    assert permits.ended_by_step(FIRST) == pytest.approx(8.0) and permits.steps("a/Scan") == 1
    permits.give(FIRST, clocks.moment().later(2.0))
    clocks.pass_s(5.0)
    assert permits.ended_by_step(FIRST) == 0.0 and permits.steps("a/Scan") == 1


def test_a_new_epoch_has_no_permit_before_it_is_given_one() -> None:
    clocks = Clocks()
    permits = clocks.permits()
    permits.give(FIRST, clocks.moment().later(2.0))
    assert not permits.begin(FIRST) and permits.may_act(FIRST)
    assert permits.begin(LATER)
    assert not permits.may_act(LATER) and not permits.may_act(FIRST)


def test_a_later_epoch_than_this_agent_ever_had_is_the_business_of_another() -> None:
    permits = Clocks().permits()
    permits.revoke(FIRST)
    assert not permits.may_act(FIRST) and permits.may_act(LATER)
    permits.revoke(LATER)
    assert not permits.may_act(LATER)


def test_a_right_says_for_how_long_it_is_good_whichever_limit_comes_first() -> None:
    clocks = Clocks()
    permits = clocks.permits()
    permits.give(FIRST, clocks.moment().later(2.0))
    assert permits.limited(FIRST, 0.5).good_for_s == 0.5
    assert permits.limited(FIRST, 9.0).good_for_s == pytest.approx(2.0)
    told = Fence("b/Other", (7, "b"), 0.2)
    assert permits.limited(told, 0.5) == told
    clocks.pass_s(1.9)
    assert permits.limited(Fence("a/Scan", (1, "a"), 0.4), 0.5).good_for_s == pytest.approx(0.1)


def test_what_is_held_back_is_counted_and_said_once_each_time_that_a_permit_is_over() -> None:
    clocks = Clocks()
    permits = clocks.permits()
    permits.revoke(FIRST)
    for _ in range(3):
        permits.hold_back(FIRST, "packets", 2)
    permits.hold_back(FIRST, "commands")
    assert permits.held_back("a/Scan") == {"packets": 6, "commands": 1}
    assert [text for _, text in clocks.lines] == [
        "a/Scan may not act until its guardians answer: its packets are held back",
        "a/Scan may not act until its guardians answer: its commands are held back",
    ]
    permits.give(FIRST, clocks.moment().later(2.0))
    clocks.pass_s(3.0)
    permits.hold_back(FIRST, "packets")
    assert len(clocks.lines) == 3 and permits.held_back("a/Scan")["packets"] == 7


@pytest.mark.parametrize("channel", ["ctrl", "network", "system"])
def test_what_may_not_act_publishes_on_log_alone(virtual: VirtualRig, channel: str) -> None:
    actor = virtual.spawn(ActorCore, "a/client/Guarded")
    actor.fence = FIRST
    virtual.kernel.permits.revoke(FIRST)
    with pytest.raises(NoPermitError, match="a/client/Guarded may not act until its guardians answer"):
        actor.publish(channel, Word("late"))
    assert virtual.kernel.permits.held_back(FIRST.task_id) == {"packets": 1}
    actor.log("info", "I wait")
    assert "I wait" in virtual.lines()
