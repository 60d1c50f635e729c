"""The types of encoders, IMU, GPS fix, laser scan, camera and 3-D pose: what they refuse, and what travels."""

import math
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import pytest
from devices.jpegs import jpeg

from pancakes.devices import (
    MOST_FRAME,
    MOST_JPEG_BYTES,
    MOST_RAYS,
    CameraFrame,
    Encoders,
    GpsFix,
    Imu,
    LaserScan,
    Pose,
    Pose3D,
    builtin_drivers,
)
from pancakes.devices.driver import Sensor
from pancakes.devices.validation import reading_check
from pancakes.mesh.codec import encode_packet
from pancakes.packet import Packet, type_name
from pancakes.recording.message_format import data_of, packet_from_bytes, packet_from_data

HALF = math.sqrt(0.5)
BODIES = [
    Encoders(("left", "right"), (1.5, -2.0), (0.1, 0.2)),
    Encoders(("arm",), (0.5,)),
    Imu((0.0, 0.0, 0.1), (0.0, 0.0, 9.81), (0.0, 0.0, HALF, HALF), "imu_link"),
    Imu((0.0, 0.0, 0.1), (0.0, 0.0, 9.81)),
    GpsFix(52.5, 13.4, 34.0, 1.2, 2.5, "gps"),
    GpsFix(-90.0, 180.0),
    LaserScan(-1.5, 0.5, (1000, 0, 4000), 4.0, "laser"),
    CameraFrame(jpeg(320, 240), "camera"),
    Pose3D("map", 1.0, 2.0, 3.0, (0.0, 0.0, HALF, HALF)),
]


@pytest.mark.parametrize("body", BODIES, ids=lambda body: type(body).__name__)
def test_a_reading_is_the_same_after_the_wire_and_after_a_recording(body):
    check = reading_check(type(body))
    assert check is None or check(body) == ""
    packet = Packet("system", type_name(body), "a/device/d", "", 1.0, 1, body)
    assert packet_from_bytes(encode_packet(packet)).body == body
    data = data_of(packet)
    assert packet_from_data("system", packet.type, data).body == body
    assert b'"exact"' not in data  # JSON says all of it, so a recording has it only once


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Encoders(("left", "right"), (1.0,)), "angles_rad has 1 numbers for 2 wheels"),
        (lambda: Encoders(("left",), ()), "angles_rad has 0 numbers for 1 wheels"),
        (lambda: Encoders(("left",), (1.0,), (1.0, 2.0)), "speeds_radps has 2 numbers for 1 wheels"),
        (lambda: Encoders(("left", "left"), (1.0, 2.0)), "a name twice"),
        (lambda: Imu((0.0,) * 3, (0.0,) * 3, (0.0, 0.0, 0.0, 0.5)), "orientation has the length 0.5"),
        (lambda: Pose3D("map", 0.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0)), "orientation has the length 0"),
        (lambda: LaserScan(0.0, 0.1, (), 4.0), "ranges_mm is empty"),
        (lambda: LaserScan(0.0, 0.1, (-1,), 4.0), "below 0"),
        (lambda: LaserScan(0.0, 0.1, (4001,), 4.0), "beyond max_range_m = 4"),
        (lambda: LaserScan(0.0, 0.1, (1,) * (MOST_RAYS + 1), 4.0), f"at most {MOST_RAYS}"),
        (lambda: LaserScan.of(0.0, 0.1, [-0.5], 4.0), "below 0"),
        (lambda: LaserScan.of(0.0, 0.1, [0.5], math.inf), "must be finite"),
        (lambda: LaserScan(0.0, 0.1, (1,), math.nan), "max_range_m is nan"),
        (lambda: LaserScan(0.0, 0.1, (1,), math.inf), "max_range_m is inf"),
        (lambda: LaserScan.of(0.0, 0.1, [math.inf], 3.4e38), "at most 1e"),
        (lambda: Encoders(("",), (1.0,)), "an empty name"),
        (lambda: Encoders(("x" * 65,), (1.0,)), "has 65 characters"),
        (lambda: Imu((0.0,) * 3, (0.0,) * 3, None, "x" * 257), "has 257 characters"),
        (lambda: GpsFix(0.0, 0.0, frame="x" * 257), "has 257 characters"),
        (lambda: LaserScan(0.0, 0.1, (1,), 4.0, "x" * 257), "has 257 characters"),
        (lambda: CameraFrame(jpeg(320, 240), "x" * 257), "has 257 characters"),
        (lambda: Pose3D("x" * 257, 0.0, 0.0, 0.0), "has 257 characters"),
        (lambda: Pose3D("", 0.0, 0.0, 0.0), "frame is empty"),
        (lambda: Pose3D("map", 0.0, 0.0, 0.0, (1.7e308, 1.7e308, 0.0, 0.0)), "orientation has the length inf"),
        (lambda: CameraFrame(b"GIF89a"), "not a JPEG image"),
        (lambda: CameraFrame(jpeg(320, 240)[:20]), "cut off"),
        (lambda: CameraFrame(jpeg(0, 240)), "cut off or damaged"),
        (lambda: CameraFrame(jpeg(320, 240, MOST_JPEG_BYTES)), f"at most {MOST_JPEG_BYTES}"),
    ],
)
def test_what_does_not_agree_is_refused_with_a_sentence(make, told):
    with pytest.raises(ValueError, match=told):
        make()


@pytest.mark.parametrize(
    "body",
    [
        Encoders(("left",), (math.nan,)),
        Imu((math.inf, 0.0, 0.0), (0.0, 0.0, 9.81)),
        Imu((0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (math.nan, 0.0, 0.0, 1.0)),
        GpsFix(90.5, 0.0),
        GpsFix(0.0, 0.0, math.nan),
        GpsFix(0.0, 0.0, 0.0, -1.0),
        Pose3D("map", math.nan, 0.0, 0.0),
        LaserScan(math.nan, 0.1, (1,), 4.0),
    ],
)
def test_a_number_that_is_none_is_no_reading(body):
    check = reading_check(type(body))
    assert check is not None
    assert check(body)


def test_a_peer_cannot_send_what_does_not_agree():
    with pytest.raises(msgspec.ValidationError, match="angles_rad has 1 numbers for 2 wheels"):
        msgspec.convert({"wheels": ["left", "right"], "angles_rad": [1.0]}, Encoders)


def test_a_peer_cannot_send_a_scan_without_an_end():
    plain = {"start_rad": 0.0, "step_rad": 0.1, "ranges_mm": [1], "max_range_m": math.inf}
    with pytest.raises(msgspec.ValidationError, match="max_range_m is inf"):
        msgspec.convert(plain, LaserScan)


def test_a_scan_is_made_of_metres_and_gives_metres():
    scan = LaserScan.of(-0.5, 0.25, np.array([0.5, math.nan, math.inf, 9.0, 0.0, -math.inf], np.float32), 4.0)
    assert scan.ranges_mm == (500, 0, 4000, 4000, 1, 1)
    assert np.array_equal(scan.ranges_m(), [0.5, math.nan, 4.0, 4.0, 0.001, 0.001], equal_nan=True)
    assert np.allclose(scan.bearings_rad(), [-0.5, -0.25, 0.0, 0.25, 0.5, 0.75])


def test_the_full_range_need_not_be_whole_millimetres():
    scan = LaserScan.of(0.0, 0.1, [math.inf, 5.59], 5.6004)
    assert scan.ranges_m().max() == 5.6004


def test_a_scan_takes_three_bytes_a_ray_on_the_wire():
    scan = LaserScan.of(0.0, 0.01, [2.0] * 720, 8.0)
    packet = Packet("system", "laser_scan", "a/device/laser", "", 1.0, 1, scan)
    assert len(encode_packet(packet)) < 3 * 720 + 200


def test_an_image_of_250_kb_travels():
    image = CameraFrame(jpeg(1920, 1080, 250_000), "x" * MOST_FRAME)
    assert len(image.jpeg) >= 250_000
    packet = Packet("system", "camera", f"{'a' * 64}/device/{'d' * 64}", "", 1.0, 1, image)
    assert packet_from_bytes(encode_packet(packet)).body == image


def test_the_size_of_an_image_is_in_its_header():
    assert CameraFrame(jpeg(640, 480)).size_px() == (640, 480)
    assert CameraFrame(jpeg(1, 65_535, 100_000)).size_px() == (1, 65_535)


def test_a_row_of_markers_is_no_header():
    with pytest.raises(ValueError, match="no frame header"):
        CameraFrame(b"\xff\xd8" + b"\xff\xd0" * 2000 + jpeg(320, 240)[2:])


def test_a_pose_in_space_has_a_pose_in_the_plane():
    assert Pose3D("map", 1.0, 2.0, 3.0, (0.0, 0.0, HALF, HALF)).flat() == Pose(1.0, 2.0, pytest.approx(math.pi / 2))
    assert Pose3D("map", 0.0, 0.0, 0.0, (0.0, 0.0, -1.0, 0.0)).flat().theta_rad == math.pi


@pytest.mark.parametrize("device_type", ["encoders", "imu", "gps_fix", "laser_scan", "camera", "pose_3d"])
def test_each_type_has_a_virtual_device_and_a_stand_in(device_type):
    classes = [it for it in vars(builtin_drivers).values() if isinstance(it, type) and issubclass(it, Sensor)]
    names = {it.__name__ for it in classes if vars(it).get("type") == device_type}
    assert {name[:4] for name in names} == {"Netw", "Null"}


class NextReading(Sensor):
    """Says what comes next in its list."""

    type = "encoders"
    made: Iterator[Callable[[], Encoders]] = iter(())

    def read(self):
        return next(self.made)()


def test_a_driver_whose_reading_does_not_agree_misses_it(fleet):
    class Wheels(NextReading):
        made = iter([lambda: Encoders(("left",), ()), *[lambda: Encoders(("left",), (1.0,))] * 9])

    robot = fleet.start("robot", devices={"wheels": {"type": Wheels, "rate_hz": 10}})
    robot.probe.follow("system")
    fleet.run_for(0.55)
    assert any("angles_rad has 0 numbers for 1 wheels" in line for line in robot.lines("warning"))
    assert robot.probe.packets(Encoders)
