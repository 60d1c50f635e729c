"""Which packets of a recording are fed, and to whom."""

import pytest

from pancakes.devices import Load, Pose
from pancakes.errors import ControlRefused
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


def told(entries, **selection):
    return [(it.topic.agent, it.packet.source, it.packet.channel) for it in fed(entries, **selection)]


def test_readings_news_and_own_channels_are_fed_and_control_is_not():
    entries = [
        seen(number / 10, "a", "a/device/load", channel=channel)
        for number, channel in enumerate(["system", "map", "ctrl", "sysctrl", "log", "network", "recording"])
    ]
    assert told(entries) == [("a", "a/device/load", "system"), ("a", "a/device/load", "map")]
    assert told(entries, only=("a/ctrl/*",)) == []
    (left,) = Selection(live("a"), only=("a/ctrl/*",)).of(entries)
    assert left.topic.left_out == "agents take ctrl only from its publisher"
    assert told(entries, only=("a/device/*",)) == told(entries)


def test_a_packet_that_travelled_is_fed_where_it_arrived_and_not_where_it_left():
    out, arrived = (seen(1.0, agent, "a/client/Talk", to="*") for agent in "ab")
    direct = [seen(2.0, agent, "a/client/Talk", to="b/device/pose") for agent in "ab"]
    packets = fed([out, arrived, *direct])
    assert [(it.topic.agent, it.packet.destination) for it in packets] == [("b", "b"), ("b", "b/device/pose")]
    assert told([seen(3.0, "a", "a/client/Talk", to="task:b/Hears")], only=("*",)) == []


def test_two_recordings_of_one_packet_feed_it_once():
    entry = seen(1.0, "a", "a/device/load")
    later = seen(1.0, "a", "a/device/load", seq=99)
    assert len(fed([entry, entry, later])) == 2
    # To one agent in place of two: what both heard of a third is one packet.
    heard = [seen(1.0, agent, "c/client/Talk", to="*") for agent in "ab"]
    assert len(fed(heard)) == 2
    assert len(fed(heard, as_name="a")) == 1


def test_only_fits_topics_and_sources_and_takes_nothing_else():
    entries = [seen(1.0, "a", "a/device/load"), seen(2.0, "b", "b/device/pose", kind="pose", body=Pose(1, 2, 3))]
    assert told(entries, only=("*/pose",)) == [("b", "b/device/pose", "system")]
    assert told(entries, only=("a/device/load",)) == [("a", "a/device/load", "system")]
    assert told(entries, only=("a/*", "b/system/*")) == told(entries)
    assert told(entries, only=("c/*",)) == []


def test_a_time_is_the_missions():
    entries = [seen(5.0 + number, "a", "a/device/load") for number in range(5)]
    assert [it.packet.stamp for it in fed(entries, from_s=6.0, to_s=8.0)] == [6.0, 7.0]
    twice_as_fast = MissionTime(zero_ns=4_000_000_000, speed=2.0)  # so that they are at 2, 4, 6, 8, 10 s
    assert [it.packet.stamp for it in fed(entries, from_s=4.0, to_s=8.0, time=twice_as_fast)] == [6.0, 7.0]


def test_another_agent_gets_it_in_its_own_name_and_nobody_speaks_under_an_old_right():
    (own, other) = fed(
        [seen(1.0, "a", "a/device/load"), seen(2.0, "a", "b/client/Talk", to="a/device/pose")], as_name="b"
    )
    assert (own.packet.source, own.packet.destination, own.packet.fence) == ("b/device/load", "b", None)
    assert (other.packet.source, other.packet.destination) == ("b/client/Talk", "b/device/pose")


def test_what_the_fleet_says_by_itself_is_left_out_unless_it_is_asked_for():
    entries = [seen(1.0, "a", "a/device/load"), seen(2.0, "a", "b/client/Talk", to="*"), seen(3.0, "a", "a/client/X")]
    agents = live("a", "b", speaking=("a/device/load", "b/client/Talk"))
    assert told(entries, agents=agents) == [("a", "a/client/X", "system")]
    assert len(told(entries, agents=agents, only=("*",))) == 3
    reasons = {topic.left_out for topic in tally_of(Selection(agents), entries).packets}
    assert reasons == {"", "its source runs"}


def test_a_null_device_that_runs_says_nothing():
    row = {"agent": "a", "service": "device", "state": "running"}
    told = {
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
    agent = Live.of(told)
    assert agent.speaking == {"a/kernel", "a/device", "a/device/ir"}
    assert agent.speed == 0.0


def test_a_channel_that_is_not_there_an_agent_that_is_not_and_nothing_at_all_are_sentences():
    entries = [seen(1.0, "a", "a/client/Map", channel="map")]
    with pytest.raises(ControlRefused, match=r"a has no channel 'map' for 1 packets of a/client/Map"):
        tally_of(Selection(live("a")), entries)
    with pytest.raises(ControlRefused, match="all packets are left out: a does not run"):
        tally_of(Selection(live("c")), entries)
    with pytest.raises(ControlRefused, match="no packets that match --only in that time"):
        tally_of(Selection(live("a"), only=("x",), to_s=1.0), entries)
    with pytest.raises(ControlRefused, match="no packets on system or a user channel"):
        tally_of(Selection(live("a")), [])
