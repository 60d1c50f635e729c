"""What an agent says of its peers' clocks."""

from __future__ import annotations

import pytest

from pancakes.util.timebase import Timebase


def test_a_peers_clock_mission_and_day_are_described_as_they_stand_to_ones_own(memory_rig):
    a = memory_rig.agent("a", timebase=lambda: Timebase(10.0, 0.0, 2.0, 1000.0))
    b = memory_rig.agent("b", [a.address], timebase=lambda: Timebase(8.0, 1.0, 2.0, 1004.0))
    memory_rig.timeline.run_until(5.0)
    said = a.mesh.clocks.describe("b")
    assert abs(said["offset_s"]) <= said["bound_s"] < 0.1
    assert said["mission_ahead_s"] == pytest.approx(5.0, abs=4 * said["bound_s"])
    assert said["day_ahead_s"] == pytest.approx(4.0, abs=4 * said["bound_s"])
    assert b.mesh.clocks.describe("a")["mission_ahead_s"] == pytest.approx(-5.0, abs=0.1)
    memory_rig.timeline.run_until(12.0)
    later = a.mesh.clocks.describe("b")
    assert later["mission_ahead_s"] == pytest.approx(5.0, abs=0.1), "both go on at one speed"


def test_of_missions_that_are_held_or_of_another_speed_it_is_not_said_how_far_one_is_ahead(memory_rig):
    a = memory_rig.agent("a", timebase=lambda: Timebase(1.0))
    memory_rig.agent("held", [a.address], timebase=Timebase)
    memory_rig.agent("quick", [a.address], timebase=lambda: Timebase(1.0, 0.0, 5.0))
    memory_rig.timeline.run_until(5.0)
    assert [a.mesh.clocks.describe(name)["mission_ahead_s"] for name in ("held", "quick")] == [None, None]


def test_nothing_is_said_of_a_stranger_nor_by_an_end_without_a_mission(memory_rig):
    a = memory_rig.agent("a", timebase=lambda: Timebase(1.0))
    terminal = memory_rig.agent("t", [a.address], role="client")
    memory_rig.timeline.run_until(5.0)
    assert a.mesh.clocks.describe("z") is None
    assert terminal.knows("a") and terminal.mesh.clocks.describe("a") is None


def test_only_agents_that_may_say_so_are_believed_their_mission(memory_rig):
    a = memory_rig.agent("a", timebase=lambda: Timebase(1.0))
    memory_rig.agent("liar", [a.address], timebase=lambda: Timebase(3.0, 0.0, 1.0))
    memory_rig.agent("t", [a.address], role="client", timebase=lambda: Timebase(3.0, 0.0, 1.0))
    memory_rig.timeline.run_until(4.0)
    memory_rig.agent("z", [a.address], timebase=lambda: Timebase(2.0, 0.0, 1.0))
    memory_rig.timeline.run_until(9.0)
    missions, unknown = a.mesh.clocks.missions(lambda peer: peer != "liar")
    assert ([it.peer for it in missions], unknown) == (["z"], False)


def test_a_peers_clock_is_known_after_its_link_has_ended_but_not_that_of_a_terminal(memory_rig):
    a = memory_rig.agent("a", timebase=lambda: Timebase(1.0))
    b = memory_rig.agent("b", [a.address], timebase=lambda: Timebase(2.0))
    terminal = memory_rig.agent("t", [a.address], role="client", timebase=lambda: Timebase(3.0))
    memory_rig.timeline.run_until(5.0)
    assert a.mesh.clocks.clock_of("b") is not None and a.mesh.clocks.clock_of("t") is not None
    b.mesh.stop()
    terminal.mesh.stop()
    memory_rig.timeline.run_until(10.0)
    assert not a.knows("b") and a.mesh.clocks.clock_of("b") is not None
    assert a.mesh.clocks.clock_of("t") is None
