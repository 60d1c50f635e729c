"""Cause and effect: what led to a packet, over how many agents, and how long each step took."""

import pytest

from pancakes.devices import Pose, Twist
from pancakes.packet import Packet
from pancakes.recording.causal_chains import Causes
from pancakes.recording.records import RecordedPacket
from pancakes.tools.report.command_latency import Reactions

MS = 1_000_000


def entry(time_ms, agent, source, seq, body, cause=None, channel="system", kind="pose"):
    return RecordedPacket(time_ms * MS, agent, Packet(channel, kind, source, "", time_ms / 1000, seq, body, cause))


def mocap_to_wheels(start_ms, seq, travel_ms=4):
    """A pose is seen by the world, sent to agent1, shown there as a reading, and answered by a command."""
    pose = Pose(1.0, 2.0, 0.0)
    sent, read = ("world/client/MotionCapture", seq), ("agent1/device/pose", seq)
    return [
        entry(start_ms, "world", *sent, pose),
        entry(start_ms + travel_ms, "agent1", *sent, pose),
        entry(start_ms + travel_ms + 1, "agent1", *read, pose, cause=sent),
        entry(start_ms + travel_ms + 3, "agent1", "agent1/client/Scan", seq, Twist(0.1, 0.0), read, "ctrl", "twist"),
    ]


@pytest.fixture
def causes():
    return Causes()


def test_a_command_leads_back_to_the_reading_with_the_time_of_each_step(causes):
    for it in mocap_to_wheels(100, 7):
        causes.add(it)
    chain = causes.chain("agent1/client/Scan", 7)
    assert chain.shape == (
        "world/client/MotionCapture pose",
        "agent1/device/pose pose",
        "agent1/client/Scan twist",
    )
    assert [round(step.travel_s * 1000) for step in chain.steps] == [4, 0, 0]
    assert [round(step.handling_s * 1000) for step in chain.steps] == [1, 2, 0]
    assert chain.latency_s == pytest.approx(0.007)


def test_a_packet_without_a_cause_is_a_chain_of_its_own_and_an_unknown_one_is_none(causes):
    causes.add(mocap_to_wheels(0, 1)[0])
    assert len(causes.chain("world/client/MotionCapture", 1).steps) == 1
    assert causes.chain("world/client/MotionCapture", 2) is None


def test_a_chain_whose_beginning_was_not_recorded_begins_later(causes):
    for it in mocap_to_wheels(0, 1)[2:]:
        causes.add(it)
    assert causes.chain("agent1/client/Scan", 1).shape[0] == "agent1/device/pose pose"


def test_packets_that_cause_each_other_end_somewhere(causes):
    pose = Pose(0.0, 0.0, 0.0)
    causes.add(entry(0, "a", "a/x", 1, pose, cause=("a/y", 1)))
    causes.add(entry(1, "a", "a/y", 1, pose, cause=("a/x", 1)))
    assert len(causes.chain("a/x", 1).steps) == 2
    for seq in range(1, 200):
        causes.add(entry(seq, "b", "b/x", seq, pose, cause=("b/x", seq - 1)))
    assert len(causes.chain("b/x", 199).steps) == 64


def test_the_oldest_is_forgotten_at_the_limit():
    causes = Causes(limit=2)
    for seq in (1, 2, 3):
        causes.add(entry(seq, "a", "a/x", seq, Pose(0.0, 0.0, 0.0)))
    assert causes.chain("a/x", 1) is None
    assert causes.chain("a/x", 3) is not None


def test_chains_of_one_shape_have_a_distribution():
    found = Reactions()
    for seq in range(1, 101):
        for it in mocap_to_wheels(1000 * seq, seq, travel_ms=seq):
            found.add(it)
    found.close()
    (reaction,) = found.reactions()
    assert reaction.count == 100
    assert reaction.latency_s.quantile(0.5) == pytest.approx(0.054)
    assert reaction.latency_s.quantile(0.99) == pytest.approx(0.103)
    assert reaction.latency_s.quantile(1.0) == pytest.approx(0.103)
    assert reaction.step_means_s == pytest.approx([0.0515, 0.002])
