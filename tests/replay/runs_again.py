"""Record tasks in tests, and rerun them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from pancakes.control import Start, Stop
from pancakes.recording.reader import RecordingReader
from pancakes.tools.replay.comparison import RunComparison, Tolerance, compare
from pancakes.tools.replay.recorded_run import Script, Stay, choose_stays, find_stays, read_script
from pancakes.tools.replay.rerun import Outcome, Rerun

RECORDER = "log/Recorder"


class Again(NamedTuple):
    """A stay that was rerun."""

    stay: Stay
    script: Script
    outcome: Outcome
    comparison: RunComparison

    @property
    def kinds(self) -> list[str]:
        return [difference.kind for difference in self.comparison.differences]


@contextmanager
def recorded(path: Path, *agents: Any) -> Iterator[None]:
    """Record agents into `path/AGENT.mcap` while the block runs."""
    for agent in agents:
        reply = agent.ask(Start(RECORDER, {"path": str(path / "{agent}.mcap")}))
        assert reply.ok, reply.reason
    yield
    for agent in agents:
        assert agent.ask(Stop(RECORDER)).ok


def run_again(
    path: Path,
    task: str,
    cls: type,
    agent: str = "",
    number: int | None = None,
    live: bool = False,
    speed: float = 1.0,
    without: str = "",
    **settings: Any,
) -> Again:
    """Run the only stay of a task again that fits; `speed`: of the mission, when it was recorded live.

    Packets of the type `without` are left out, as if the recording lacked them.
    """
    entries = [entry for entry in RecordingReader(path).entries() if entry.packet.type != without]
    (stay,) = choose_stays(find_stays(entries), task, agent, number)
    script = read_script(entries, stay, cls, speed, virtual=not live)
    outcome = Rerun(stay, script, cls, settings).run()
    return Again(stay, script, outcome, compare(script.outputs, outcome.outputs, stay.task.address, Tolerance()))
