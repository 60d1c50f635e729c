"""The comparison of two runs of a task, packet by packet."""

import math

from pancakes.devices import Infrared, Load, Motion, Pose
from pancakes.packet import Packet
from pancakes.tools.replay.comparison import Stream, Tolerance, compare

ME = "a/client/Me"


def out(stamp, seq, body, kind="load", cause=None, to="", channel="system"):
    return Packet(channel, kind, ME, to, stamp, seq, body, cause)


def outcome(before, after, **tolerance):
    found = compare(before, after, ME, Tolerance(**tolerance))
    return found, [(it.kind, it.packet.stamp_s, [tuple(field) for field in it.fields]) for it in found.differences]


def test_numbers_outside_the_tolerance_are_named():
    before = [out(1.0, 1, Pose(1.0, 2.0, math.nan), "pose"), out(2.0, 2, Pose(1.0, 2.0, 0.0), "pose")]
    after = [out(1.0, 1, Pose(1.0 + 1e-9, 2.0, math.nan), "pose"), out(2.0, 2, Pose(1.0, 2.5, 0.0), "pose")]
    found, differences = outcome(before, after)
    assert differences == [("different", 2.0, [("y_m", 2.0, 2.5)])]
    assert found.streams["system", "pose", ""] == Stream(2, 2, equal=1, different=1)
    assert outcome(before, after, share=0.3)[1] == []


def test_lists_are_compared_item_by_item():
    before = [
        out(1.0, 1, Infrared((0.0, 1.0), (0.2, 0.3), 0.4), "ir"),
        out(1.0, 2, Motion(False, None, 1.0), "motion"),
    ]
    after = [
        out(1.0, 1, Infrared((0.0, 1.0), (0.2, 0.1), 0.4), "ir"),
        out(1.0, 2, Motion(True, 0.5, 1.0), "motion"),
    ]
    assert outcome(before, after)[1] == [
        ("different", 1.0, [("ranges_m[1]", 0.3, 0.1)]),
        ("different", 1.0, [("detected", False, True), ("bearing_rad", None, 0.5)]),
    ]
    shorter = [out(1.0, 1, Infrared((0.0,), (0.2,), 0.4), "ir")]
    fields = outcome(before[:1], shorter)[1][0][2]
    assert fields == [("bearings_rad", (0.0, 1.0), (0.0,)), ("ranges_m", (0.2, 0.3), (0.2,))]


def test_effects_of_one_packet_are_compared():
    first, second, third = ("a/device/x", 1), ("a/device/x", 2), ("a/device/x", 3)
    before = [out(1.0, 1, Load(1.0), cause=first), out(2.0, 2, Load(2.0), cause=second)]
    after = [out(2.0, 1, Load(2.0), cause=second), out(3.0, 2, Load(3.0), cause=third)]
    found, differences = outcome(before, after)
    assert differences == [("missing", 1.0, []), ("extra", 3.0, [])]
    assert found.streams["system", "load", ""] == Stream(2, 2, equal=1, missing=1, extra=1)


def test_packets_without_a_cause_are_compared_by_time():
    before = [out(float(n), n, Load(float(n))) for n in range(1, 6)]
    later = [out(n + 0.03, n, Load(float(n))) for n in range(1, 6) if n != 3]
    assert outcome(before, later)[1] == [("missing", 3.0, [])]
    assert outcome(later, before)[1] == [("extra", 3.0, [])]
    assert {kind for kind, _, _ in outcome(before, later, time_s=0.01)[1]} == {"missing", "extra"}


def test_nearest_packets_are_paired():
    before = [out(1.04, 1, Load(1.0)), out(1.10, 2, Load(2.0))]
    after = [out(1.00, 1, Load(9.0)), out(1.04, 2, Load(1.0)), out(1.10, 3, Load(2.0))]
    assert outcome(before, after)[1] == [("extra", 1.0, [])]


def test_effect_at_another_time_differs_in_its_stamp():
    cause = ("a/device/x", 1)
    assert outcome([out(1.0, 1, Load(1.0), cause=cause)], [out(1.5, 1, Load(1.0), cause=cause)])[1] == [
        ("different", 1.0, [("stamp", 1.0, 1.5)])
    ]


def test_effects_of_own_packets_are_compared_by_time():
    before, after = out(1.0, 5, Load(1.0), cause=(ME, 4)), out(1.0, 9, Load(1.0), cause=(ME, 8))
    assert outcome([before], [after])[1] == []


def test_streams_differ_by_channel_type_and_destination():
    found, differences = outcome([out(1.0, 1, Load(1.0), to="b")], [out(1.0, 1, Load(1.0), to="c")])
    assert [kind for kind, _, _ in differences] == ["missing", "extra"]
    assert list(found.streams) == [("system", "load", "b"), ("system", "load", "c")]
