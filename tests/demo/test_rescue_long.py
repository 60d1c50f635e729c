"""The rescue in processes: its results repeat byte for byte, and real agents do what virtual ones do."""

from __future__ import annotations

from pathlib import Path

from demo.flight_checks import check_copy_continues, check_only_copy
from demo.flights import read_flight
from demo.live_demo import LiveDemo
from demo.missions_in_processes import Started

from pancakes.util.plugins import Plugins

FILES = ("events.jsonl", "trajectory.csv", "summary.json")


def test_rescue_repeats_byte_for_byte_if_recorded(tmp_path: Path) -> None:
    # The mission is shorter than it should be: the verdict names that, and nothing else.
    sets = ("--seed", "2", "--duration", "170")
    with (
        Started("rescue", tmp_path / "one", 1, *sets) as one,
        Started("rescue", tmp_path / "again", 2, *sets, "--record") as again,
    ):
        assert all("of the circle was covered" in started.ends(1) for started in (one, again))
    assert len(read_flight(tmp_path / "one").summary["reasons"]) == 1
    for name in FILES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    assert (tmp_path / "one" / "paths.png").read_bytes().startswith(b"\x89PNG")
    recordings = [path for path in (tmp_path / "again" / "recording").iterdir() if path.name.startswith("agent1")]
    assert len(recordings) == 2, "one of each life"


class LiveRescue(LiveDemo):
    """`pancakes demo rescue --headless`."""

    name = "rescue"


SPEEDS = (8.0, 4.0)
"""Mission seconds a second. The second one is for a machine that, by the demo's own word, is too slow for the first."""


def test_live_rescue_survives_the_return_of_the_killed_agent(tmp_path: Path) -> None:
    for speed in SPEEDS:
        out = tmp_path / f"{speed:g}"
        said = fly_live(out, speed)
        flight = read_flight(out)
        # How soon it is taken over is the machine's; so short a mission leaves the circle uncovered.
        strange = [it for it in flight.summary["reasons"] if "first command" not in it and "was covered" not in it]
        if not strange or "this machine was too slow" not in said:
            break
    summary = flight.summary
    assert strange == [], said
    lost_s = flight.told("agent_lost", "agent1")[0]["t_s"]
    assert lost_s >= Plugins().get("pancakes.demos", "rescue").loss.times(2, 300.0)[0].at_s
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]
    assert summary["taken_by"] == "agent2" and summary["without_s"] > 0.0
    assert flight.told("agent_returned", "agent1")[0]["t_s"] < flight.told("ready", "agent1")[-1]["t_s"] < 200.0
    check_only_copy(flight, speed)
    # A checkpoint may be a second old, which is `speed` seconds of the mission.
    check_copy_continues(flight, speed)
    assert "agent1 is killed" in said and "ended with exit code" not in said


def fly_live(out: Path, speed: float) -> str:
    """Runs the mission on real processes; returns what it said."""
    with LiveRescue(out, "--speed", f"{speed:g}", "--duration", "200", "--seed", "2", "--local") as demo:
        demo.wait_for("new centre")
        first = demo.agents["agent1"].pid
        demo.wait_for("agent1 is started again, on its disk")
        assert demo.agents["agent1"].pid != first
        demo.ends()
        assert demo.left_after(0.0) == []
    return demo.said
