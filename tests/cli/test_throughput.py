"""The measurement of packet rates, intervals and sizes."""

import pytest

from pancakes.devices import Pose
from pancakes.packet import Packet
from pancakes.tools.cli.verbs.channel import Throughput, size_of

POSE = Pose(1.0, 2.0, 0.5)


def packet(stamp: float, source: str = "a/device/pose", kind: str = "pose") -> Packet:
    return Packet("system", kind, source, "cli-1", stamp, 1, POSE)


def test_throughput_rate_uses_stamps():
    heard = Throughput(began_s=100.0)
    for at_s, stamp in [(100.0, 1.0), (100.9, 1.1), (101.0, 1.3), (101.1, 1.4)]:
        heard.add(packet(stamp), at_s)

    (row,) = heard.rows(102.0)

    assert row["rate_hz"] == pytest.approx(3 / 0.4)
    assert (row["min_s"], row["max_s"]) == (pytest.approx(0.1), pytest.approx(0.2))
    assert row["std_dev_s"] == pytest.approx(0.0471, abs=1e-4)
    assert (row["packets"], row["window"]) == (4, 4)


def test_throughput_rate_can_use_arrivals():
    heard = Throughput(began_s=100.0, arrivals=True)
    for at_s in (100.0, 100.5, 101.0):
        heard.add(packet(0.0), at_s)
    assert heard.rows(102.0)[0]["rate_hz"] == pytest.approx(2.0)


def test_throughput_is_per_source_and_type():
    heard = Throughput(began_s=0.0)
    for n in range(3):
        heard.add(packet(n * 0.1, "b/device/pose"), n * 0.1)
        heard.add(packet(n * 1.0, "a/device/pose"), n * 1.0)
        heard.add(packet(n * 2.0, "a/device/pose", "other"), n * 2.0)

    rows = heard.rows(10.0)

    assert [(row["source"], row["type"], row["rate_hz"]) for row in rows] == [
        ("a/device/pose", "other", pytest.approx(0.5)),
        ("a/device/pose", "pose", pytest.approx(1.0)),
        ("b/device/pose", "pose", pytest.approx(10.0)),
    ]
    assert heard.packets == 9


def test_throughput_counts_only_the_newest_packets():
    heard = Throughput(began_s=0.0, window=3)
    for at_s in (0.0, 5.0, 5.1, 5.2):
        heard.add(packet(at_s), at_s, size=100)

    (row,) = heard.rows(6.0)

    assert row["rate_hz"] == pytest.approx(10.0)
    assert (row["packets"], row["window"]) == (4, 3)
    assert row["bytes_per_s"] == pytest.approx(200.0)  # the two after the first of the window, since that


def test_throughput_counts_bytes_from_the_beginning():
    heard = Throughput(began_s=10.0)
    for at_s, size in ((10.5, 100), (11.5, 300)):
        heard.add(packet(at_s), at_s, size)

    (row,) = heard.rows(12.0)

    assert row["bytes_per_s"] == pytest.approx(200.0)
    assert (row["min_bytes"], row["mean_bytes"], row["max_bytes"]) == (100, 200.0, 300)


def test_throughput_of_one_packet_or_a_held_mission_has_no_rate():
    heard = Throughput(began_s=0.0)
    heard.add(packet(0.0), 1.0)
    assert heard.rows(2.0)[0]["rate_hz"] is None
    heard.add(packet(0.0), 2.0)
    assert heard.rows(3.0)[0]["rate_hz"] is None


def test_throughput_restarts_with_the_agent():
    heard = Throughput(began_s=0.0)
    for stamp in (100.0, 100.1, 0.5, 1.0, 1.5):
        heard.add(packet(stamp), stamp)

    (row,) = heard.rows(200.0)

    assert row["rate_hz"] == pytest.approx(2.0)
    assert row["window"] == 3


def test_throughput_report_can_omit_silent_sources():
    heard = Throughput(began_s=0.0)
    heard.add(packet(0.0, "a/device/pose"), 0.0)
    heard.add(packet(0.0, "b/device/pose"), 0.0)
    heard.rows(1.0, new_only=True)
    heard.add(packet(1.0, "b/device/pose"), 1.0)

    assert [row["source"] for row in heard.rows(2.0, new_only=True)] == ["b/device/pose"]
    assert heard.rows(3.0, new_only=True) == []
    assert len(heard.rows(3.0)) == 2


def test_throughput_size_does_not_depend_on_the_follower():
    assert size_of(packet(1.0)) == size_of(Packet("system", "pose", "a/device/pose", "cli-12345-abc", 1.0, 1, POSE))
