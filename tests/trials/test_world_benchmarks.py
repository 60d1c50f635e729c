"""The benchmarks of simulated worlds, in short runs from end to end."""

from __future__ import annotations

from benchmarks import big_world, virtual_mission


def test_the_mission_in_virtual_time_is_measured():
    assert virtual_mission.mission(1, 0.0) > 0.0


def test_every_robot_of_a_big_world_gets_its_readings():
    percent, readings_hz, p50_ms, p99_ms = big_world.world(5, 1.0)
    assert percent > 0.0
    assert readings_hz > 0.0
    assert 0.0 < p50_ms <= p99_ms


def test_a_simulation_of_more_robots_takes_more_without_agent_and_bus():
    assert 0.0 < big_world.simulation_alone(1, 0.2) < big_world.simulation_alone(100, 0.2)
