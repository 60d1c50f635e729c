"""Encoders, IMU, GPS fix, laser scan, camera and 3-D pose: from a node of another release, and back to it.

`tf2_msgs` is not among the wheels of these environments. A transform is heard here as a TransformStamped, of which a
message of tf is a list; what tf adds is in `test_frame_tree.py`, and the bytes in `test_bags.py`.
"""

from typing import Any

from devices.jpegs import jpeg

from pancakes.client import Client
from pancakes.devices import CameraFrame, Encoders, GpsFix, Imu, LaserScan, Pose3D

JOINTS, IMU, FIX = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
SCAN, IMAGE = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/CompressedImage"
ODOMETRY, TRANSFORM = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"
PICTURE = jpeg(320, 240, 2000)
SENT: dict[str, tuple[str, str, dict[str, Any]]] = {
    "encoders": ("joint_states", JOINTS, {"name": ["left", "right"], "position": [1.5, -2.0], "velocity": [0.5, 0.25]}),
    "imu": (
        "imu",
        IMU,
        {
            "header": {"frame_id": "imu_link"},
            "orientation_covariance": [-1.0] + [0.0] * 8,
            "angular_velocity": {"z": 0.125},
            "linear_acceleration": {"z": 9.75},
        },
    ),
    "gps_fix": (
        "fix",
        FIX,
        {
            "status": {"status": 0},
            "latitude": 52.5,
            "longitude": 13.25,
            "altitude": 34.0,
            "position_covariance": [4.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 9.0],
            "position_covariance_type": 2,
        },
    ),
    "laser_scan": (
        "scan",
        SCAN,
        {
            "header": {"frame_id": "laser"},
            "angle_min": -0.5,
            "angle_increment": 0.5,
            "range_max": 4.0,
            "ranges": [1.0, float("inf"), float("nan")],
        },
    ),
    "camera": ("image_raw/compressed", IMAGE, {"format": "jpeg", "data": list(PICTURE)}),
    "pose_3d": (
        "odom",
        ODOMETRY,
        {"header": {"frame_id": "odom"}, "pose": {"pose": {"position": {"x": 1.0, "y": 2.0, "z": 3.0}}}},
    ),
}
READ = {
    "encoders": Encoders(("left", "right"), (1.5, -2.0), (0.5, 0.25)),
    "imu": Imu((0.0, 0.0, 0.125), (0.0, 0.0, 9.75), None, "imu_link"),
    "gps_fix": GpsFix(52.5, 13.25, 34.0, 2.0, 3.0),
    "laser_scan": LaserScan(-0.5, 0.5, (1000, 4000, 0), 4.0, "laser"),
    "camera": CameraFrame(PICTURE),
    "pose_3d": Pose3D("odom", 1.0, 2.0, 3.0),
}


def config():
    lines = ['[service.ros2]\ntype = "ros2"']
    for packet, (_, kind, _) in SENT.items():
        message = TRANSFORM if packet == "pose_3d" else kind
        lines.append(f'[device.{packet}]\ndriver = "ros2.{packet}"')
        lines.append("[[service.ros2.settings.topics]]")
        lines.append(f'topic = "again/{packet}"\nmessage = "{message}"\npacket = "{packet}"')
    return "\n".join(lines)


def test_sensors_of_another_release_are_read_and_shown_to_it_again(start_agent, peer):
    start_agent("agent1", config())
    with Client() as client, client.subscribe("agent1/system", timeout_s=20.0) as packets:
        for topic, kind, fields in SENT.values():
            peer.order("publish", topic=f"/agent1/{topic}", type=kind, fields=fields, every_s=0.1, readers=1)
            assert peer.told.wait(lambda line: "published" in line)["readers"] == 1
        read = {}
        for packet, _ in zip(packets, range(500), strict=False):  # ten a second of each: one that never comes is found
            read[packet.type] = packet.body
            if len(read) == len(SENT):
                break
    assert read == READ
    told: dict[str, Any] = {}
    for name, (_, kind, _) in SENT.items():
        peer.listen(f"/agent1/again/{name}", TRANSFORM if name == "pose_3d" else kind)
        told[name] = peer.heard(f"/agent1/again/{name}")["message"]
    for name in ("encoders", "imu", "gps_fix", "camera"):
        for field, value in SENT[name][2].items():
            again = told[name][field]
            part = {key: again[key] for key in value} if isinstance(value, dict) else again
            assert part == value, (name, field)
    assert told["gps_fix"]["header"]["frame_id"] == "agent1"
    scan = told["laser_scan"]
    assert (scan["angle_min"], scan["angle_max"], scan["range_max"]) == (-0.5, 0.5, 4.0)
    assert scan["ranges"][:2] == [1.0, float("inf")]
    assert scan["ranges"][2] != scan["ranges"][2]
    step = told["pose_3d"]
    assert (step["header"]["frame_id"], step["child_frame_id"]) == ("odom", "agent1")
    assert step["transform"]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
