"""The barrier: what it allows near other things, and what it does if poses are missing, old or wrong."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pancakes.devices import Pose, RobotPose, Twist
from pancakes.filters.barrier import Barrier, driven
from pancakes.filters.filter import Changed, Held
from pancakes.packet import Packet
from pancakes.settings import make_settings

ROBOT = {"radius_m": 0.1, "max_mps": 0.2, "max_radps": 3.0}
AHEAD = Twist(0.2, 0.0)


class Context:
    """What a barrier sees of its agent: a clock that the test moves, and what it publishes."""

    agent, device, name = "a", "motors", "apart"

    def __init__(self) -> None:
        self.time_s = 0.0
        self.sent: list[tuple[str, Any, str]] = []
        self.handlers: dict[type, Any] = {}
        self.kept: dict[str, Any] = {}

    def now(self) -> float:
        return self.time_s

    def subscribe(self, channel: str, body: type, handler: Any) -> None:
        self.handlers[body] = handler

    def publish(self, channel: str, body: Any, to: str = "") -> None:
        self.sent.append((channel, body, to))

    def published_s(self, packet: Packet) -> float:
        return packet.stamp_s


class Rig:
    """A barrier, and what it hears."""

    def __init__(self, **settings: Any) -> None:
        self.context = Context()
        self.barrier = Barrier(self.context, make_settings(Barrier.Settings, {**ROBOT, **settings}))  # type: ignore[arg-type]
        self.barrier.open()

    def at(self, time_s: float) -> Rig:
        self.context.time_s = time_s
        return self

    def pose(self, x_m: float, y_m: float = 0.0, theta_rad: float = 0.0, source: str = "a/device/pose") -> Rig:
        body = Pose(x_m, y_m, theta_rad)
        self.context.handlers[Pose](Packet("system", "pose", source, "", self.context.time_s, 1, body))
        return self

    def other(self, x_m: float, y_m: float = 0.0, *, robot: str = "b", by: str = "", **of: Any) -> Rig:
        fields = {"theta_rad": 0.0, "radius_m": 0.1, "max_mps": 0.2, "ahead_m": 0.05, "yields": True, **of}
        body = RobotPose(robot, x_m, y_m, **fields)
        source = f"{by or robot}/device/motors"
        self.context.handlers[RobotPose](Packet("system", "robot_pose", source, "a", self.context.time_s, 1, body))
        return self

    def apply(self, command: Twist = AHEAD) -> Any:
        return self.barrier.apply(command, 0.5, "a/client/Driving")

    def speed(self, command: Twist = AHEAD) -> float:
        found = self.apply(command)
        assert not isinstance(found, Held), found.why
        return found.command.v_mps if isinstance(found, Changed) else found.v_mps

    def why(self, command: Twist = AHEAD) -> str:
        found = self.apply(command)
        return found.why if isinstance(found, (Changed, Held)) else ""


def held(why: str) -> Held:
    return Held(why)


def test_command_passes_if_nothing_is_near():
    rig = Rig().pose(0.0).other(2.0)
    assert rig.apply() is AHEAD
    assert rig.apply(Twist(-0.1, 1.0)) == Twist(-0.1, 1.0)


def test_too_fast_command_is_slowed_on_its_path():
    found = Rig().pose(0.0).apply(Twist(0.4, 1.0))
    assert found.why == "too fast"
    assert found.command.omega_radps / found.command.v_mps == pytest.approx(2.5)
    assert abs(found.command.v_mps) / 0.2 + abs(found.command.omega_radps) / 3.0 <= 1.0 + 1e-9


def test_two_robots_close_half_of_the_gap_each():
    """Facing each other, 0.42 m lie between the points, of which 0.1 + 0.05 + 0.1 + 0.05 + 0.02 m are kept."""
    rig = Rig().pose(0.0).other(0.52, theta_rad=math.pi)
    assert rig.speed() == pytest.approx(0.5 * (0.52 - 0.1 - 0.32))
    assert rig.why() == "keeps clear of b"


@pytest.mark.parametrize("of", [{"yields": False}, {"by": "tracker"}], ids=["no barrier", "not its own word"])
def test_robot_without_a_barrier_gets_all_of_the_way(of):
    """It may come at its full speed: clear of it are 0.1 + 0.05 + 0.1 + 0.2 m."""
    rig = Rig().pose(0.0).other(0.05 + 0.45 + 0.3, **of)
    assert rig.speed() == pytest.approx(0.3 - 0.2)
    assert Rig().pose(0.0).other(0.05 + 0.45 + 0.1, **of).speed() == pytest.approx(0.1 - 0.2), "it backs off"


def test_robot_slows_down_before_the_edge_of_its_area():
    area = {"x_min_m": -1.0, "x_max_m": 1.0, "y_min_m": -1.0, "y_max_m": 1.0}
    rig = Rig(area=area)
    assert rig.pose(0.0).apply() is AHEAD
    for theta_rad in (0.0, math.pi / 2, math.pi, -math.pi / 2):
        rig = Rig(area=area).pose(0.75 * math.cos(theta_rad), 0.75 * math.sin(theta_rad), theta_rad)
        assert rig.speed() == pytest.approx(1.0 - 0.8 - 0.17)
        assert rig.why() == "keeps clear of the edge of its area"
    assert Rig(area=area).pose(1.1).speed() < 0.0, "it comes back in"


def test_robot_stays_out_of_a_no_go_area():
    area = {"x_min_m": 1.0, "x_max_m": 2.0, "y_min_m": -0.2, "y_max_m": 0.2}
    rig = Rig(keep_out=[area])
    assert rig.pose(0.75).speed() == pytest.approx(1.0 - 0.8 - 0.17)
    assert rig.why() == "keeps clear of a no-go area"
    assert Rig(keep_out=[area]).pose(1.1).speed() < 0.0, "it leaves it by the nearest side"
    assert Rig(keep_out=[area]).pose(0.75, 1.0).apply() is AHEAD


def test_robot_without_its_own_pose_holds():
    rig = Rig()
    assert rig.apply() == held("it does not know its own pose yet")
    rig.pose(0.0, source="a/device/other").pose(math.nan).pose(0.0, source="b/device/pose")
    assert Rig(pose="pose").pose(0.0, source="a/device/gps").apply() == held("it does not know its own pose yet")
    assert Rig().pose(math.nan).apply() == held("it does not know its own pose yet")
    assert Rig().pose(0.0, source="b/device/pose").apply() == held("it does not know its own pose yet")
    assert rig.apply() is AHEAD


def test_own_pose_that_gets_old_slows_then_holds():
    rig = Rig().pose(0.0)
    assert rig.at(0.3).apply() is AHEAD
    assert rig.at(0.65).speed() == pytest.approx(0.1)
    assert rig.why() == "its own pose is old"
    assert rig.at(1.0).apply() == held("its own pose is too old")
    assert rig.pose(0.0).apply() is AHEAD
    rig.at(1.1).pose(math.nan)
    assert rig.at(2.0).apply() == held("its own pose is too old"), "a pose that is NaN is none"


def test_own_pose_that_jumps_holds_until_it_stays():
    rig = Rig().pose(0.0).at(0.1).pose(1.0)
    assert rig.apply() == held("its own pose has jumped")
    assert rig.at(0.3).pose(1.01).apply() == held("its own pose has jumped")
    assert rig.at(0.41).pose(1.02).apply() is AHEAD
    assert rig.at(0.5).pose(0.0).apply() == held("its own pose has jumped")


def test_silent_robot_may_be_ever_further_away():
    rig = Rig(hold_after_mission_s=1.0).pose(0.0).other(0.9)
    assert rig.at(0.3).pose(0.0).apply() is AHEAD
    assert rig.at(0.9).pose(0.0).speed() == pytest.approx(0.9 - 0.05 - 0.45 - 0.9 * 0.2 - 0.2)
    assert rig.at(4.0).pose(0.0).apply() == held("b is silent, and may be near")
    assert rig.other(1.0).apply() is AHEAD
    rig.at(5.0).pose(0.0).other(math.nan)
    assert rig.at(8.5).pose(0.0).apply() == held("b is silent, and may be near"), "a pose that is NaN is none"


def test_lost_robot_stands_where_it_was():
    rig = Rig(lost_after_mission_s=5.0).pose(0.0).other(1.0)
    assert rig.at(4.9).pose(0.0).apply() == held("b is silent, and may be near")
    assert rig.at(5.1).pose(0.0).apply() is AHEAD
    assert Rig(lost_after_mission_s=5.0).other(0.6).at(6.0).pose(0.0).speed() == pytest.approx(0.6 - 0.05 - 0.45)


def test_trackers_word_counts_if_the_robot_is_silent():
    rig = Rig().pose(0.0).other(1.0).other(0.4, by="tracker")
    assert rig.apply() is AHEAD, "what b says of itself counts"
    rig.at(1.0).pose(0.0).other(0.4, by="tracker")
    assert rig.speed() < 0.0
    assert rig.why() == "keeps clear of b"


def test_robot_that_jumps_may_be_at_either_place():
    rig = Rig().pose(0.0).other(0.4, theta_rad=math.pi).at(0.1).other(3.0)
    assert rig.why() == "keeps clear of b"
    assert rig.at(0.5).pose(0.0).other(3.0).apply() is AHEAD


def test_two_robots_in_one_place_hold():
    rig = Rig().pose(0.0).other(0.0)
    assert rig.apply() == held("its own pose and that of b are in one place")
    assert Rig().pose(0.0).other(0.05).apply() == held("its own pose and that of b are in one place")


def test_poses_of_itself_by_others_are_not_believed():
    assert Rig().pose(0.0).other(0.3, robot="a", by="b").apply() is AHEAD


def test_own_pose_is_told_to_neighbours_at_a_rate():
    rig = Rig(tell_hz=10.0)
    for step in range(20):
        rig.at(0.05 * step).pose(0.01 * step, 0.2, 0.3)
    told = [body for channel, body, to in rig.context.sent if (channel, to) == ("system", "*")]
    assert len(told) == pytest.approx(10, abs=1)
    assert told[0] == RobotPose("a", 0.0, 0.2, 0.3, 0.1, 0.2, 0.0, 0.05, True)
    rig = Rig().pose(math.nan)
    assert rig.context.sent == []


def test_no_agent_makes_a_robot_forget_others():
    rig = Rig().pose(0.0).other(0.4, theta_rad=math.pi).other(0.5, 0.5, robot="walker", by="tracker")
    for number in range(1000):
        rig.other(2.0, robot=f"r{number}", by="liar")
    known = rig.barrier.surroundings.robots
    assert len(known) == 64 and {"b", "walker", "r999"} <= set(known)
    rig.other(2.0, robot="newcomer")
    assert len(known) == 64 and {"b", "newcomer", "r999"} <= set(known)
    for number in range(1000):
        rig.other(2.0, robot=f"n{number}")
    assert len(known) == 64 and "b" in known


def test_own_word_counts_although_a_tracker_is_faster():
    rig = Rig().at(1.0).pose(0.0).other(1.0, by="tracker").other(1.0, age_s=0.1)
    assert rig.barrier.surroundings.robots["b"].own_word
    rig.other(1.0, robot="c", by="tracker").other(1.0, robot="c", age_s=0.9)
    assert not rig.barrier.surroundings.robots["c"].own_word, "what is too old counts for nothing"


def test_blocked_robot_gives_way_to_the_right():
    rig = Rig(tell_hz=1.0)
    turned = 0.0
    for step in range(60):
        rig.at(0.05 * step).pose(0.0).other(0.42, theta_rad=math.pi)
        found = rig.apply()
        turned = min(turned, found.command.omega_radps)
    assert turned < -0.5
    straight = Rig(keep_right=False)
    for step in range(60):
        straight.at(0.05 * step).pose(0.0).other(0.42, theta_rad=math.pi)
        assert straight.apply().command.omega_radps == pytest.approx(0.0, abs=1e-9)


def test_driven_follows_an_arc():
    found = driven(Pose(0.0, 0.0, 0.0), Twist(0.1, math.pi / 2), 1.0)
    radius_m = 0.1 / (math.pi / 2)
    assert (found.x_m, found.y_m, found.theta_rad) == pytest.approx((radius_m, radius_m, math.pi / 2))
    assert driven(Pose(1.0, 2.0, math.pi / 2), Twist(0.5, 0.0), 2.0).y_m == pytest.approx(3.0)


def test_robot_holds_if_there_are_more_than_it_can_keep_clear_of():
    rig = Rig().at(0.0).pose(0.0)
    for number in range(64):
        rig.other(50.0 + number, robot=f"r{number}")
    assert not isinstance(rig.barrier.apply(AHEAD, 1.0, "a/client/T"), Held)
    rig.other(0.5, robot="r64")
    assert isinstance(rig.barrier.apply(AHEAD, 1.0, "a/client/T"), Held)
    rig.at(90.0).pose(0.0).other(90.0, robot="r64")
    rig.at(100.0).pose(0.0)
    assert "r64" in rig.barrier.surroundings.robots, "one that was silent for long made room"


def test_barrier_remembers_robots_while_its_device_is_restarted():
    rig = Rig().at(0.0).pose(0.0).other(0.4)
    again = Barrier(rig.context, rig.barrier.settings)  # type: ignore[arg-type]
    again.open()
    assert "b" in again.surroundings.robots


def test_places_that_robots_jumped_from_are_bounded():
    rig = Rig().at(0.0).pose(0.0)
    for number in range(200):
        rig.other(50.0, robot=f"r{number % 64}").other(10.0 + number, robot=f"r{number % 64}")
    assert len(rig.barrier.surroundings.ghosts) <= 64
