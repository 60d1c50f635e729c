"""A command that runs for long clears up first when it is asked to end, by whichever signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
PROGRAM = """
import signal
from harness.ending import interruptible

signal.signal({number}, signal.{before})
with interruptible():
    try:
        signal.raise_signal({number})
    finally:
        print("cleared up")
assert signal.getsignal({number}) is signal.{before}
"""


def ended(number: signal.Signals, before: str) -> subprocess.CompletedProcess[str]:
    """Runs a program of its own that gets a signal: it may end the process, and pytest is not to end with it."""
    program = PROGRAM.format(number=int(number), before=before)
    environment = {**os.environ, "PYTHONPATH": str(TESTS)}
    return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)


IN_A_TURN = """
import signal
from harness.ending import interruptible
from pancakes.simulation import Simulation
from pancakes.task import Task, every

class Long(Task):
    @every(hz=10)
    def tick(self, tick):
        signal.raise_signal(signal.SIGTERM)

with interruptible(), Simulation() as simulation:
    simulation.add("robot", tasks={"Long": Long})
    simulation.reset(1)
    simulation.step(10.0)
    print("went on")
"""


def test_command_ends_in_the_midst_of_a_turn() -> None:
    """In virtual time the main thread gives the turns, and an actor outlives what an author raises in it."""
    environment = {**os.environ, "PYTHONPATH": str(TESTS)}
    result = subprocess.run([sys.executable, "-c", IN_A_TURN], env=environment, capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (128 + signal.SIGTERM, ""), result.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_asked_to_end_clears_up_first(number: signal.Signals) -> None:
    result = ended(number, "SIG_DFL")
    assert (result.returncode, result.stdout, result.stderr) == (128 + number, "cleared up\n", "")


def test_what_nohup_ignores_stays_ignored() -> None:
    result = ended(signal.SIGHUP, "SIG_IGN")
    assert (result.returncode, result.stdout, result.stderr) == (0, "cleared up\n", "")
