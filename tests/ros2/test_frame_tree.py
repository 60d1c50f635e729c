"""Where one frame of tf is in another. These tests need no ROS 2: a message is what has its fields."""

import math
import random
from types import SimpleNamespace

import pytest
from pancakes_ros2.frame_tree import FrameTree
from pancakes_ros2.sensor_conversion import TRANSFORMS
from pancakes_ros2.topic_row import TopicRow

from pancakes.devices import Pose


def space(**fields):
    return SimpleNamespace(**fields)


def step(parent, child, x=0.0, y=0.0, z=0.0, yaw=0.0, turn=None):
    turn = turn or (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return space(
        header=space(frame_id=parent),
        child_frame_id=child,
        transform=space(translation=space(x=x, y=y, z=z), rotation=space(**dict(zip("xyzw", turn, strict=True)))),
    )


def message(*steps):
    return space(transforms=list(steps))


def pose_of(tree, *steps):
    pose, faults = tree.hear(message(*steps))
    assert faults == []
    return pose


def near(pose, x, y, yaw):
    flat = pose.flat()
    return flat == Pose(pytest.approx(x), pytest.approx(y), pytest.approx(yaw))


def test_a_pose_is_made_of_all_transforms_on_its_way():
    tree = FrameTree("map", "base_link")
    assert pose_of(tree, step("map", "odom", 1.0, 0.0, yaw=math.pi / 2)) is None
    pose = pose_of(tree, step("odom", "base_link", 2.0, 0.5, yaw=0.25))
    assert near(pose, 0.5, 2.0, math.pi / 2 + 0.25)
    assert pose.frame == "map"


def test_a_frame_beside_the_way_is_reached_over_the_common_ancestor():
    tree = FrameTree("camera", "arm")
    pose_of(tree, step("base_link", "camera", 1.0, 0.0, yaw=math.pi))
    pose = pose_of(tree, step("base_link", "arm", 3.0, 1.0, yaw=0.5))
    assert near(pose, -2.0, -1.0, 0.5 - math.pi)


def test_the_way_back_is_the_inverse():
    random_ = random.Random(7)
    for _ in range(20):
        turn = [random_.gauss() for _ in range(4)]
        length = math.hypot(*turn)
        x, y, z = (random_.uniform(-5, 5) for _ in range(3))
        one = step("map", "base", x, y, z, turn=[it / length for it in turn])
        there = pose_of(FrameTree("map", "base"), one)
        back = pose_of(FrameTree("base", "map"), one)
        again = FrameTree("map", "base")
        inverse = step("base", "map", back.x_m, back.y_m, back.z_m, turn=back.orientation)
        found = pose_of(again, inverse)
        assert (found.x_m, found.y_m, found.z_m) == pytest.approx((there.x_m, there.y_m, there.z_m))
        same = abs(sum(a * b for a, b in zip(found.orientation, there.orientation, strict=True)))
        assert same == pytest.approx(1.0)


def test_turns_about_different_axes_are_composed_in_their_order():
    half = math.sqrt(0.5)
    tree = FrameTree("map", "base")
    pose_of(tree, step("map", "arm", turn=(0.0, 0.0, half, half)))  # a quarter to the left, and then its nose down
    pose = pose_of(tree, step("arm", "base", turn=(0.0, half, 0.0, half)))
    assert pose.orientation == pytest.approx((-0.5, 0.5, 0.5, 0.5))


def test_transforms_of_other_robots_make_no_reading():
    tree = FrameTree("map", "a/base_link")
    assert pose_of(tree, step("map", "a/base_link", 1.0)) is not None
    assert pose_of(tree, step("map", "b/base_link", 2.0)) is None
    assert pose_of(tree, step("a/base_link", "a/laser", 0.1)) is None


def test_the_newest_transform_counts_also_when_a_frame_gets_another_parent():
    tree = FrameTree("map", "base")
    pose_of(tree, step("map", "base", 1.0))
    assert near(pose_of(tree, step("map", "base", 2.0)), 2.0, 0.0, 0.0)
    assert pose_of(tree, step("dock", "base", 5.0)) is None
    assert near(pose_of(tree, step("map", "dock", 1.0)), 6.0, 0.0, 0.0)


def test_a_leading_slash_of_a_frame_does_not_count():
    assert near(pose_of(FrameTree("map", "base"), step("/map", "/base", 1.0)), 1.0, 0.0, 0.0)
    assert near(pose_of(FrameTree("/map", "/base"), step("map", "base", 1.0)), 1.0, 0.0, 0.0)


def test_transforms_whose_sum_is_not_finite_are_no_pose():
    tree = FrameTree("map", "base")
    pose_of(tree, step("map", "odom", 1.7e308))
    pose, faults = tree.hear(message(step("odom", "base", 1.7e308)))
    assert pose is None
    assert "not finite" in faults[0]


def test_a_frame_with_a_long_name_is_not_remembered():
    pose, faults = FrameTree("map", "base").hear(message(step("map", "x" * 257)))
    assert pose is None
    assert "257 characters" in faults[0]


def test_transforms_in_a_circle_end_nothing():
    tree = FrameTree("map", "a")
    assert pose_of(tree, step("a", "b"), step("b", "a")) is None
    assert pose_of(tree, step("c", "map"), step("map", "c")) is None


def test_a_bad_transform_is_left_out_and_the_others_count():
    tree = FrameTree("map", "base")
    pose, faults = tree.hear(message(step("map", "x", math.nan), step("map", "map"), step("map", "base", 1.0)))
    assert near(pose, 1.0, 0.0, 0.0)
    assert len(faults) == 2
    assert "not finite" in faults[0]


def test_why_a_pose_is_unknown_is_said_with_the_frames_that_there_are():
    tree = FrameTree("map", "base_link")
    told: list[str] = []
    assert tree.why_unknown() == "no transform of tf has come"
    tree.hear(message(step("map", "odom"), step("world", "base")))
    tree.explain(lambda look: look(None), told.append)
    assert told == [
        "no transforms of tf connect 'map' and 'base_link'; its frames are base, map, odom, world",
    ]
    tree.hear(message(step("odom", "base_link")))
    assert tree.why_unknown() == ""


def row(**fields):
    return TopicRow(topic="/tf", message=TRANSFORMS, packet="pose", **fields)


def test_a_row_of_transforms_has_two_frames():
    assert row().frames("agent1") == ("map", "agent1")
    assert row(frame="odom", child_frame="base").frames("agent1") == ("odom", "base")
    assert row(direction="in").composes
    with pytest.raises(ValueError, match="are both 'map'"):
        row(frame="map", child_frame="map")
    with pytest.raises(ValueError, match="only geometry_msgs"):
        TopicRow(topic="pose", message="geometry_msgs/PoseStamped", packet="pose", child_frame="base")


def test_static_transforms_are_kept_for_readers_that_come_later():
    with pytest.raises(ValueError, match="transient_local"):
        TopicRow(topic="/tf_static", message=TRANSFORMS, packet="pose")
