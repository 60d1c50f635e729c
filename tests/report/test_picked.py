"""The commands that a person can pick in a report, and the picker on its page."""

import json
import re

import msgspec
import pytest
from report.commanded import command

from pancakes.recording.clock_alignment import MissionTime
from pancakes.tools.report.command_latency import MOST_ACTUATORS, MOST_EVEN_EACH, MOST_SLOW, PickedCommands, Reactions
from pancakes.tools.report.picker import picker_html


@pytest.fixture
def picked():
    return PickedCommands()


def test_few_commands_are_kept_completely(picked):
    for number in range(100):
        picked.add(command(number))
    (actuator,) = picked.actuators()
    assert (actuator.agent, actuator.type, actuator.count, actuator.stride) == ("a", "motors", 100, 1)
    assert [it.steps[-1].packet.seq for it in actuator.commands()] == list(range(1, 101))


def test_picked_commands_are_spread_evenly_and_the_slowest(picked):
    for number in range(20_000):
        picked.add(command(number, latency_ms=50.0 if number in (2_345, 17_777) else 2.0))
    (actuator,) = picked.actuators()
    kept = actuator.commands()
    assert actuator.count == 20_000
    assert MOST_EVEN_EACH / 2 <= len(kept) <= MOST_EVEN_EACH + MOST_SLOW
    assert [it.steps[-1].packet.seq for it in actuator.slowest()[:2]] == [2_346, 17_778]
    seqs = [it.steps[-1].packet.seq for it in kept]
    assert seqs == sorted(seqs) and {2_346, 17_778} <= set(seqs)
    assert all((number * actuator.stride) + 1 in seqs for number in range(20_000 // actuator.stride))


def test_picked_actuators_share_the_limit(picked):
    for number in range(500):
        for robot in range(MOST_ACTUATORS + 1):
            picked.add(command(number, agent=f"r{robot:03}"))
    assert len(picked.actuators()) == MOST_ACTUATORS
    assert picked.left_out == 500
    assert sum(len(it.commands()) for it in picked.actuators()) <= 24_000 + MOST_ACTUATORS * MOST_SLOW
    assert len(json.dumps(picked.plain())) < 3_000_000


def test_picked_plain_values_add_up(picked):
    picked.add(command(3, latency_ms=2.5))
    plain = picked.plain()
    assert plain["names"] == ["a/device/pose pose", "a/client/Scan motors"]
    assert plain["texts"] == ["v_mps 0.1, omega_radps 0"]
    assert plain["kinds"] == [(0, 1)]
    assert plain["actuators"][0]["commands"] == [[302, 0, 0, [4, 4], [500], [2000]]]


def test_picked_commands_have_recording_time():
    again = command(300)
    again = msgspec.structs.replace(again, packet=msgspec.structs.replace(again.packet, stamp_s=0.5))
    picked = PickedCommands(MissionTime(zero_ns=10 * 10**9, speed=5.0))
    picked.add(again)
    assert [it.mission_s for it in picked.actuators()[0].commands()] == [pytest.approx(5 * (30.002 - 10))]


def test_picker_data_cannot_end_the_script():
    found = Reactions()
    for number in range(20):
        found.add_command(command(number, latency_ms=float(number + 1), source="client/</script><b>"))
    html = picker_html(found)
    (text,) = re.findall(r'<script type="application/json" id="commands-data">(.*?)</script>', html)
    data = json.loads(text)
    assert data["distributions"] == [
        {"count": 20, "p50": "11 ms", "p90": "19 ms", "p99": "20 ms", "max": "20 ms"},
    ]
    assert len(data["actuators"][0]["commands"]) == 20
    assert "<b>" not in html and "&lt;/script&gt;&lt;b&gt; motors" in html


def test_picker_without_scripts_has_the_slowest():
    found = Reactions()
    for number in range(20):
        found.add_command(command(number, latency_ms=float(number + 1)))
    html = picker_html(found)
    rows = re.findall(r'<tr><td class="n">([\d.]+)</td><td class="n">([\d.]+ ms)</td><td>(.*?)</td>', html)
    assert rows[0] == ("1.920", "20 ms", "a/device/pose pose #20 → 20 ms → a/client/Scan motors #20")
    assert len(rows) == 5 and "<noscript>" in html and "pancakes why FILE" in html
