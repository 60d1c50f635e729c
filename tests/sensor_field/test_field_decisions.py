"""The decisions of a sensor field, without any agent: physics, duty, and what an alarm makes of reports."""

from __future__ import annotations

import pytest
from pancakes_sensor_field.duty import Duty
from pancakes_sensor_field.fusion import FusionSettings, Situation, judge, remember, weigh
from pancakes_sensor_field.packets import Report
from pancakes_sensor_field.physics import FireSettings, NodeSettings, Scene, SceneSettings, WalkerSettings


def scene() -> Scene:
    return Scene(
        SceneSettings(
            nodes={"near": NodeSettings(0.0, 0.0, sees_m=2.0), "far": NodeSettings(50.0, 0.0)},
            walkers={"fox": WalkerSettings([(10.0, -4.0, 0.0), (14.0, 0.0, 0.0), (20.0, 0.0, 0.0), (24.0, 0.0, 4.0)])},
            fires={"it": FireSettings(0.0, 0.0, starts_s=100.0, ends_s=130.0, peak_c=60.0, growth_s=5.0)},
            ambient_c=20.0,
            drift_c_per_hour=0.0,
        )
    )


def test_a_fire_grows_is_felt_nearby_and_dies_down() -> None:
    field = scene()
    near = [field.celsius("near", time_s) for time_s in (99.0, 105.0, 130.0, 135.0, 200.0)]
    assert near == pytest.approx([20.0, 57.9, 79.9, 42.0, 20.0], abs=0.1)
    assert field.celsius("far", 130.0) == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("time_s", "moving", "there"),
    [
        (9.9, False, 0),
        (11.0, False, 1),
        (12.5, True, 1),
        (17.0, False, 1),
        (21.0, True, 1),
        (23.0, False, 1),
        (24.1, False, 0),
    ],
)
def test_motion_is_what_moves_within_reach(time_s: float, moving: bool, there: int) -> None:
    assert scene().moving("near", time_s) is moving
    assert len(scene().walkers(time_s)) == there


def test_a_way_goes_forward_in_time() -> None:
    with pytest.raises(ValueError, match="each later than the one before"):
        WalkerSettings([(10.0, 0.0, 0.0), (10.0, 1.0, 0.0)])
    with pytest.raises(ValueError, match="ends after its start"):
        FireSettings(0.0, 0.0, starts_s=5.0, ends_s=5.0)


def test_a_node_is_busy_while_anything_happens_and_a_while_longer() -> None:
    duty = Duty(linger_s=10.0)
    assert not duty.decide(0.0) and not duty.busy
    duty.noticed("shed", True, 1.0)
    assert duty.decide(1.0) and duty.busy and duty.calm_in(1.0) is None
    duty.noticed("gate", True, 2.0)
    duty.noticed("shed", False, 3.0)
    assert not duty.decide(30.0) and duty.busy and duty.observers == ["gate"]
    duty.noticed("gate", False, 40.0)
    assert not duty.decide(49.9) and duty.busy and duty.calm_in(49.0) == pytest.approx(1.0)
    assert duty.decide(50.0) and not duty.busy and duty.calm_in(50.0) is None


def test_an_alarm_elsewhere_keeps_a_node_busy_for_as_long_as_it_is_said() -> None:
    duty = Duty(linger_s=10.0)
    for time_s in (0.0, 6.0, 12.0):
        duty.stirred(time_s)
        duty.decide(time_s)
        assert duty.busy
    assert not duty.decide(21.9) and duty.decide(22.0) and not duty.busy


SETTINGS = FusionSettings(hot_c=45.0, window_s=20.0, raise_at=3.0, clear_after_s=15.0)


def told(*reports: tuple[float, str, float, bool]) -> Situation:
    """Returns what (time, node, degrees, motion) amount to."""
    situation = Situation()
    for made_s, node, celsius, moving in reports:
        number = situation.nodes[node].highest + 1 if node in situation.nodes else 1
        remember(situation, Report(node, number, celsius, moving), made_s, SETTINGS)
    return situation


@pytest.mark.parametrize(
    ("reports", "weight"),
    [
        ([], 0.0),
        ([(1.0, "a", 20.0, True)], 1.0),
        ([(1.0, "a", 50.0, False)], 2.0),
        ([(1.0, "a", 50.0, True)], 3.0),
        ([(1.0, "a", 50.0, False), (2.0, "b", 20.0, True)], 3.0),
        ([(1.0, "a", 20.0, True), (2.0, "b", 20.0, True), (3.0, "c", 20.0, True)], 3.0),
        ([(1.0, "a", None, True), (2.0, "a", 44.9, True)], 1.0),
    ],
)
def test_evidence_of_different_nodes_adds_up(reports: list[tuple[float, str, float, bool]], weight: float) -> None:
    assert weigh(told(*reports), 5.0, SETTINGS).weight == weight


def test_evidence_grows_old_but_not_what_goes_on() -> None:
    situation = told((0.0, "a", 50.0, True), (0.0, "b", 20.0, True), (4.0, "b", 20.0, False))
    assert weigh(situation, 20.0, SETTINGS).hot == ("a",)
    assert weigh(situation, 23.5, SETTINGS).moving == ("a", "b")
    later = weigh(situation, 24.5, SETTINGS)
    assert later.hot == () and later.moving == ("a",), "b moved up to its last report, a has not said that it is still"


def test_an_alarm_is_raised_once_and_cleared_when_it_has_been_quiet_for_long_enough() -> None:
    situation = told((10.0, "a", 50.0, False), (11.0, "b", 20.0, True))
    assert judge(situation, 11.0, SETTINGS)[1] == "raised" and situation.alarms == 1
    assert judge(situation, 12.0, SETTINGS)[1] == ""
    remember(situation, Report("b", 2, 20.0, False), 13.0, SETTINGS)
    assert [judge(situation, float(now_s), SETTINGS)[1] for now_s in range(14, 50)].index("cleared") == 45 - 14
    assert not situation.open and judge(situation, 50.0, SETTINGS)[1] == ""
    remember(situation, Report("a", 2, 60.0, True), 51.0, SETTINGS)
    assert judge(situation, 51.0, SETTINGS)[1] == "raised" and situation.alarms == 2


def test_each_report_counts_so_that_a_lost_or_doubled_one_is_seen() -> None:
    situation = told((1.0, "a", 20.0, False), (2.0, "a", 20.0, False))
    remember(situation, Report("a", 4, 20.0, False), 3.0, SETTINGS)
    node = situation.nodes["a"]
    assert (node.received, node.highest) == (3, 4)
