"""The simulated world without any agent: commands go in, readings come out."""

import math
import random
import time
from dataclasses import replace

import pytest

from pancakes.devices import Battery, Encoders, Infrared, LaserScan, Motion, Pose, Sonar, Twist
from pancakes.errors import PancakesError
from pancakes.settings import SettingsError, check_settings, make_settings
from pancakes.sim.battery import BatteryModel, BatterySettings
from pancakes.sim.bodies import (
    ArenaSettings,
    ContentSettings,
    Disc,
    MotionSettings,
    NoiseSettings,
    Robot,
    RobotSettings,
    SensorSettings,
)
from pancakes.sim.pedestrian import MoverSettings
from pancakes.sim.robot_models import KHEPERA_III, Wheels
from pancakes.sim.world import Physics

QUIET = NoiseSettings(wheel=0.0, ir_share=0.0, ir_raw=0.0, sonar_m=0.0, laser_m=0.0)


def robot(x_m, y_m, theta_rad=0.0, **others):
    return RobotSettings(x_m, y_m, theta_rad, **{"spread_m": 0.0, "spread_rad": 0.0, **others})


def simulation(seed=1, **contents):
    return Physics(ContentSettings(**{"noise": QUIET, **contents}), random.Random(seed))


def body(world, name):
    return next(one for one in world.state().bodies if one.name == name)


def paper_world(seed=1):
    return simulation(
        seed,
        robots={"agent1": RobotSettings(0.55, 0.0, math.pi / 2), "agent2": RobotSettings(1.5, -1.2)},
        sensors={"sensor": SensorSettings()},
        movers={"mover": MoverSettings(-1.5, 1.0)},
        noise=NoiseSettings(),
    )


# Driving --------------------------------------------------------------------------------------------------------


def test_a_robot_follows_its_wheels():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    world.drive("agent1", Wheels(0.1, 0.1), 10.0, "agent1/client/ScanTarget")
    world.advance(2.0)
    assert body(world, "agent1").x_m == pytest.approx(0.2, abs=0.002)
    assert body(world, "agent1").v_mps == pytest.approx(0.1, abs=1e-4)


def test_the_wheels_obey_the_last_command_for_its_time_to_live_then_stand():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    world.drive("agent1", Wheels(0.1, 0.1), 0.5, "agent1/client/ScanTarget")
    world.advance(0.49)
    assert body(world, "agent1").driven_by == "ScanTarget"
    world.advance(0.52)
    assert body(world, "agent1").driven_by == ""
    assert body(world, "agent1").v_mps == pytest.approx(0.0)
    x_m = body(world, "agent1").x_m
    assert x_m == pytest.approx(0.05, abs=0.002)
    world.advance(5.0)
    assert body(world, "agent1").x_m == x_m


def test_a_command_without_a_source_dies_as_well():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    world.drive("agent1", Wheels(0.1, 0.1), 0.5, "")
    world.advance(2.0)
    assert body(world, "agent1").x_m == pytest.approx(0.05, abs=0.002)


def test_fresh_commands_keep_a_robot_going():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    for step in range(10):
        world.drive("agent1", Wheels(0.1, 0.1), 0.5, "agent1/client/GoHome")
        world.advance((step + 1) * 0.2)
    assert body(world, "agent1").x_m == pytest.approx(0.2, abs=0.002)
    assert body(world, "agent1").driven_by == "GoHome"


def test_hold_stops_the_wheels_at_once():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    world.drive("agent1", Wheels(0.1, 0.1), 10.0, "agent1/client/ScanTarget")
    world.advance(1.0)
    world.hold("agent1")
    assert body(world, "agent1").driven_by == ""
    world.advance(2.0)
    assert body(world, "agent1").x_m == pytest.approx(0.1, abs=0.002)


def test_no_command_makes_the_wheels_faster_than_they_can_be():
    world = simulation(robots={"agent1": robot(-1.0, 0.0)})
    world.drive("agent1", Wheels(5.0, 5.0), 10.0, "x")
    world.advance(3.0)
    assert body(world, "agent1").v_mps == pytest.approx(KHEPERA_III.drive.max_wheel_mps, abs=1e-4)


def test_the_world_stands_at_0_until_it_is_told_to_advance():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    world.drive("agent1", Wheels(0.1, 0.1), 10.0, "x")
    world.advance(0.0)
    assert world.time_s == 0.0
    assert body(world, "agent1").x_m == 0.0


def test_a_robot_with_an_empty_battery_stands():
    dead = BatterySettings(capacity_j=1.0, idle_w=1.0)
    world = simulation(robots={"agent1": robot(0.0, 0.0, battery=dead)})
    for step in range(50):
        world.drive("agent1", Wheels(0.1, 0.1), 0.5, "x")
        world.advance(0.1 * (step + 1))
    assert body(world, "agent1").x_m < 0.11
    assert body(world, "agent1").battery_v == pytest.approx(6.6)


# Sensing --------------------------------------------------------------------------------------------------------


def test_infrared_sees_a_neighbour_and_says_its_raw_value():
    gap_m = 0.10
    ahead = robot(0.0, 0.0, math.radians(-13))  # the sensor at 13 degrees, which sits at (0.070, 0.017), looks along x
    world = simulation(robots={"agent1": ahead, "agent2": robot(0.065 + 0.0719 + gap_m, 0.0)})
    reading = world.sample("agent1", "ir")
    assert isinstance(reading, Infrared)
    index = [round(math.degrees(b)) for b in reading.bearings_rad].index(13)
    assert reading.ranges_m[index] == pytest.approx(gap_m, abs=0.005)
    assert reading.raw[index] == pytest.approx(3960 * math.exp(-30 * (gap_m - 0.02)), rel=0.15)
    behind = [round(math.degrees(b)) for b in reading.bearings_rad].index(180)
    assert reading.ranges_m[behind] == reading.max_range_m == 0.20
    assert len(reading.raw) == len(reading.ranges_m) == 9


def test_sonar_sees_walls_and_the_sensor():
    world = simulation(robots={"agent1": robot(1.0, 0.0, math.pi)}, sensors={"sensor": SensorSettings()})
    reading = world.sample("agent1", "sonar")
    assert isinstance(reading, Sonar)
    by_degree = dict(zip((90, 45, 0, -45, -90), reading.ranges_m, strict=True))
    assert by_degree[0] == pytest.approx(1.0 - 0.065 - 0.06, abs=0.001)
    assert by_degree[90] == pytest.approx(2.0 - 0.065, abs=0.001)  # the wall at y = -2, seen from (1, 0)


def test_noise_is_small_and_comes_from_the_seed():
    def sweep(seed):
        world = simulation(
            seed, robots={"agent1": robot(1.0, 0.0, math.pi)}, sensors={"s": SensorSettings()}, noise=NoiseSettings()
        )
        return world.sample("agent1", "sonar").ranges_m[2]

    assert sweep(1) == sweep(1)
    assert sweep(1) != sweep(2)
    assert sweep(1) == pytest.approx(0.875, abs=0.03)


def test_the_motion_sensor_notices_what_moves():
    mover = MoverSettings(1.0, 0.0, waypoints=((2.0, 0.0),), starts_s=1.0, max_pause_s=0.0)
    world = simulation(sensors={"sensor": SensorSettings()}, movers={"mover": mover})
    assert world.sample("sensor", "motion") == Motion(False)
    world.advance(1.5)
    assert world.sample("sensor", "motion") == Motion(True)


def test_a_motion_sensor_that_locates_says_where():
    locating = MotionSettings(locates=True, bearing_noise_rad=0.0, range_noise_m=0.0)
    mover = MoverSettings(0.0, 1.5, waypoints=((2.0, 1.5),))
    world = simulation(
        sensors={"sensor": SensorSettings(theta_rad=math.pi / 2, motion=locating)}, movers={"mover": mover}
    )
    world.advance(0.05)
    reading = world.sample("sensor", "motion")
    assert reading.bearing_rad == pytest.approx(0.0, abs=0.02)
    assert reading.range_m == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize(
    ("motion", "seen"),
    [
        (MotionSettings(range_m=0.5), False),
        (MotionSettings(field_of_view_rad=1.0), False),
        (MotionSettings(least_speed_mps=0.5), False),
        (MotionSettings(), True),
    ],
)
def test_a_motion_sensor_sees_within_its_range_its_field_of_view_and_what_is_fast_enough(motion, seen):
    mover = MoverSettings(-1.0, 0.0, waypoints=((-1.5, 0.0),))
    world = simulation(sensors={"sensor": SensorSettings(motion=motion)}, movers={"mover": mover})
    world.advance(0.5)
    assert world.sample("sensor", "motion").detected is seen


@pytest.mark.parametrize("sees_robots", [True, False])
def test_whether_robots_count_as_motion_is_a_setting(sees_robots):
    sensor = SensorSettings(motion=MotionSettings(sees_robots=sees_robots))
    world = simulation(robots={"agent1": robot(0.5, 0.0)}, sensors={"sensor": sensor})
    world.drive("agent1", Wheels(0.1, 0.1), 10.0, "x")
    world.advance(0.5)
    assert world.sample("sensor", "motion").detected is sees_robots


def test_pose_and_battery_are_told():
    world = simulation(robots={"agent1": robot(0.5, 0.25, 1.0)})
    assert world.sample("agent1", "pose") == Pose(0.5, 0.25, 1.0)
    reading = world.sample("agent1", "battery")
    assert isinstance(reading, Battery)
    assert reading.voltage_v == pytest.approx(8.4, abs=0.01)


def test_sampling_and_sending_drain_the_battery():
    greedy = BatterySettings(capacity_j=100.0, idle_w=0.0, packet_j=1.0, sample_j={"ir": 1.0})
    world = simulation(robots={"agent1": robot(0.0, 0.0, battery=greedy)})
    for _ in range(10):
        world.sample("agent1", "ir")
    world.packets_sent("agent1", 20)
    assert body(world, "agent1").battery_v == pytest.approx(6.6 + 0.7 * 1.8)


# What it refuses ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "device", "model", "sentence"),
    [
        ("agent9", "motors", "khepera3", "has no robot 'agent9', only agent1, big"),
        ("agent1", "motors", "pioneer3dx", "agent1 is a khepera3 in the simulated world.*'pioneer3dx'"),
        ("sensor", "battery", "", "has no robot 'sensor'"),
        ("agent1", "motion", "", "has no sensor node 'agent1', only sensor"),
        ("big", "ir", "", "big is a pioneer3dx, which has no infrared sensors"),
        ("agent1", "gas", "", "no device of the type 'gas'"),
        ("nobody", "pose", "", "has no body 'nobody'"),
    ],
)
def test_a_device_that_cannot_be_gets_a_sentence(name, device, model, sentence):
    world = simulation(
        robots={"agent1": robot(0.0, 1.0), "big": robot(1.0, 1.0, model="pioneer3dx")},
        sensors={"sensor": SensorSettings()},
    )
    with pytest.raises(PancakesError, match=sentence):
        world.check(name, device, model)


def test_all_mistakes_in_the_settings_are_told():
    problems = check_settings(
        ContentSettings,
        {"robots": {"a": {"x_m": 0.0, "model": "kephera3"}}, "arena": {"width_m": -1.0}, "sensor": {}},
    )
    text = "\n".join(str(problem) for problem in problems)
    assert "robots.a.y_m: is missing" in text
    assert "arena.width_m" in text
    assert "sensor: unknown key, did you mean 'sensors'?" in text


def test_a_model_that_is_not_there_is_a_mistake_in_the_settings():
    with pytest.raises(SettingsError, match="no robot model 'kephera3'.*did you mean 'khepera3'"):
        make_settings(ContentSettings, {"robots": {"a": {"x_m": 0.0, "y_m": 0.0, "model": "kephera3"}}})


def test_two_bodies_of_one_name_and_bodies_outside_are_refused():
    with pytest.raises(ValueError, match="several bodies of the name 'a'"):
        ContentSettings(robots={"a": robot(0.0, 0.0)}, sensors={"a": SensorSettings()})
    with pytest.raises(ValueError, match="a stands outside the arena"):
        ContentSettings(arena=ArenaSettings(2.0, 2.0), robots={"a": robot(1.5, 0.0)})


# The whole ------------------------------------------------------------------------------------------------------


def test_collisions_are_told_with_time_and_names():
    world = simulation(robots={"agent1": robot(0.0, 0.0), "agent2": robot(0.5, 0.0)})
    world.drive("agent1", Wheels(0.1, 0.1), 10.0, "x")
    world.advance(8.0)
    (incident,) = world.take_incidents()
    assert (incident.kind, incident.names) == ("collision", ("agent1", "agent2"))
    assert incident.time_s == pytest.approx(3.7, abs=0.1)


def test_the_state_lists_robots_then_sensors_then_movers():
    bodies = paper_world().state().bodies
    assert [(one.name, one.kind) for one in bodies] == [
        ("agent1", "robot"),
        ("agent2", "robot"),
        ("sensor", "sensor"),
        ("mover", "mover"),
    ]
    assert [one.battery_v is None for one in bodies] == [False, False, True, True]


def circle(world, duration_s):
    wheels = KHEPERA_III.drive.wheels(Twist(0.1, 0.1 / 0.55))
    states = []
    for step in range(round(duration_s / 0.1)):
        world.drive("agent1", wheels, 0.5, "agent1/client/ScanTarget")
        world.advance((step + 1) * 0.1)
        world.sample("agent1", "ir")
        states.append(world.state())
    return states


def test_the_same_seed_repeats_itself_and_another_does_not():
    assert circle(paper_world(7), 20.0) == circle(paper_world(7), 20.0)
    assert circle(paper_world(7), 20.0) != circle(paper_world(8), 20.0)


def test_how_often_a_sensor_is_asked_does_not_change_where_the_mover_goes():
    asked, left_alone = paper_world(3), paper_world(3)
    for step in range(100):
        asked.advance(0.1 * (step + 1))
        asked.sample("agent1", "ir")
    left_alone.advance(10.0)
    assert body(asked, "mover") == body(left_alone, "mover")


def test_a_mission_of_five_minutes_is_simulated_in_seconds():
    began_s = time.process_time()
    states = circle(paper_world(), 300.0)
    assert states[-1].time_s == pytest.approx(300.0)
    assert time.process_time() - began_s < 4.0  # about 0.7 s where nothing else runs


def test_a_laser_scanner_sees_walls_and_the_sensor():
    world = simulation(robots={"agent1": robot(1.0, 0.0, math.pi)}, sensors={"sensor": SensorSettings()})
    scan = world.sample("agent1", "laser_scan")
    assert isinstance(scan, LaserScan)
    by_bearing = {
        round(math.degrees(it)): range_m for it, range_m in zip(scan.bearings_rad(), scan.ranges_m(), strict=True)
    }
    assert by_bearing[0] == pytest.approx(1.0 - 0.06, abs=0.002)
    assert by_bearing[90] == pytest.approx(2.0, abs=0.002)  # the wall at y = -2, seen from (1, 0)
    assert max(scan.ranges_m()) <= scan.max_range_m == 4.0
    assert len(scan.ranges_mm) == 228


def test_encoders_count_what_the_wheels_roll_in_whole_ticks():
    world = simulation(robots={"agent1": robot(0.0, 0.0)})
    assert world.sample("agent1", "encoders") == Encoders(("left", "right"), (0.0, 0.0), (0.0, 0.0))
    world.drive("agent1", Wheels(0.1, -0.05), 1.0, "agent1/client/T")
    world.advance(0.5)
    under_way = world.sample("agent1", "encoders")
    world.advance(3.0)
    stands = world.sample("agent1", "encoders")
    radius_m, tick_rad = 0.0205, math.tau / 2764
    assert under_way.angles_rad == pytest.approx((0.05 / radius_m, -0.025 / radius_m), abs=tick_rad)
    assert under_way.speeds_radps == pytest.approx((0.1 / radius_m, -0.05 / radius_m), rel=1e-3)
    assert stands.angles_rad == pytest.approx((0.1 / radius_m, -0.05 / radius_m), abs=tick_rad)
    assert stands.speeds_radps == (0.0, 0.0)
    assert all(angle / tick_rad == pytest.approx(round(angle / tick_rad)) for angle in stands.angles_rad)


def built(model):
    disc = Disc("agent1", model.radius_m, 0.0, 0.0, 0.0, model.mass_kg)
    return Robot(model, disc, BatteryModel(BatterySettings(), model.full_v, model.empty_v), 0.0, lambda: 0.0)


def test_encoders_turn_by_the_same_however_the_steps_are_grouped():
    turned = []
    for groups in ([1] * 70, [70], [3, 67]):
        robot = built(KHEPERA_III)
        for speed_mps in (0.1, 0.07):
            robot.drive(Wheels(speed_mps, -speed_mps), math.inf, "agent1/client/T")
            for steps in groups:
                robot.rolls(steps, 0.01)
        turned.append(robot.turned_m())
    assert turned[0] == turned[1] == turned[2]
    assert turned[0] == pytest.approx((0.119, -0.119), rel=1e-2)


def test_a_robot_without_a_scanner_or_encoders_says_so():
    found = built(replace(KHEPERA_III, laser=None, encoders=None))
    for ask, what in ((found.laser_scanner, "laser scanner"), (found.wheel_encoders, "wheel encoders")):
        with pytest.raises(PancakesError, match=f"agent1 is a khepera3, which has no {what}"):
            ask()
