"""Whatever ends a run of `scripts/torture` ends its agents too."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks.agent_process import PYTHON_PATH
from cli.processes import Rig, Running
from click.testing import CliRunner
from torture import __main__ as command
from torture import load_commands, load_fleet

LOADED = "from torture.load_fleet import LoadedFleet; fleet = LoadedFleet(Path(sys.argv[1]), {'a': {}})"
LIVE = (
    "from torture.live import LiveFleet; fleet = LiveFleet(Path(sys.argv[1]), ['a'], {}); fleet.start('a', wait=True)"
)
RUN = "import sys\nfrom pathlib import Path\n{fleet}\nprint(fleet.running['a'].pid, flush=True)\nsys.stdin.read()"


@pytest.mark.usefixtures("handlers")
def test_every_command_may_be_asked_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    cleared_up = []

    def runs(*_: Any) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            cleared_up.append(True)

    signal.signal(signal.SIGTERM, lambda *_: None)  # a command that does not take it goes on, and so does pytest
    monkeypatch.setattr(load_commands, "slow_peer_rows", runs)
    result = CliRunner().invoke(command.torture, ["load", "--only", "peers"])
    assert (result.exit_code, cleared_up) == (128 + signal.SIGTERM, [True])


def test_agents_of_a_fleet_that_does_not_come_together_are_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    started: list[Running] = []
    agent = Rig.agent

    def starts(self: Rig, *arguments: Any, **options: Any) -> Running:
        started.append(agent(self, *arguments, **options))
        return started[-1]

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Rig, "agent", starts)
    monkeypatch.setattr(load_fleet, "Client", interrupted)
    with pytest.raises(KeyboardInterrupt):
        load_fleet.LoadedFleet(tmp_path, {"a": {}})
    assert [running.process.poll() is None for running in started] == [False]


@pytest.mark.skipif(sys.platform != "linux", reason="--die-with-parent works on Linux alone")
@pytest.mark.parametrize("fleet", [LOADED, LIVE], ids=["loaded", "live"])
def test_agents_are_not_interrupted_with_their_run_but_end_with_it(tmp_path: Path, fleet: str) -> None:
    run = subprocess.Popen(
        [sys.executable, "-c", RUN.format(fleet=fleet), str(tmp_path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(PYTHON_PATH)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    pid = int(run.stdout.readline())
    agent = os.pidfd_open(pid)
    try:
        # Ctrl-C at a terminal is for all of the run's process group.
        assert os.getpgid(pid) != os.getpgid(run.pid)
        run.kill()
        run.communicate(timeout=20)
        assert select.select([agent], [], [], 10.0)[0]
    finally:
        os.close(agent)
