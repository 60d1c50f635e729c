"""A mission in virtual time that is recorded is the same mission to the byte."""

import pytest
from demo.flights import fly

from pancakes.recording.reader import RecordingReader
from pancakes.util.plugins import Plugins

FILES = ("trajectory.csv", "events.jsonl", "summary.json")


@pytest.mark.cpu_limit(60)  # two whole missions
def test_recorded_mission_is_the_same_to_the_byte(tmp_path):
    Plugins().load_packets()
    fly("encirclement", 3, tmp_path / "plain", faults=True)
    out = tmp_path / "recorded"
    flight = fly("encirclement", 3, out, faults=True, sets=[f'record.path="{out}/recording/{{agent}}.mcap"'])
    for name in FILES:
        assert (out / name).read_bytes() == (tmp_path / "plain" / name).read_bytes(), name
    reader = RecordingReader(out / "recording")
    time = reader.mission_time()
    last = {}
    for entry in reader.entries():
        last[entry.agent] = time.at(entry.time_ns)
    assert set(last) == {"world", "agent1", "agent2", "sensor"}
    assert time.known
    for agent, last_s in last.items():
        assert last_s > flight.timing["times_real_time"] * flight.timing["wall_s"] - 1.0, agent
