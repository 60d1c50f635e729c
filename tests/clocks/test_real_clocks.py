"""Real processes whose monotonic clocks differ (time namespaces), and whose times of day do (libfaketime)."""

from __future__ import annotations

import json
import os
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from cli.processes import INSECURE, READY, Rig, Running
from clocks.other_clocks import day_ahead, monotonic_ahead

AHEAD_S = 250_000
ENOUGH = 120

PLUGIN = """
import json
from dataclasses import dataclass

from pancakes.packet import packet_type
from pancakes.task import Task, every, on


@packet_type("clocks.pulse")
@dataclass(frozen=True)
class ClockPulse:
    zero_s: float


class PulseTold(Task):
    @every(hz=20)
    def tick(self, tick):
        self.publish("network", ClockPulse(self._actor.kernel.mission.host_time(0.0)), to="*")


class PulseHeard(Task):
    def on_start(self):
        self.rows = []

    @on("network", ClockPulse, queue=256)
    def on_pulse(self, packet):
        local = self.local_time(packet)
        if local is None:
            return
        link = next(row for row in self._actor.kernel.links() if row["name"] == packet.source.partition("/")[0])
        self.rows.append([packet.body.zero_s + packet.stamp_s, self._actor.kernel.mission.host_time(0.0), local.time_s,
                          local.bound_s, packet.age_s, link["rtt_s"]])
        if len(self.rows) == ENOUGH:
            with open("heard.json", "w") as file:
                json.dump(self.rows, file)
            self.log("info", "heard enough")
""".replace("ENOUGH", str(ENOUGH))

ENTRY_POINTS = """[pancakes.tasks]
clocks.told = plugin_clocks:PulseTold
clocks.heard = plugin_clocks:PulseHeard
[pancakes.packets]
clocks = plugin_clocks
"""


class ClockRig:
    """Starts agents whose clocks are other than the machine's."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        rig.install("clocks", ENTRY_POINTS, PLUGIN)
        self._running: list[Running] = []

    def agent(
        self,
        name: str,
        task: str = "",
        before: Sequence[str] = (),
        peers: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> str:
        """Starts an agent, and returns its address once it is ready."""
        # A busy machine may take more than the second that an agent waits for its fleet by default.
        rest = INSECURE + "\n[clock]\njoin_s = 30\n" + (f'\n[task.{task}]\ntype = "clocks.{task}"\n' if task else "")
        agent = f"peers = {json.dumps([*peers])}\nbirth_wait_s = 0\n"
        config = self.rig.config(name, rest, agent=agent)
        command = [*before, sys.executable, "-m", "pancakes.tools.cli.agent_command", "--config", str(config)]
        # A library that LD_PRELOAD names is only loaded by a process that truly starts.
        variables = {**self.rig.environment, **(environment or {})}
        running = Running(command, variables, self.rig.directory, true_start="LD_PRELOAD" in variables)
        self._running.append(running)
        running.hear(READY)
        self.last = running
        return self.rig.address(running)

    def close(self) -> None:
        for running in self._running:
            running.close()


@pytest.fixture
def clocks(rig: Rig) -> Iterator[ClockRig]:
    made = ClockRig(rig)
    yield made
    made.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


def test_real_clocks_error_below_half_a_round_trip(clocks: ClockRig) -> None:
    """And a fifth of a millisecond. The true offset is known: it is that of the namespace, on one machine's clock."""
    told = clocks.agent("told", "told", monotonic_ahead(AHEAD_S))
    environment = day_ahead("-365d", clocks.rig.directory)
    clocks.agent("heard", "heard", peers=[told], environment=environment)
    clocks.last.hear("heard enough")
    rows = json.loads((clocks.rig.directory / "heard.json").read_text())
    errors_s, bounds_s, halves_s = [], [], []
    for published_s, own_zero_s, local_s, bound_s, age_s, rtt_s in rows:
        truth_s = published_s - AHEAD_S - own_zero_s
        error_s = abs(local_s - truth_s)
        assert error_s <= bound_s + 1e-6
        assert error_s < rtt_s / 2 + 0.0002
        assert age_s >= 0.0
        errors_s.append(error_s)
        bounds_s.append(bound_s)
        halves_s.append(rtt_s / 2)
    if path := os.environ.get("CLOCK_FIGURES"):
        figures = {"error_us": errors_s, "bound_us": bounds_s, "half_round_trip_us": halves_s}
        text = {name: [round(1e6 * f(values), 1) for f in (statistics.median, max)] for name, values in figures.items()}
        Path(path).write_text(json.dumps(text))


def test_real_clocks_mission_with_another_monotonic_clock(clocks: ClockRig) -> None:
    """It comes back, and what it writes down has the time of day beside that of the mission."""
    first = clocks.agent("first", "told")
    clocks.agent("second", "heard", monotonic_ahead(AHEAD_S), peers=[first])
    bound_s = float(clocks.last.hear("mission_joined peer=first").rpartition("bound_s=")[2])
    assert bound_s == round(bound_s, 6)
    clocks.last.hear("heard enough")
    described = [
        json.loads(clocks.rig.pancakes("agent", "info", name, "--format", "json").stdout)[0]
        for name in ("first", "second")
    ]
    times_s = {row["agent"]: row["mission_s"] for row in described}
    assert times_s["second"] >= times_s["first"] > 3.0, "the second is asked later"
    (link,) = [peer for row in described if row["agent"] == "second" for peer in row["mesh"]["peers"] if peer["clock"]]
    assert abs(link["clock"]["mission_ahead_s"]) <= bound_s + link["clock"]["bound_s"] + 1e-6
    assert link["clock"]["offset_s"] == pytest.approx(-AHEAD_S, abs=0.01)
    assert abs(link["clock"]["day_ahead_s"]) < 0.05


def test_real_clocks_doctor_names_the_day_that_is_off(clocks: ClockRig) -> None:
    first = clocks.agent("first")
    second = clocks.agent("second", peers=[first])
    clocks.agent("third", peers=[first, second], environment=day_ahead("-365d", clocks.rig.directory))
    found = json.loads(clocks.rig.pancakes("doctor", "--no-machine", "--format", "json").stdout)
    (off,) = [row for row in found if "time of day" in row["text"]]
    host = os.uname().nodename
    expected = (
        f"the time of day of {host}, on which third runs, is 1.0 years behind that of first, second and this machine"
    )
    assert (off["level"], off["about"], off["text"]) == ("warning", "third", expected)
    assert off["advice"].startswith(f"see timedatectl on {host}; ")
