"""Whatever ends a run of `scripts/torture` ends its agents too."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig, Running
from click.testing import CliRunner
from torture import __main__ as command
from torture import load_commands, load_fleet
from torture.ending import interruptible

LOADED = "from torture.load_fleet import LoadedFleet; fleet = LoadedFleet(Path(sys.argv[1]), {'a': {}})"
LIVE = (
    "from torture.live import LiveFleet; fleet = LiveFleet(Path(sys.argv[1]), ['a'], {}); fleet.start('a', wait=True)"
)
RUN = "import sys\nfrom pathlib import Path\n{fleet}\nprint(fleet.running['a'].pid, flush=True)\nsys.stdin.read()"


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Gives the signals back to pytest, however a test fails."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_who_is_asked_to_end_clears_up_first(number: signal.Signals) -> None:
    signal.signal(number, signal.SIG_DFL)
    with pytest.raises(SystemExit) as ended, interruptible():
        signal.raise_signal(number)
    assert ended.value.code == 128 + number
    assert signal.getsignal(number) is signal.SIG_DFL


def test_what_nohup_ignores_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with interruptible():
        signal.raise_signal(signal.SIGHUP)


def test_every_command_may_be_asked_to_end(monkeypatch: pytest.MonkeyPatch) -> None:
    cleared_up = []

    def runs(*_: Any) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            cleared_up.append(True)

    signal.signal(signal.SIGTERM, lambda *_: None)  # a command that does not take it goes on, and so does pytest
    monkeypatch.setattr(load_commands, "_slow_peers", runs)
    result = CliRunner().invoke(command.torture, ["load", "--only", "peers"])
    assert (result.exit_code, cleared_up) == (128 + signal.SIGTERM, [True])


def test_agents_of_a_fleet_that_does_not_come_together_are_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    started: list[Running] = []
    agent = Rig.agent

    def starts(self: Rig, *arguments: Any) -> Running:
        started.append(agent(self, *arguments))
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
def test_the_agents_of_a_run_that_is_killed_end_by_themselves(tmp_path: Path, fleet: str) -> None:
    run = subprocess.Popen(
        [sys.executable, "-c", RUN.format(fleet=fleet), str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    agent = os.pidfd_open(int(run.stdout.readline()))
    try:
        run.kill()
        run.communicate(timeout=20)
        assert select.select([agent], [], [], 10.0)[0]
    finally:
        os.close(agent)
