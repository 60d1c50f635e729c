"""What drains a battery, and what it says then."""

import pytest

from pancakes.sim.battery import BatteryModel, BatterySettings


def battery(**settings):
    return BatteryModel(BatterySettings(**{"capacity_j": 1000.0, "idle_w": 0.0, **settings}), full_v=8.4, empty_v=6.6)


def test_it_begins_as_full_as_it_is_told():
    assert battery().voltage_v == pytest.approx(8.4)
    assert battery(level=0.5).voltage_v == pytest.approx(7.5)


def test_its_level_is_the_share_of_the_voltage_range():
    pack = battery()
    assert [pack.level_at(v) for v in (8.4, 7.5, 6.6)] == pytest.approx([1.0, 0.5, 0.0])
    assert (pack.level_at(9.0), pack.level_at(6.0)) == (1.0, 0.0)


def test_time_takes_the_idle_power():
    pack = battery(idle_w=2.0)
    pack.passed(elapsed_s=100.0, rolled_m=0.0)
    assert pack.level == pytest.approx(0.8)


def test_rolling_takes_energy_for_each_metre():
    pack = battery(motion_j_per_m=5.0)
    pack.passed(elapsed_s=10.0, rolled_m=20.0)
    assert pack.level == pytest.approx(0.9)


def test_each_reading_costs_what_its_kind_costs():
    pack = battery(sample_j={"ir": 1.0, "sonar": 10.0})
    for _ in range(10):
        pack.sampled("ir")
    pack.sampled("sonar")
    pack.sampled("thermometer")
    assert pack.level == pytest.approx(0.98)


def test_each_mission_packet_costs_once():
    pack = battery(packet_j=1.0)
    for total in (10, 10, 30):
        pack.packets_sent(total)
    assert pack.level == pytest.approx(0.97)


def test_an_agent_that_was_restarted_counts_anew():
    pack = battery(packet_j=1.0)
    pack.packets_sent(30)
    pack.packets_sent(5)
    assert pack.level == pytest.approx(0.965)


def test_it_is_empty_at_nothing_and_never_below():
    pack = battery(idle_w=1.0)
    pack.passed(elapsed_s=2000.0, rolled_m=0.0)
    assert pack.empty
    assert pack.voltage_v == pytest.approx(6.6)


def test_a_small_battery_loses_a_third_on_the_circle_in_two_and_a_half_minutes():
    """The paper's mission: 0.1 m/s, infrared at 10 Hz, sonar at 5 Hz, five packets a second."""
    pack = BatteryModel(BatterySettings(capacity_j=750.0), 8.4, 6.6)
    for second in range(150):
        pack.passed(1.0, rolled_m=0.2)
        pack.packets_sent(5 * (second + 1))
        for _ in range(10):
            pack.sampled("ir")
        for _ in range(5):
            pack.sampled("sonar")
    assert 0.60 < pack.level < 0.70


def test_a_dock_fills_it_and_no_more_than_that():
    pack = battery(level=0.5)
    pack.charged(300.0)
    assert pack.level == pytest.approx(0.8)
    pack.charged(300.0)
    assert pack.level == 1.0


def test_a_defective_one_takes_nothing_from_a_dock():
    pack = battery(level=0.5, charges=False)
    pack.charged(300.0)
    assert pack.level == 0.5
