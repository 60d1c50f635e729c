"""Which packets of a recording are fed, and into which agent."""

import pytest

from pancakes.devices import Load, Pose
from pancakes.errors import ControlRefusedError
from pancakes.packet import Fence, Packet
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import RecordedPacket
from pancakes.tools.replay.replay import Live, Selection, tally_of


def seen(time_s, agent, source, body=Load(0.5), kind="load", channel="system", to="", seq=None):  # noqa: B008
    packet = Packet(channel, kind, source, to, time_s, seq or int(time_s * 10) + 1, body, None, Fence("x/y", (1, "x")))
    return RecordedPacket(int(time_s * 1e9), agent, packet)


def live(*names, speaking=(), channels=("system", "sysctrl", "ctrl", "network", "log")):
    return {name: Live(name, channels, frozenset(speaking), 0.0, 1.0) for name in names}


def fed(entries, **selection):
    selection.setdefault("agents", live("a", "b"))
    return [it for it in Selection(**selection).of(entries) if not it.topic.left_out]


def fed_topics(entries, **selection):
    return [(it.topic.agent, it.packet.source, it.packet.channel) for it in fed(entries, **selection)]


def test_readings_are_fed_and_control_is_not():
    entries = [
        seen(number / 10, "a", "a/device/load", channel=channel)
        for number, channel in enumerate(["system", "map", "ctrl", "sysctrl", "log", "network", "recording"])
    ]
    assert fed_topics(entries) == [("a", "a/device/load", "system"), ("a", "a/device/load", "map")]
    assert fed_topics(entries, only=("a/ctrl/*",)) == []
    (left,) = Selection(live("a"), only=("a/ctrl/*",)).of(entries)
    assert left.topic.left_out == "agents take ctrl only from its publisher"
    assert fed_topics(entries, only=("a/device/*",)) == fed_topics(entries)


def test_packet_is_fed_at_its_receiver():
    out, arrived = (seen(1.0, agent, "a/client/Talk", to="*") for agent in "ab")
    direct = [seen(2.0, agent, "a/client/Talk", to="b/device/pose") for agent in "ab"]
    packets = fed([out, arrived, *direct])
    assert [(it.topic.agent, it.packet.destination) for it in packets] == [("b", "b"), ("b", "b/device/pose")]
    assert fed_topics([seen(3.0, "a", "a/client/Talk", to="task:b/Hears")], only=("*",)) == []


def test_packet_in_two_recordings_is_fed_once():
    entry = seen(1.0, "a", "a/device/load")
    later = seen(1.0, "a", "a/device/load", seq=99)
    assert len(fed([entry, entry, later])) == 2
    # With one agent in place of two, a packet that both received from a third is one packet.
    heard = [seen(1.0, agent, "c/client/Talk", to="*") for agent in "ab"]
    assert len(fed(heard)) == 2
    assert len(fed(heard, as_name="a")) == 1


def test_only_matches_topics_and_sources():
    entries = [seen(1.0, "a", "a/device/load"), seen(2.0, "b", "b/device/pose", kind="pose", body=Pose(1, 2, 3))]
    assert fed_topics(entries, only=("*/pose",)) == [("b", "b/device/pose", "system")]
    assert fed_topics(entries, only=("a/device/load",)) == [("a", "a/device/load", "system")]
    assert fed_topics(entries, only=("a/*", "b/system/*")) == fed_topics(entries)
    assert fed_topics(entries, only=("c/*",)) == []


def test_from_and_to_are_mission_times():
    entries = [seen(5.0 + number, "a", "a/device/load") for number in range(5)]
    assert [it.packet.stamp_s for it in fed(entries, from_s=6.0, to_s=8.0)] == [6.0, 7.0]
    twice_as_fast = MissionTime(zero_ns=4_000_000_000, speed=2.0)  # so that they are at 2, 4, 6, 8, 10 s
    assert [it.packet.stamp_s for it in fed(entries, from_s=4.0, to_s=8.0, time=twice_as_fast)] == [6.0, 7.0]


def test_as_renames_the_source_and_drops_the_fence():
    (own, other) = fed(
        [seen(1.0, "a", "a/device/load"), seen(2.0, "a", "b/client/Talk", to="a/device/pose")], as_name="b"
    )
    assert (own.packet.source, own.packet.destination, own.packet.fence) == ("b/device/load", "b", None)
    assert (other.packet.source, other.packet.destination) == ("b/client/Talk", "b/device/pose")


def test_running_sources_are_left_out_without_only():
    entries = [seen(1.0, "a", "a/device/load"), seen(2.0, "a", "b/client/Talk", to="*"), seen(3.0, "a", "a/client/X")]
    agents = live("a", "b", speaking=("a/device/load", "b/client/Talk"))
    assert fed_topics(entries, agents=agents) == [("a", "a/client/X", "system")]
    assert len(fed_topics(entries, agents=agents, only=("*",))) == 3
    reasons = {topic.left_out for topic in tally_of(Selection(agents), entries).packets}
    assert reasons == {"", "its source runs"}


def test_null_device_does_not_publish():
    row = {"agent": "a", "service": "device", "state": "running"}
    description = {
        "agent": "a",
        "channels": ["system"],
        "services": [{"service": "device"}],
        "tasks": [
            {**row, "task": "pose", "type": "null.pose"},
            {**row, "task": "ir", "type": "sim.ir"},
            {**row, "task": "sonar", "type": "sim.sonar", "state": "failed"},
        ],
        "mission_s": 3.0,
        "speed": 2.0,
        "held": True,
    }
    agent = Live.of(description)
    assert agent.speaking == {"a/kernel", "a/device", "a/device/ir"}
    assert agent.speed == 0.0


def test_missing_channel_agent_or_packets_are_errors():
    entries = [seen(1.0, "a", "a/client/Map", channel="map")]
    with pytest.raises(ControlRefusedError, match=r"a has no channel 'map' for 1 packets of a/client/Map"):
        tally_of(Selection(live("a")), entries)
    with pytest.raises(ControlRefusedError, match="all packets are left out: a does not run"):
        tally_of(Selection(live("c")), entries)
    with pytest.raises(ControlRefusedError, match="no packets that match --only in that time"):
        tally_of(Selection(live("a"), only=("x",), to_s=1.0), entries)
    with pytest.raises(ControlRefusedError, match="no packets on system or a user channel"):
        tally_of(Selection(live("a")), [])
