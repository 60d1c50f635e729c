"""The commands to actuators, each with what led to it; in bounded memory, and also where clocks disagree."""

from dataclasses import dataclass, field

import pytest

from pancakes.control import Hold
from pancakes.devices import Pose, Twist
from pancakes.packet import Packet
from pancakes.recording.causal_chains import CommandChains, body_text
from pancakes.recording.records import RecordedPacket

MS = 1_000_000
POSE = Pose(1.0, 2.0, 0.0)


def entry(time_ms, agent, source, seq, body, cause=None, channel="system", kind="pose"):
    return RecordedPacket(
        round(time_ms * MS), agent, Packet(channel, kind, source, "", time_ms / 1000, seq, body, cause)
    )


def sent(ms, seq):
    return entry(ms, "world", "world/client/Mocap", seq, POSE)


def reaction(ms, seq):
    """A pose arrives, is told as a reading, and answered by a command."""
    yield entry(ms, "a", "world/client/Mocap", seq, POSE)
    yield entry(ms + 1, "a", "a/device/pose", seq, POSE, ("world/client/Mocap", seq))
    yield entry(ms + 3, "a", "a/client/Scan", seq, Twist(0.1, 0.2), ("a/device/pose", seq), "ctrl", "motors")


def all_of(chains, entries):
    return [command for it in entries for command in chains.add(it)] + chains.close()


def test_each_command_comes_with_what_led_to_it():
    entries = [it for n in (1, 2) for it in (sent(100 * n, n), *reaction(100 * n + 4, n))]
    first, second = all_of(CommandChains(), entries)
    assert (first.agent, first.packet.type, first.caused, first.time_ns) == ("a", "motors", True, 107 * MS)
    assert [step.packet.seq for step in second.chain.steps] == [2, 2, 2]
    assert second.chain.latency_s == pytest.approx(0.007)


def test_commands_come_as_soon_as_a_second_later_has_been_seen():
    chains = CommandChains()
    for it in (sent(0, 1), *reaction(4, 1)):
        assert chains.add(it) == []
    assert chains.add(sent(1006, 2)) == []
    assert [it.packet.seq for it in chains.add(sent(1008, 3))] == [1]
    assert chains.close() == []


def test_a_cause_that_seems_later_than_its_effect_is_still_found():
    """The world's clock is half a second ahead: its pose seems to be sent after the robot has answered it."""
    (command,) = all_of(CommandChains(), [*reaction(4, 1), sent(500, 1)])
    assert command.chain.steps[0].name == "world/client/Mocap pose"
    assert all(step.travel_s >= 0.0 and step.handling_s >= 0.0 for step in command.chain.steps)


def test_a_safe_hold_and_what_was_seen_elsewhere_are_no_commands():
    hold = entry(1, "a", "a/device", 1, Hold("its holder is gone"), channel="ctrl", kind="hold")
    include_remote = entry(2, "a", "b/client/Scan", 1, Twist(0.1, 0.0), channel="ctrl", kind="motors")
    timer = entry(3, "a", "a/client/Scan", 1, Twist(0.1, 0.0), channel="ctrl", kind="motors")
    (command,) = all_of(CommandChains(), [hold, include_remote, timer])
    assert command.packet.source == "a/client/Scan" and not command.caused


def test_without_bodies_only_the_command_says_what_it_said():
    (command,) = all_of(CommandChains(bodies=False), [sent(0, 1), *reaction(4, 1)])
    assert command.packet.body == Twist(0.1, 0.2)
    assert {step.packet.body for step in command.chain.steps} == {None}


def test_what_a_packet_says_is_one_short_line():
    @dataclass
    class Said:
        mean: float = 1 / 3
        points: tuple[float, float] = (0.123456, 2.0)
        scan: list[float] = field(default_factory=lambda: [0.0] * 360)

    assert body_text(Said()) == "mean 0.3333, points (0.1235, 2), scan 360 values"
    assert body_text("x" * 200, 10) == "x" * 9 + "…"
    assert body_text({"a": None}) == "a None"
