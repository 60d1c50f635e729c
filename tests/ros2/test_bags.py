"""Recordings as rosbag2 bags, and bags as recordings; the counterpart is `rosbags`, without a ROS 2."""

import json
import math
import resource
import sqlite3
import sys
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from devices.jpegs import jpeg
from recording.files import written
from replay.runs_again import run_again

from pancakes.config import parse
from pancakes.devices import (
    Battery,
    CameraFrame,
    Encoders,
    GpsFix,
    Imu,
    Infrared,
    LaserScan,
    Load,
    Motion,
    Pose,
    Pose3D,
    Sonar,
    Temperature,
    Twist,
)
from pancakes.events import Event, LogLine
from pancakes.packet import Packet, type_name
from pancakes.recording.reader import RecordingReader
from pancakes.recording.records import RecordedPacket, RecordingError
from pancakes.simulation.fleet import registered
from pancakes.task import Task, on
from pancakes.tools.replay.replay import Selection, tally_of
from pancakes.tools.replay.virtual_replay import VirtualReplay

pytest.importorskip("rosbags")

from pancakes_ros2.bag_export import BagExport
from pancakes_ros2.bag_messages import empty, to_bytes, typestore
from pancakes_ros2.conversion import CONVERSIONS
from pancakes_ros2.message_fields import Moment, not_read
from pancakes_ros2.rosbag_command import rosbag
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

BEGIN_NS = 1_700_000_000_000_000_000
TENTH_NS = 100_000_000
HALF = math.sqrt(0.5)
READINGS = {
    "battery": Battery(12.5, 0.75),
    "eye": CameraFrame(jpeg(320, 240), "camera"),
    "wheels": Encoders(("left", "right"), (1.5, -2.0), (0.25, 0.5)),
    "gps": GpsFix(52.5, 13.4, 34.0, 1.5, 2.5, "antenna"),
    "imu": Imu((0.0, 0.0, 0.125), (0.0, 0.0, 9.75), (0.0, 0.0, HALF, HALF), "imu_link"),
    "ir": Infrared((-0.5, 0.0, 0.5), (0.125, 0.5, 0.25), 0.5),
    "laser": LaserScan(-1.5, 0.5, (1000, 0, 4000), 4.0, "laser"),
    "motion": Motion(True),
    "pose": Pose(1.5, -2.0, 0.5),
    "pose_3d": Pose3D("odom", 1.0, 2.0, 3.0, (0.0, 0.0, HALF, HALF)),
    "sonar": Sonar((-0.5, 0.0, 0.5), (1.0, 4.0, 2.0), 4.0),
    "temperature": Temperature(21.5),
}


def entry(number, body, source, channel="system", agent="agent1"):
    packet = Packet(channel, type_name(body), source, "", number / 10, number + 1, body)
    return RecordedPacket(BEGIN_NS + number * TENTH_NS, agent, packet)


def recorded(folder, *others):
    folder.mkdir()
    entries = [entry(number, body, f"agent1/device/{name}") for number, (name, body) in enumerate(READINGS.items())]
    entries += [entry(20, Twist(0.25, -0.5), "agent1/client/Go", "ctrl"), *others]
    written(folder / "agent1.mcap", entries)
    return folder


def run(*arguments, code=0):
    done = CliRunner().invoke(rosbag, [str(it) for it in arguments], standalone_mode=False)
    if code:
        assert done.exception is not None
        return str(done.exception)
    assert done.exception is None, done.exception
    return {row["topic"]: row for row in json.loads(done.stdout)} if "json" in arguments else done.stdout


def contents(bag):
    """Return the messages of a bag by topic, as rosbags reads them."""
    found: dict[str, list[tuple[int, str, Any]]] = {}
    with AnyReader([bag], default_typestore=typestore()) as reader:
        for connection, time_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, connection.msgtype, message))
    return found


def bag_of(path, *messages, storage=StoragePlugin.MCAP):
    """Write a bag as another program would: messages are topic, type and a function that fills an empty one."""
    store = typestore()
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for number, (topic, kind, fill) in enumerate(messages):
            message = empty(store, kind)
            fill(message)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], BEGIN_NS + number * TENTH_NS, to_bytes(store, kind, message))
    return path


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_recording_is_the_same_after_a_bag(tmp_path, storage):
    recording = recorded(tmp_path / "recording")
    run("export", recording, "--out", tmp_path / "bag", "--storage", storage)
    rows = run(
        "import", tmp_path / "bag", "--out", tmp_path / "again", "--format", "json",
        "--as", "/agent1/pose_3d=pose_3d", "--as", "/agent1/sonar=sonar",
    )  # fmt: skip
    first, again = (list(RecordingReader(it).entries()) for it in (recording, tmp_path / "again"))
    assert [it.time_ns for it in again] == [it.time_ns for it in first]
    assert [it.packet.stamp_s for it in again] == pytest.approx([it.packet.stamp_s for it in first])
    for before, after in zip(first, again, strict=True):
        assert (after.agent, after.packet.channel, after.packet.type) == (
            before.agent,
            before.packet.channel,
            before.packet.type,
        )
        if before.packet.type != "motors":
            assert after.packet.source == before.packet.source
        for name in before.packet.body.__struct_fields__:
            wanted, found = getattr(before.packet.body, name), getattr(after.packet.body, name)
            assert found == wanted or found == pytest.approx(wanted), (before.packet.type, name)
    assert rows["/tf"]["why"] == "of transforms only --tf FRAME:CHILD makes poses"
    assert rows["/agent1/cmd_vel"]["packets"] == 1


def test_a_bag_has_standard_messages_on_topics_of_each_agent(tmp_path):
    said = [
        entry(30, LogLine("warning", "the lid is open"), "agent1/client/Watch", "log"),
        entry(31, Event("task_started", {"task": "Watch"}), "agent1/client", "log"),
        entry(32, Load(0.5), "agent1/device/load"),
        entry(33, Pose(9.0, 9.0, 0.0), "agent2/device/pose"),
        entry(34, Infrared((0.0, 0.5, 0.6), (0.5, 0.25, 0.5), 0.5), "agent1/device/bent"),
    ]
    rows = run("export", recorded(tmp_path / "recording", *said), "--out", tmp_path / "bag", "--format", "json")
    found = contents(tmp_path / "bag")
    kinds = {topic: messages[0][1].split("/")[-1] for topic, messages in found.items()}
    assert kinds == {
        "/agent1/battery": "BatteryState",
        "/agent1/bent_0": "Range",
        "/agent1/bent_1": "Range",
        "/agent1/bent_2": "Range",
        "/agent1/cmd_vel": "Twist",
        "/agent1/eye": "CompressedImage",
        "/agent1/gps": "NavSatFix",
        "/agent1/imu": "Imu",
        "/agent1/ir": "LaserScan",
        "/agent1/laser": "LaserScan",
        "/agent1/motion": "Bool",
        "/agent1/pose": "PoseStamped",
        "/agent1/pose_3d": "PoseStamped",
        "/agent1/sonar": "LaserScan",
        "/agent1/temperature": "Temperature",
        "/agent1/wheels": "JointState",
        "/rosout": "Log",
        "/tf": "TFMessage",
    }
    assert all(len(messages) == 1 for topic, messages in found.items() if topic != "/rosout")
    time_ns, _, pose = found["/agent1/pose"][0]
    assert pose.header.stamp.sec * 1_000_000_000 + pose.header.stamp.nanosec == time_ns
    assert (pose.header.frame_id, pose.pose.orientation.w) == ("map", pytest.approx(math.cos(0.25)))
    (step,) = found["/tf"][0][2].transforms
    assert (step.header.frame_id, step.child_frame_id, step.transform.translation.x) == ("map", "agent1", 1.5)
    texts = [(message.level, message.name, message.msg) for _, _, message in found["/rosout"]]
    assert texts == [
        (30, "agent1/client/Watch", "the lid is open"),
        (20, "agent1/client", "task_started task=Watch"),
    ]
    assert bytes(found["/agent1/eye"][0][2].data) == jpeg(320, 240)
    assert rows["/agent1/system/load"] == {
        "topic": "/agent1/system/load", "message": "", "messages": 0, "left_out": 1, "why": "no message says it",
    }  # fmt: skip


def odometry(x_m):
    def fill(message):
        message.header.frame_id = "odom"
        message.pose.pose.position.x, message.pose.pose.orientation.w = x_m, 1.0

    return ("/odom", "nav_msgs/msg/Odometry", fill)


def step(topic, parent, child, x_m):
    def fill(message):
        one = empty(typestore(), "geometry_msgs/msg/TransformStamped")
        one.header.frame_id, one.child_frame_id = parent, child
        one.transform.translation.x, one.transform.rotation.w = x_m, 1.0
        message.transforms = [one]

    return (topic, "tf2_msgs/msg/TFMessage", fill)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_bag_of_another_program_is_a_recording_of_the_agent_that_is_named(tmp_path, storage):
    def scan(message):
        message.angle_increment, message.range_max = 0.5, 4.0
        message.ranges = np.array([1.0, math.inf, math.nan], np.float32)

    bag = bag_of(
        tmp_path / "bag",
        odometry(1.0),
        ("/lidar/points", "sensor_msgs/msg/LaserScan", scan),
        step("/tf_static", "map", "odom", 10.0),
        step("/tf", "odom", "base_link", 1.5),
        ("/words", "std_msgs/msg/String", lambda message: setattr(message, "data", "hello")),
        odometry(math.nan),
        odometry(2.0),
        storage=storage,
    )
    out = tmp_path / "recording"
    rows = run("import", bag, "--out", out, "--agent", "robot", "--tf", "map:base_link", "--format", "json")
    entries = list(RecordingReader(out).entries())
    assert [(it.packet.source, it.packet.body) for it in entries] == [
        ("robot/device/odom", Pose(1.0, 0.0, 0.0)),
        ("robot/device/lidar_points", LaserScan(0.0, 0.5, (1000, 4000, 0), 4.0)),
        ("robot/device/tf", Pose3D("map", 11.5, 0.0, 0.0)),
        ("robot/device/odom", Pose(2.0, 0.0, 0.0)),
    ]
    assert [it.packet.stamp_s for it in entries] == pytest.approx([0.0, 0.1, 0.3, 0.6])
    assert rows["/words"]["why"] == "no packet is read from std_msgs/msg/String"
    assert (rows["/odom"]["packets"], rows["/odom"]["left_out"]) == (2, 1)
    assert "not finite" in rows["/odom"]["why"]


def test_what_a_topic_is_read_as_may_be_chosen(tmp_path):
    bag = bag_of(tmp_path / "bag", odometry(1.0))
    run("import", bag, "--out", tmp_path / "out", "--agent", "robot", "--as", "/odom=pose_3d")
    (only,) = RecordingReader(tmp_path / "out").entries()
    assert only.packet.body == Pose3D("odom", 1.0, 0.0, 0.0)


def test_a_bag_whose_topics_name_no_agent_wants_a_name(tmp_path):
    said = run("import", bag_of(tmp_path / "bag", odometry(1.0)), "--out", tmp_path / "out", code=1)
    assert said == "the topic /odom does not name an agent, as /AGENT/DEVICE does: name the bag's agent with --agent"
    assert not (tmp_path / "out").exists()


def torn(path):
    bag_of(path, odometry(1.0), odometry(2.0))
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-200])


def damaged(path):
    bag_of(path, odometry(1.0), storage=StoragePlugin.SQLITE3)
    (file,) = path.glob("*.db3")
    file.write_bytes(b"nothing of a data base" * 100)


def without_metadata(path):
    bag_of(path, odometry(1.0))
    (path / "metadata.yaml").unlink()


def with_bad_metadata(path):
    bag_of(path, odometry(1.0))
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")


def with_strange_metadata(path):
    bag_of(path, odometry(1.0))
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: 7\n")


def without_messages(path):
    bag_of(path)


def of_text(path):
    path.write_text("this is a letter")


def test_a_bag_that_is_damaged_further_on_says_where_its_beginning_is(tmp_path):
    bag = bag_of(tmp_path / "bag", *[odometry(float(number)) for number in range(4000)])
    (file,) = bag.glob("*.mcap")
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = b"\xff" * 3000
    file.write_bytes(data)
    said = run("import", bag, "--out", tmp_path / "out", "--agent", "robot", code=1)
    assert said.startswith(f"the bag {bag} is damaged: ")
    assert said.endswith(f"the packets before are in {tmp_path / 'out'}")
    assert len(list(RecordingReader(tmp_path / "out").entries())) > 100


def test_a_bag_of_virtual_time_is_a_recording_in_virtual_time(tmp_path):
    packets = [entry(number, Pose(1.0, 2.0, 0.5), "a/device/pose").packet for number in range(3)]
    early = [RecordedPacket(number * TENTH_NS, "a", packet) for number, packet in enumerate(packets)]
    written(tmp_path / "a.mcap", early)
    run("export", tmp_path / "a.mcap", "--out", tmp_path / "bag")
    run("import", tmp_path / "bag", "--out", tmp_path / "out")
    reader = RecordingReader(tmp_path / "out")
    assert [it.time_ns for it in reader.entries()] == [it.time_ns for it in early]
    assert reader.readings[0].about["clock"] == "mission time"


@pytest.mark.parametrize(
    "spoil",
    [torn, damaged, without_metadata, with_bad_metadata, with_strange_metadata, without_messages, of_text, None],
)
def test_what_is_no_bag_gets_a_sentence_that_names_it(tmp_path, spoil):
    path = tmp_path / "bag"
    if spoil is not None:
        spoil(path)
    done = CliRunner().invoke(
        rosbag, ["import", str(path), "--out", str(tmp_path / "out"), "--agent", "robot"], standalone_mode=False
    )
    assert type(done.exception).__name__ == "RecordingError", repr(done.exception)
    assert str(path) in str(done.exception)
    assert "\n" not in str(done.exception)


def test_a_message_that_is_cut_off_is_left_out_and_counted(tmp_path):
    store = typestore()
    topic, kind, fill = odometry(1.0)
    message = empty(store, kind)
    fill(message)
    data = to_bytes(store, kind, message)
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        writer.write(connection, BEGIN_NS, data[:40])
        writer.write(connection, BEGIN_NS + 1, data)
    rows = run("import", tmp_path / "bag", "--out", tmp_path / "out", "--agent", "robot", "--format", "json")
    assert (rows["/odom"]["packets"], rows["/odom"]["left_out"]) == (1, 1)
    assert rows["/odom"]["why"].startswith("a message cannot be read")


@pytest.mark.parametrize("topic", ["/../odom", "/a\0b/odom", "/a b/odom", f"/{'x' * 65}/odom"])
def test_a_topic_of_a_bag_names_no_file_elsewhere(tmp_path, topic):
    bag = bag_of(tmp_path / "bag", (topic, *odometry(1.0)[1:]))
    said = run("import", bag, "--out", tmp_path / "out", code=1)
    assert "is not a name" in said
    assert "name it with --agent" in said
    assert not (tmp_path / "out").exists()


def test_what_is_no_name_of_a_device_is_left_out(tmp_path):
    bag = bag_of(tmp_path / "bag", ("/a/b c\n/d", *odometry(1.0)[1:]), ("/a/odom", *odometry(2.0)[1:]))
    rows = run("import", bag, "--out", tmp_path / "out", "--format", "json")
    assert "is not a name" in rows["/a/b c\n/d"]["why"]
    assert [it.packet.source for it in RecordingReader(tmp_path / "out").entries()] == ["a/device/odom"]


def test_two_topics_never_become_one_device(tmp_path):
    bag = bag_of(tmp_path / "bag", ("/r/a/b", *odometry(1.0)[1:]), ("/r/a_b", *odometry(2.0)[1:]))
    rows = run("import", bag, "--out", tmp_path / "out", "--format", "json")
    assert rows["/r/a_b"]["why"] == "its device would have the name of that of /r/a/b"
    assert [it.packet.body.x_m for it in RecordingReader(tmp_path / "out").entries()] == [1.0]


def test_a_time_before_1970_is_left_out(tmp_path):
    bag = bag_of(tmp_path / "bag", odometry(1.0), odometry(2.0), storage=StoragePlugin.SQLITE3)
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as base:
        base.execute("update messages set timestamp = -5 where id = 1")
        base.commit()
    rows = run("import", bag, "--out", tmp_path / "out", "--agent", "robot", "--format", "json")
    assert (rows["/odom"]["packets"], rows["/odom"]["left_out"]) == (1, 1)
    assert "-5 ns" in rows["/odom"]["why"]


def test_a_type_that_the_bag_defines_otherwise_is_left_out(tmp_path):
    kind, store = "sensor_msgs/msg/NavSatFix", get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("float64 latitude\n", kind))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/robot/fix", kind, typestore=store)
        writer.write(connection, BEGIN_NS, store.serialize_cdr(store.types[kind](1.0), kind))
    said = run("import", tmp_path / "bag", "--out", tmp_path / "out", code=1)
    assert "/robot/fix: it is no sensor_msgs/msg/NavSatFix as ROS 2 defines it" in said


def test_what_no_packet_could_say_to_a_peer_is_left_out(tmp_path):
    def joints(*names):
        def fill(message):
            message.name, message.position = list(names), np.ones(len(names))

        return "/robot/joints", "sensor_msgs/msg/JointState", fill

    bag = bag_of(tmp_path / "bag", joints("", "b"), joints("x" * 65), joints("left"))
    rows = run("import", bag, "--out", tmp_path / "out", "--format", "json")
    assert (rows["/robot/joints"]["packets"], rows["/robot/joints"]["left_out"]) == (1, 2)
    assert [it.packet.body for it in RecordingReader(tmp_path / "out").entries()] == [Encoders(("left",), (1.0,))]


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_packet_that_does_not_fit_its_message_is_left_out_and_the_others_are_written(tmp_path, storage):
    far = Infrared((0.0, 0.5, 0.6), (0.1, 1e39, 0.1), 2e39)
    said = [
        entry(0, Battery(1e39, 0.5), "agent1/device/battery"),
        entry(1, far, "agent1/device/ir"),
        RecordedPacket(2**32 * 1_000_000_000, "agent1", entry(2, Pose(9.0, 9.0, 0.0), "agent1/device/late").packet),
        entry(3, Pose(1.0, 2.0, 0.5), "agent1/device/front-left"),
        entry(4, Pose(3.0, 4.0, 0.5), "agent1/device/front_left"),
    ]
    written(tmp_path / "a.mcap", said)
    rows = run("export", tmp_path / "a.mcap", "--out", tmp_path / "bag", "--storage", storage, "--format", "json")
    assert {topic: len(messages) for topic, messages in contents(tmp_path / "bag").items()} == {
        "/agent1/front_left": 1,
        "/tf": 1,
    }
    assert {topic: (row["messages"], row["left_out"]) for topic, row in rows.items()} == {
        "/agent1/front_left": (1, 0),
        "/tf": (1, 0),
        "/agent1/battery": (0, 1),
        "/agent1/ir": (0, 1),
        "/agent1/system/pose": (0, 2),
    }
    assert "float too large" in rows["/agent1/battery"]["why"]


def test_agents_that_others_heard_and_that_have_no_recording_are_listed(tmp_path):
    heard = [entry(number, Pose(1.0, 2.0, 0.5), "agent2/device/pose") for number in range(3)]
    written(tmp_path / "agent1.mcap", [*heard, entry(3, Pose(1.0, 2.0, 0.5), "agent1/device/pose")])
    rows = run("export", tmp_path / "agent1.mcap", "--out", tmp_path / "bag", "--format", "json")
    assert (rows["/agent2"]["messages"], rows["/agent2"]["left_out"]) == (0, 3)
    written(tmp_path / "agent2.mcap", [RecordedPacket(it.time_ns, "agent2", it.packet) for it in heard])
    (tmp_path / "both").mkdir()
    for name in ("agent1.mcap", "agent2.mcap"):
        (tmp_path / name).rename(tmp_path / "both" / name)
    rows = run("export", tmp_path / "both", "--out", tmp_path / "bag2", "--format", "json")
    assert {topic: row["messages"] for topic, row in rows.items()} == {"/agent1/pose": 1, "/agent2/pose": 3, "/tf": 4}


@contextmanager
def files_of_at_most(size):
    """A disk that is full, as a program sees it; modules that are imported meanwhile are not written to it."""
    before, writes_none = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = writes_none


def test_a_full_disk_gets_a_sentence(tmp_path):
    bag = bag_of(tmp_path / "bag", *[odometry(float(number)) for number in range(200)])
    with files_of_at_most(1000):
        said = run("import", bag, "--out", tmp_path / "out", "--agent", "robot", code=1)
    assert said.startswith(f"{tmp_path / 'out' / 'robot.mcap'} cannot be written: ")
    run("import", bag, "--out", tmp_path / "again", "--agent", "robot")
    for storage in ("sqlite3", "mcap"):
        place = tmp_path / storage
        with files_of_at_most(1000):
            said = run("export", tmp_path / "again", "--out", place, "--storage", storage, code=1)
        assert said.startswith(f"the bag {place} cannot be written: ")
        assert not place.exists()


def test_a_bag_that_another_program_makes_meanwhile_stays(tmp_path, monkeypatch):
    bag = bag_of(tmp_path / "bag", odometry(1.0))
    before = sorted(it.name for it in bag.iterdir())
    monkeypatch.setattr("pancakes_ros2.bag_export.os.path.lexists", lambda path: False)
    with pytest.raises(RecordingError, match="exists already"):
        BagExport().write([], bag, "sqlite3")
    assert sorted(it.name for it in bag.iterdir()) == before


def test_nothing_is_overwritten(tmp_path):
    recording = recorded(tmp_path / "recording")
    assert "is there already" in run("export", recording, "--out", recording, code=1)
    bag = bag_of(tmp_path / "bag", odometry(1.0))
    run("import", bag, "--out", tmp_path / "out", "--agent", "robot")
    assert "is there already" in run("import", bag, "--out", tmp_path / "out", "--agent", "robot", code=1)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--as", "/scan=laser_scan"), "has no topic /scan, only /odom"),
        (("--as", "/odom=imu"), "a packet 'imu' is read from sensor_msgs/msg/Imu"),
        (("--as", "/odom=laser"), "no message is read as a packet 'laser'"),
        (("--as", "odom"), "write /TOPIC=TYPE"),
        (("--tf", "map"), "write FRAME:CHILD"),
        (("--tf", "map:base"), "has no topic /tf"),
        (("--agent", "a/b"), "'a/b' is not a name"),
    ],
)
def test_what_does_not_fit_the_bag_is_refused(tmp_path, arguments, told):
    bag = bag_of(tmp_path / "bag", odometry(1.0))
    agent = () if "--agent" in arguments else ("--agent", "robot")
    assert told in run("import", bag, "--out", tmp_path / "out", *agent, *arguments, code=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("packet", "kind"), list(CONVERSIONS))
def test_each_conversion_fills_the_fields_that_a_message_has(packet, kind):
    """The bytes are read again by rosbags, whose serialisation is that of ROS 2."""
    body = next(it for it in [*READINGS.values(), Twist(0.25, -0.5)] if type_name(it) == packet)
    store, conversion = typestore(), CONVERSIONS[packet, kind]
    message = empty(store, kind)
    if conversion.item is not None:
        setattr(message, conversion.item[0], [empty(store, conversion.item[1])])
    before = set(vars(message))
    conversion.write(message, body, Moment(1, 2, "map", "base_link"), 0)
    assert set(vars(message)) == before
    again = store.deserialize_cdr(to_bytes(store, kind, message), kind)
    if conversion.read is not not_read:
        assert type(conversion.read(again)) is type(body)


FOLLOWER = """
schema = 1
[agent]
name = "agent1"
listen = "tcp://127.0.0.1:7400"
[clock]
hold = true
[device.odom]
driver = "null.pose"
[device.wheels]
driver = "null.encoders"
[task.Follow]
type = "test.Follow"
"""


class Follow(Task):
    """Answers where its robot is."""

    requires = ("pose",)

    @on("system", Pose)
    def located(self, packet):
        self.publish("ctrl", Load(packet.body.x_m / 10))


def test_a_bag_is_replayed_into_a_task_and_the_task_is_rerun(tmp_path):
    """In virtual time; the recording of the replay is what `pancakes rerun` takes."""

    def named(number):
        topic, kind, fill = odometry(float(number))
        return f"/agent1{topic}", kind, fill

    bag = bag_of(tmp_path / "bag", *map(named, range(9)))
    run("import", bag, "--out", tmp_path / "recording")
    plugins, again = registered({"test.Follow": Follow}), tmp_path / "again"
    entries = RecordingReader(tmp_path / "recording").entries
    with VirtualReplay([parse(FOLLOWER, "a.toml")], again, plugins) as fleet:
        chosen = Selection(fleet.start())
        tally = tally_of(chosen, entries())
        assert tally.fed() == 9
        assert tally.first_ns is not None
        fleet.feed(chosen, entries(), tally.first_ns, 1.0)
    answers = [it.packet.body.cpu for it in RecordingReader(again).entries() if it.packet.channel == "ctrl"]
    assert answers == pytest.approx([number / 10 for number in range(9)])
    done = run_again(again, "Follow", Follow)
    assert done.kinds == []
    assert done.comparison.streams
