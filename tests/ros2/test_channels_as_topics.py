"""The service `ros2`: an agent's channels as topics, its log on /rosout, its tasks as nodes."""

import math
import random
import subprocess

from pancakes_ros2.ros_message import RosMessage
from ros2.environments import AGENTS, environment, python_of

from pancakes.client import Client
from pancakes.devices import Infrared, Pose, Temperature

DESK = """
[service.ros2]
type = "ros2"
[service.ros2.settings]
tasks = true
[[service.ros2.settings.topics]]
topic = "pose"
message = "geometry_msgs/PoseStamped"
packet = "pose"
frame = "map"
include_remote = true
max_hz = 1000
[[service.ros2.settings.topics]]
topic = "ir"
message = "sensor_msgs/Range"
packet = "ir"
include_remote = true
[[service.ros2.settings.topics]]
topic = "/force"
message = "geometry_msgs/Wrench"
channel = "ros"
include_remote = true
[[service.ros2.settings.topics]]
topic = "words"
message = "std_msgs/String"
channel = "ros"
direction = "in"
[[service.ros2.settings.topics]]
topic = "oven"
message = "std_msgs/Float64"
packet = "temperature"
direction = "in"
fields = { data = "celsius" }
[[service.ros2.settings.topics]]
topic = "lost"
message = "no_such_msgs/Thing"
[[service.ros2.settings.topics]]
topic = "wrong"
message = "std_msgs/String"
packet = "posse"
[task.PoseSharing]
type = "encirclement.PoseSharing"
[task.BatteryWatchdog]
type = "encirclement.BatteryWatchdog"
settings = { below = 0.9, slow = { "client/PoseSharing" = 1.0 } }
[device.battery]
driver = "null.battery"
[device.pose]
driver = "static.pose"
rate_hz = 10
settings = { x_m = 1.0, y_m = 2.0 }
"""
POSE, RANGE, WRENCH = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/Range", "geometry_msgs/msg/Wrench"
STRING, NUMBER, LOG = "std_msgs/msg/String", "std_msgs/msg/Float64", "rcl_interfaces/msg/Log"


def test_channels_are_topics_and_topics_are_packets(start_agent, peer):
    agent = start_agent("desk", DESK)
    peer.listen("/desk/pose", POSE)
    peer.listen("/desk/ir_1", RANGE)
    peer.listen("/force", WRENCH)
    peer.listen("/rosout", LOG, latched=True, depth=1000)
    draw = random.Random(1).uniform
    with Client() as client:
        peer.heard("/desk/pose", lambda it: it["pose"]["position"]["y"] == 2.0)  # that of the desk itself
        for _ in range(20):
            pose = Pose(draw(-9.0, 9.0), draw(-9.0, 9.0), draw(-3.0, 3.0))
            heard = peer.heard_at_last(
                lambda pose=pose: client.publish("desk/system", pose),
                "/desk/pose",
                lambda it, x_m=pose.x_m: it["pose"]["position"]["x"] == x_m,
            )
            turned = {"z": math.sin(pose.theta_rad / 2), "w": math.cos(pose.theta_rad / 2)}
            wanted = {"position": {"x": pose.x_m, "y": pose.y_m}, "orientation": turned}
            header = heard["message"]["header"]
            assert header["frame_id"] == "map"
            peer.order("serialise", type=POSE, fields={"header": header, "pose": wanted})
            assert peer.told.wait(lambda line: "serialised" in line)["serialised"] == heard["bytes"]
        # Its topics are there with the first packet: what is said before the peer has found them, it does not hear.
        infrared = Infrared((0.0, 0.5), (0.1, 0.25), 0.5)
        seen = peer.heard_at_last(lambda: client.publish("desk/system", infrared), "/desk/ir_1")["message"]
        assert (seen["radiation_type"], seen["max_range"], seen["header"]["frame_id"]) == (1, 0.5, "desk/ir_1")
        client.publish("desk/ros", RosMessage("geometry_msgs/Wrench", {"force": {"x": 3}}))
        assert peer.heard("/force")["message"]["force"] == {"x": 3.0, "y": 0.0, "z": 0.0}
        with client.subscribe("desk/ros", timeout_s=20.0) as packets:
            peer.order("publish", topic="/desk/words", type=STRING, fields={"data": "hello"}, every_s=0.1)
            assert next(iter(packets)).body == RosMessage("std_msgs/msg/String", {"data": "hello"})
        with client.subscribe("desk/system", "temperature", timeout_s=20.0) as packets:
            peer.order("publish", topic="/desk/oven", type=NUMBER, fields={"data": 180.0}, every_s=0.1)
            assert next(iter(packets)).body == Temperature(180.0)
        client.publish("desk/ros", RosMessage("geometry_msgs/Wrench", {"force": {"x": "far"}}))
        client.publish("desk/system", Pose(math.nan, 0.0, 0.0))
    agent.wait_for_line("'far' does not fit the field 'force.x', which is a double")
    agent.wait_for_line("a packet 'pose' does not become a message of pose: the pose is not finite")
    agent.wait_for_line("there is no message type no_such_msgs/msg/Thing: the package no_such_msgs is not installed")
    agent.wait_for_line("topic 'wrong': there is no packet type 'posse', did you mean 'pose'?")
    said = peer.ever_heard("/rosout", lambda it: "did you mean 'pose'?" in it["msg"])["message"]
    assert (said["level"], said["name"]) == (40, "desk/ros2")


def test_a_task_has_parameters_and_a_life_cycle(start_agent, peer):
    start_agent("desk", DESK)
    task = "/desk/BatteryWatchdog"

    def asked(service, kind, **request):
        peer.order("call", service=f"{task}/{service}", type=f"lifecycle_msgs/srv/{kind}", request=request)
        return peer.answer(f"{task}/{service}")

    def parameters(**order):
        peer.order("parameters", node=task, **order)
        return peer.answer(task)

    assert asked("get_state", "GetState")["current_state"]["label"] == "active"
    peer.sees(task)
    assert parameters()["result"]["names"] == ["below", "slow.client/PoseSharing"]
    changed = parameters(set={"below": 0.5, "slow.client/PoseSharing": 2.0})["results"]
    assert [(it["successful"], it["reason"]) for it in changed] == [(True, ""), (True, "")]
    values = parameters(get=["below", "slow.client/PoseSharing", "none"])["values"]
    assert [(it["type"], it["double_value"]) for it in values] == [(3, 0.5), (3, 2.0), (0, 0.0)]
    (refused,) = parameters(set={"below": "half"})["results"]
    assert not refused["successful"] and "below: expected a number" in refused["reason"]
    peer.listen(f"{task}/transition_event", "lifecycle_msgs/msg/TransitionEvent")
    assert asked("change_state", "ChangeState", transition={"id": 4})["success"]
    event = peer.heard(f"{task}/transition_event", lambda it: it["goal_state"]["label"] == "inactive")
    assert event["message"]["goal_state"]["id"] == 2
    assert not asked("change_state", "ChangeState", transition={"id": 4})["success"]
    assert asked("change_state", "ChangeState", transition={"label": "activate"})["success"]
    peer.heard(f"{task}/transition_event", lambda it: it["goal_state"]["label"] == "active")


def test_messages_bear_the_time_of_a_simulation_where_that_is_asked_for(start_agent, peer):
    start_agent("desk", DESK.replace("tasks = true", "use_sim_time = true"))
    peer.listen("/desk/pose", POSE)
    peer.order("publish", topic="/clock", type="rosgraph_msgs/msg/Clock", fields={"clock": {"sec": 42}}, every_s=0.1)
    peer.heard("/desk/pose", lambda it: it["header"]["stamp"] == {"sec": 42, "nanosec": 0})


CLOSES = """
import os, socket, threading
from pancakes_ros2.node_table import NODES
from pancakes_ros2.ros_node import Inlet, Outlet
from pancakes_ros2.quality import COMMAND

def sockets():
    # The addresses of all that are bound, and how many there are: Fast DDS keeps three that are not.
    names = []
    for fd in os.listdir("/proc/self/fd"):
        try:
            if os.readlink(f"/proc/self/fd/{fd}").startswith("socket:"):
                with socket.socket(fileno=os.dup(int(fd))) as it:
                    names.append(str(it.getsockname()))
        except OSError:
            pass
    return sorted(name for name in names if name != "('0.0.0.0', 0)"), len(names)

before = sockets()
for turn in range(3):
    node = NODES.take("agent1", False)
    outlet = Outlet(node, "geometry_msgs/msg/Twist", "cmd_vel", COMMAND, print, print)
    inlet = Inlet(node, "geometry_msgs/msg/Twist", "cmd_vel", COMMAND, print, print, print)
    there = threading.Event()
    node.do(lambda made: there.set())
    assert there.wait(10) and outlet.ready and sockets()[0]
    outlet.close()
    inlet.close()
    NODES.give_back("agent1")
    assert node.join(10)
    assert sockets()[0] == before[0] and sockets()[1] <= before[1] + 3, sockets()
print("closed")
"""


def test_no_socket_stays_open(domain):
    done = subprocess.run(
        [str(python_of(AGENTS)), "-c", CLOSES], env=environment(domain), capture_output=True, text=True, timeout=60
    )
    assert (done.stdout, done.returncode) == ("closed\n", 0), done.stderr
