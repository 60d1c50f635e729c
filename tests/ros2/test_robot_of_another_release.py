"""A robot that is a node of another release of ROS 2, as the body of an agent's tasks."""

import time

from ros2.environments import ROBOTS, python_of

from pancakes.client import Client
from pancakes.control import Migrate, Stop
from pancakes.devices import Battery, Infrared, Motion, Pose, Sonar, Temperature
from pancakes.sim.world_state import WorldState
from pancakes_encirclement.packets import MotionDetected

ROBOT = """
[device.pose]
driver = "ros2.pose"
[device.motors]
driver = "ros2.motors"
hold_after_mission_s = 0.4
settings = { tell_task = "cmd_vel_task", times_out_s = 0.5 }
[device.battery]
driver = "ros2.battery"
[device.ir]
driver = "ros2.ir"
settings = { bearings_rad = [0.0, 1.57] }
[device.sonar]
driver = "ros2.sonar"
[device.motion]
driver = "ros2.motion"
[device.temperature]
driver = "ros2.temperature"
"""
SCAN = """
[task.ScanTarget]
type = "encirclement.ScanTarget"
"""
WORLD = """
[task.World]
type = "ros2.arena"
[task.World.settings]
python = "{python}"
robots = {{ agent1 = {{ x_m = 1.0, y_m = 0.0 }} }}
"""
ODOMETRY, TWIST = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"


def odometry(x_m, y_m, agent="agent1", **order):
    fields = {"pose": {"pose": {"position": {"x": x_m, "y": y_m}, "orientation": {"w": 1.0}}}}
    return {"topic": f"/{agent}/odom", "type": ODOMETRY, "fields": fields, **order}


def test_all_its_sensors_are_read(start_agent, peer):
    start_agent("agent1", ROBOT)
    sent = {
        "odom": (ODOMETRY, odometry(1.5, -0.5)["fields"]),
        "battery_state": ("sensor_msgs/msg/BatteryState", {"percentage": 0.5, "voltage": 12.0}),
        "ir_0": ("sensor_msgs/msg/Range", {"range": 0.25, "max_range": 0.5}),
        "ir_1": ("sensor_msgs/msg/Range", {"range": float("inf"), "max_range": 0.5}),
        "sonar": ("sensor_msgs/msg/LaserScan", {"angle_increment": 0.5, "range_max": 4.0, "ranges": [1.0, 5.0]}),
        "motion": ("std_msgs/msg/Bool", {"data": True}),
        "temperature": ("sensor_msgs/msg/Temperature", {"temperature": 21.5}),
    }
    with Client() as client, client.subscribe("agent1/system", timeout_s=20.0) as packets:
        for topic, (kind, fields) in sent.items():
            peer.order("publish", topic=f"/agent1/{topic}", type=kind, fields=fields, every_s=0.1)
        read = {}
        for packet in packets:
            read[packet.type] = packet.body
            if len(read) == 6:
                break
    assert read == {
        "pose": Pose(1.5, -0.5, 0.0),
        "battery": Battery(12.0, 0.5),
        "ir": Infrared((0.0, 1.57), (0.25, 0.5), 0.5),
        "sonar": Sonar((0.0, 0.5), (1.0, 4.0), 4.0),
        "motion": Motion(True),
        "temperature": Temperature(21.5),
    }


def test_one_sensor_of_a_ring_that_measures_nothing_costs_no_sweep(start_agent, peer):
    start_agent("agent1", ROBOT)
    fields = {"ir_0": {"range": 0.25, "max_range": 0.5}, "ir_1": {"range": float("nan"), "max_range": 0.5}}
    with Client() as client, client.subscribe("agent1/system", timeout_s=20.0) as packets:
        for topic, told in fields.items():
            peer.order("publish", topic=f"/agent1/{topic}", type="sensor_msgs/msg/Range", fields=told, every_s=0.1)
        peer.order(
            "publish",
            topic="/agent1/battery_state",
            type="sensor_msgs/msg/BatteryState",
            fields={"percentage": 87.0, "voltage": 12.0},
            every_s=0.1,
        )
        sweeps = [packet.body for _, packet in zip(range(5), packets, strict=False)]
    assert sweeps == [Infrared((0.0,), (0.25,), 0.5)] * 5, "and no level of 87 is told as full"


def drive(peer, client):
    """Lets ScanTarget drive, at a place where it has something to go round; returns its first command."""
    peer.listen("/agent1/cmd_vel", TWIST)
    peer.order("publish", **odometry(1.0, 0.0, every_s=0.05))
    client.publish("agent1/system", MotionDetected(0.0, 0.0))
    return peer.heard("/agent1/cmd_vel", lambda it: it["linear"]["x"] > 0.0)


def stands(message):
    """Returns whether a robot was told to stand still."""
    return message["linear"]["x"] == message["angular"]["z"] == 0.0


def test_its_wheels_follow_a_task_and_stand_still_when_it_stops(start_agent, peer):
    start_agent("agent1", ROBOT + SCAN)
    peer.listen("/agent1/cmd_vel_task", "std_msgs/msg/String", latched=True)
    with Client() as client:
        first = drive(peer, client)
        assert first["bytes"] == first["again"], "as ROS 2 itself serialises it"
        began_s = time.monotonic()
        assert client.request("agent1", Stop("ScanTarget")).ok
        assert peer.heard("/agent1/cmd_vel", stands)["at_s"] - began_s < 0.5
        said = [it for it in peer.told.all if it.get("heard") == "/agent1/cmd_vel_task"]
        while not said or said[-1]["message"]["data"]:
            said.append(peer.heard("/agent1/cmd_vel_task"))
        assert "agent1/client/ScanTarget" in [it["message"]["data"] for it in said]


def test_at_a_hand_over_one_robot_stands_and_the_other_drives(start_agent, peer):
    start_agent("agent1", ROBOT + SCAN)
    start_agent("agent2", 'peers = ["local://agent1"]\n' + ROBOT)
    peer.listen("/agent2/cmd_vel", TWIST)
    peer.order("publish", **odometry(-1.0, 0.0, "agent2", every_s=0.05))
    with Client() as client:
        drive(peer, client)
        began_s = time.monotonic()
        assert client.request("agent1", Migrate("ScanTarget", to="agent2")).ok
        answered_s = time.monotonic()
        stood = peer.heard("/agent1/cmd_vel", stands)
        assert began_s < stood["at_s"] < answered_s + 0.5
        client.publish("agent2/system", MotionDetected(0.0, 0.0))
        drives = peer.heard("/agent2/cmd_vel", lambda it: it["linear"]["x"] > 0.0)
        assert drives["at_s"] > stood["at_s"]


def test_an_agent_that_ends_lets_the_robot_stand(start_agent, peer):
    agent = start_agent("agent1", ROBOT + SCAN)
    with Client() as client:
        drive(peer, client)
    began_s = time.monotonic()
    assert agent.stop() == 0
    assert peer.heard("/agent1/cmd_vel", stands)["at_s"] - began_s < 0.5


def test_an_agent_that_is_killed_leaves_a_robot_that_stops_by_itself(start_agent, domain):
    start_agent("world", WORLD.format(python=python_of(ROBOTS)))
    agent = start_agent("agent1", 'peers = ["local://world"]\n' + ROBOT + SCAN)
    with Client() as client, client.subscribe("world/system", WorldState, timeout_s=20.0) as states:

        def robot():
            return next(iter(states)).body.bodies[0]

        while (now := robot()).v_mps == 0.0 or now.driven_by != "ScanTarget":
            client.publish("agent1/system", MotionDetected(0.0, 0.0))
        agent.kill()
        began_s = time.monotonic()
        while robot().driven_by:
            pass
        assert time.monotonic() - began_s < 0.4 + 0.5, "its time-out, and what this machine takes to tell of it"
        assert robot().v_mps == 0.0


def test_what_is_wrong_with_a_topic_is_one_sentence_and_the_agent_goes_on(start_agent, peer):
    other_qos = 'settings = { qos = { reliability = "reliable", depth = 5 } }'
    attic = '[device.attic]\ndriver = "ros2.temperature"\nsettings = { topic = "9attic" }\n'
    agent = start_agent("agent1", ROBOT.replace('"ros2.battery"', f'"ros2.battery"\n{other_qos}') + attic)
    nan = {"pose": {"pose": {"position": {"x": float("nan")}, "orientation": {"w": 1.0}}}}
    for topic, kind, fields, order in (
        ("odom", ODOMETRY, nan, {}),
        ("temperature", "std_msgs/msg/String", {"data": "warm"}, {}),
        ("battery_state", "sensor_msgs/msg/BatteryState", {"percentage": 0.5}, {"best_effort": True}),
        ("motion", "std_msgs/msg/Bool", {"data": True}, {"every_s": 0.001}),
    ):
        peer.order("publish", **{"topic": f"/agent1/{topic}", "type": kind, "fields": fields, "every_s": 0.1, **order})
    agent.wait_for_line("a message of odom is no reading: the pose is not finite (nan, 0, 0, 0, 0, 1)")
    agent.wait_for_line("/agent1/temperature is listened to as sensor_msgs/msg/Temperature, but /peer publishes")
    agent.wait_for_line("a node that publishes /agent1/battery_state has another QoS (reliability)")
    agent.wait_for_line("more readings come on motion than the 100 a second that are published")
    agent.wait_for_line("ROS 2 refuses it: Invalid topic name: topic name token must not start with a number")
    agent.wait_for_line("no node publishes /agent1/sonar: start the robot's nodes")
    with Client() as client, client.subscribe("agent1/system", "motion", timeout_s=20.0) as packets:
        assert next(iter(packets)).body.detected
    assert agent.lines().count("the pose is not finite") == 1
