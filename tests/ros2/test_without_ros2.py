"""What needs no ROS 2: settings, the table of topics, parameters, life cycles; and what is said where there is none."""

import math
import re
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from devices.driver_context import DriverContext
from pancakes_ros2.arena import environment_for
from pancakes_ros2.arena_clock import Beginning
from pancakes_ros2.demos import as_simulated
from pancakes_ros2.installation import checked_type, ros_name
from pancakes_ros2.lifecycle_states import ACTIVATING, ACTIVE, INACTIVE, request_for, state_of
from pancakes_ros2.newest import Newest
from pancakes_ros2.parameter_values import changes_of, flat, type_of
from pancakes_ros2.ros2_service import Ros2Service
from pancakes_ros2.ros_motors import RosMotors
from pancakes_ros2.ros_node import silence_of
from pancakes_ros2.ros_sensors import (
    RosCamera,
    RosEncoders,
    RosGpsFix,
    RosImu,
    RosInfrared,
    RosLaserScan,
    RosPose,
    RosPose3D,
)
from pancakes_ros2.task_node import TaskView
from pancakes_ros2.task_nodes import place_of
from pancakes_ros2.topic_row import TopicRow

from pancakes.config import load
from pancakes.control import Start, Stop
from pancakes.devices import Motion
from pancakes.errors import PancakesError
from pancakes.packet import body_class
from pancakes.settings import SettingsError, check_settings, make_settings
from pancakes.supervision.lifecycle import State
from pancakes.tools.cli.main import pancakes as program
from pancakes.tools.demo import Run
from pancakes.util.plugins import Plugins

ODOMETRY = "nav_msgs/msg/Odometry"


def refusal(cls, **settings):
    return "; ".join(str(problem) for problem in check_settings(cls, settings))


def test_without_ros_2_a_device_says_what_to_do():
    driver = RosPose(DriverContext(), make_settings(RosPose.Settings, {}))
    with pytest.raises(PancakesError, match="this Python has no ROS 2, .*: source the setup file"):
        driver.open()
    driver.close()


@pytest.mark.parametrize("name", ["red-robot", "7", "_hidden", "a__b", "a-b_c"])
def test_an_agent_whose_name_is_none_in_ros_2_is_refused(name):
    context = DriverContext(name)
    for cls in (RosPose, RosMotors):
        driver = cls(context, make_settings(cls.Settings, {}))
        with pytest.raises(PancakesError, match=f"the agent {name} cannot be a node of ROS 2, .* such as "):
            driver.open()
        driver.close()


def test_tasks_that_would_be_one_node_have_one_place():
    views = [TaskView("client", name, ACTIVE) for name in ("scan-left", "scan_left", "pancakes")]
    assert [place_of("a", view) for view in views] == [("/a", "scan_left"), ("/a", "scan_left"), ("/a", "pancakes")]
    assert place_of("a", TaskView("sensing", "scan-left", ACTIVE)) == ("/a/sensing", "scan_left")


def test_in_virtual_time_a_device_refuses():
    context = DriverContext()
    context.virtual = True
    driver = RosMotors(context, make_settings(RosMotors.Settings, {}))
    with pytest.raises(PancakesError, match="agent1 lives in virtual time, where no robot of ROS 2 can follow it"):
        driver.open()
    driver.safe_stop()
    driver.close()


def test_in_virtual_time_the_service_refuses(fleet):
    desk = fleet.start("desk", services={"ros2": Ros2Service})
    fleet.run_for(30.0)
    assert any("desk lives in virtual time" in line for line in desk.lines("error"))


def test_a_message_type_is_named_with_or_without_its_folder():
    assert checked_type("nav_msgs/Odometry") == checked_type(ODOMETRY) == ODOMETRY
    assert "no message type of ROS 2" in refusal(RosPose.Settings, message="Odometry")
    assert "no pose is read from that, but from" in refusal(RosPose.Settings, message="std_msgs/msg/Bool")
    assert refusal(RosPose.Settings, message="geometry_msgs/PoseStamped", topic="pose") == ""


def test_a_pose_of_tf_has_two_frames():
    tf = "tf2_msgs/TFMessage"
    settings = make_settings(RosPose3D.Settings, {"message": tf, "child_frame": "agent1/base_link"})
    assert (settings.topic, settings.frame, settings.child_frame) == ("/tf", "map", "agent1/base_link")
    assert "are both 'map'" in refusal(RosPose.Settings, message=tf, child_frame="map")
    assert "set message = 'tf2_msgs/msg/TFMessage'" in refusal(RosPose.Settings, child_frame="base_link")


@pytest.mark.parametrize("cls", [RosEncoders, RosImu, RosGpsFix, RosLaserScan, RosCamera])
def test_a_sensor_is_read_from_one_message_type(cls):
    assert refusal(cls.Settings) == ""
    assert f"no {cls.type} is read from that" in refusal(cls.Settings, message="std_msgs/Bool")


def test_a_ring_has_a_scan_or_a_topic_for_each_sensor():
    assert refusal(RosInfrared.Settings, message="sensor_msgs/Range", bearings_rad=[0.0]) == ""
    assert "without these it is a" in refusal(RosInfrared.Settings, message="sensor_msgs/Range")


@pytest.mark.parametrize(
    ("name", "there"), [("agent1", "agent1"), ("red-robot", "red_robot"), ("7", "a_7"), ("a--b", "a_b")]
)
def test_names_become_names_of_ros_2(name, there):
    assert ros_name(name) == there


def row(**fields):
    return make_settings(TopicRow, {"topic": "t", "message": "std_msgs/String", **fields})


def test_a_row_that_cannot_be_is_refused():
    with pytest.raises(SettingsError, match="a device with the driver ros2.ir does so"):
        row(packet="ir", message="sensor_msgs/Range", direction="in")
    with pytest.raises(SettingsError, match="name another type"):
        row(fields={"data": "text"})
    with pytest.raises(SettingsError, match="direction: expected one of 'out', 'in'"):
        row(direction="both")
    assert body_class("pose") is not None
    with pytest.raises(PancakesError, match="there is no packet type 'posse', did you mean 'pose'"):
        row(packet="posse").check_packet()


class Text:
    """A message with a nested one, as ROS 2 generates them."""

    def __init__(self, data="", count=0):
        self.data, self.count = data, count

    @classmethod
    def get_fields_and_field_types(cls):
        return {"data": "string", "count": "int32"}


def test_fields_of_other_names_are_mapped_both_ways():
    mapped = row(packet="temperature", fields={"count": "celsius"})
    assert mapped.read(Text(count=21)).celsius == 21.0
    with pytest.raises(PancakesError, match=r"celsius is not finite \(nan\)"):
        mapped.read(Text(count=math.nan))
    made = Text()
    row(packet="motion", fields={"data": "detected"}).write(made, Motion(True), (0, 0, ""), 0)
    assert made.data is True


def test_a_message_without_a_packet_type_is_a_packet_with_its_fields():
    body = row().read(Text("hello", 2))
    assert (body.type, body.fields) == ("std_msgs/msg/String", {"data": "hello", "count": 2})
    made = Text()
    row().write(made, body, (0, 0, ""), 0)
    assert (made.data, made.count) == ("hello", 2)
    with pytest.raises(PancakesError, match="no field 'datum', only data, count"):
        row().write(made, type(body)("std_msgs/String", {"datum": 1}), (0, 0, ""), 0)
    with pytest.raises(PancakesError, match="the packet is a std_msgs/Bool, the topic has std_msgs/msg/String"):
        row().write(made, type(body)("std_msgs/Bool", {}), (0, 0, ""), 0)


def test_what_waits_is_bounded_counted_and_wakes_its_taker_once():
    woken: list[int] = []
    newest: Newest[int] = Newest(2, lambda: woken.append(1))
    for number in range(5):
        newest.put(number)
    assert newest.take() == ([3, 4], 3)
    assert woken == [1]
    newest.put(5)
    assert (newest.take(), woken) == (([5], 0), [1, 1])


SETTINGS: dict[str, Any] = {
    "below": 0.9,
    "slow": {"a": 1.0, "b": 2},
    "places": [1, 2.5],
    "names": ["x"],
    "odd": [1, "x"],
    "none": None,
}


def test_settings_are_parameters_with_flat_names():
    assert flat(SETTINGS) == {
        "below": 0.9,
        "slow.a": 1.0,
        "slow.b": 2,
        "places": [1, 2.5],
        "names": ["x"],
    }
    values: tuple[Any, ...] = (True, 1, 1.0, "", [True], [1], [1, 2.0], [""], {})
    assert list(map(type_of, values)) == [1, 2, 3, 4, 6, 7, 8, 9, 0]


def test_a_parameter_in_a_table_changes_the_table_as_a_whole():
    assert changes_of(SETTINGS, {"slow.a": 3.0, "below": 0.5}) == {"slow": {"a": 3.0, "b": 2}, "below": 0.5}
    assert changes_of(SETTINGS, {"new.a": 3.0}) == {"new": {"a": 3.0}}
    assert SETTINGS["slow"] == {"a": 1.0, "b": 2}


def test_a_life_is_that_of_a_managed_node():
    assert {state: state_of(state).label for state in State} == {
        State.STOPPED: "inactive",
        State.REFUSED: "inactive",
        State.ASKED: "activating",
        State.CALLED_OFF: "inactive",
        State.STARTING: "activating",
        State.RUNNING: "active",
        State.STOPPING: "deactivating",
        State.STUCK: "deactivating",
        State.RESTARTING: "activating",
        State.FAILED: "inactive",
    }
    assert request_for(3, "", INACTIVE, "client/A") == Start("client/A")
    assert request_for(0, "deactivate", ACTIVE, "client/A") == Stop("client/A")
    assert request_for(3, "", ACTIVE, "client/A") is None
    assert request_for(4, "", ACTIVATING, "client/A") is None


def test_the_reason_of_a_silence_is_told():
    assert "no node publishes /odom" in silence_of("/odom", ODOMETRY, [])
    assert "but /robot publishes x/msg/Y" in silence_of("/odom", ODOMETRY, [("/robot", "x/msg/Y")])
    assert silence_of("/odom", ODOMETRY, [("/robot", ODOMETRY)]) == "/robot publishes /odom, but says nothing"


def test_another_release_does_not_get_what_this_one_put_into_the_environment():
    ours = {
        "AMENT_PREFIX_PATH": "/opt/ros/kilted",
        "LD_LIBRARY_PATH": "/opt/ros/kilted/lib",
        "PYTHONPATH": "/opt/ros/kilted/lib/python3.12/site-packages:/home/me/pancakes",
        "ROS_DOMAIN_ID": "7",
    }
    assert environment_for(ours, "/venv/bin/python") == {"PYTHONPATH": "/home/me/pancakes", "ROS_DOMAIN_ID": "7"}
    assert environment_for(ours, "") == ours


def test_the_arena_knows_the_mission_time():
    beginning = Beginning(2.0, 100.0, 4.0)
    assert [beginning.mission_at(host_s) for host_s in (0.0, 100.0, 101.0)] == [0.0, 2.0, 6.0]


def test_the_demo_runs_live_alone_and_the_list_says_so():
    there = CliRunner().invoke(program, ["demo", "--list"])
    assert any(line.startswith("ros2 ") and line.endswith("(live only)") for line in there.output.splitlines())
    refused = CliRunner().invoke(program, ["demo", "ros2", "--virtual"])
    assert refused.exit_code == 2
    assert "the demo 'ros2' runs only live: robots of ROS 2 do not live in virtual time" in refused.output


def test_the_verdict_knows_the_arena_as_a_world():
    configs = {"world": {"tasks": {"World": {"type": "ros2.arena"}, "Other": {"type": "x"}}}, "agent1": {}}
    seen = as_simulated(Run(Path(), 1, 1.0, 1.0, "", configs)).configs
    assert seen == {
        "world": {"tasks": {"World": {"type": "sim.world"}, "Other": {"type": "x"}}},
        "agent1": {"tasks": {}},
    }


def test_the_configurations_of_the_guide_are_good(tmp_path):
    guide = (Path(__file__).parents[2] / "docs" / "ros2.md").read_text()
    blocks = re.findall(r"```toml\n(.*?)```", guide, re.DOTALL)
    assert len(blocks) == 4
    file = tmp_path / "agent1.toml"
    file.write_text("\n".join(blocks).replace(blocks[2], blocks[2].partition("\n\n")[2]))  # it has the table too
    config = load(str(file), (), Plugins())
    assert set(config.devices) == {"pose", "motors", "battery", "ir", "place"}
    rows = make_settings(Ros2Service.Settings, config.services["ros2"].settings).topics
    assert [(it.direction, it.message) for it in rows] == [
        ("out", "geometry_msgs/msg/PoseStamped"),
        ("in", "geometry_msgs/msg/Point"),
        ("in", "diagnostic_msgs/msg/DiagnosticArray"),
        ("out", "tf2_msgs/msg/TFMessage"),
    ]
