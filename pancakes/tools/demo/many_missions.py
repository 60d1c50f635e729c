"""One demo under many seeds, in virtual time, each mission in one of several processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, resource_tracker
from pathlib import Path
from typing import Any, Final

from pancakes.errors import PancakesError, describe
from pancakes.tools.demo.unattended import MissionWishes, fly_unattended

LOOK_S: Final = 0.1
"""How often, in host time, it looks whether it was interrupted."""
END_S: Final = 1.0
"""How long a process has to end that has nothing more to do."""
PASSED: Final = "PASS"
BROKEN: Final = "ERROR"
"""The verdict on a mission that could not be run to its end."""

_spawn = multiprocessing.get_context("spawn")


@dataclass(frozen=True, slots=True)
class MissionOutcome:
    """What became of one mission.

    Attributes:
        seed: its seed.
        out: the folder with its results.
        verdict: `PASS` or `FAIL`, as its judge says; `ERROR` where it could not be run to its end.
        reasons: why it is not `PASS`, as sentences.
        summary: what its judge says; empty for an `ERROR`.
        said: sentences on recordings that are not as they should be.
    """

    seed: int
    out: Path
    verdict: str
    reasons: Sequence[str]
    summary: Mapping[str, Any] = field(default_factory=dict)
    said: Sequence[str] = ()


@dataclass(eq=False, slots=True)
class _MissionProcess:
    """A process that runs missions, one after the other, and the mission that it runs now."""

    process: multiprocessing.process.BaseProcess
    pipe: connection.Connection
    seed: int = -1
    out: Path = field(default_factory=Path)


def fly_many(
    seeds: Sequence[int],
    folder: Path,
    wishes: MissionWishes,
    jobs: int,
    interrupted: Callable[[], bool],
    prepare: Callable[[], None],
) -> Iterator[MissionOutcome]:
    """Runs a mission for each seed, and yields what became of each, in the order in which they end.

    A process that ends in a mission takes nothing else with it: another one goes on with the next seed.

    Args:
        seeds: the seeds.
        folder: each mission's results go to a folder below it, of its seed's name.
        wishes: what else is asked for.
        jobs: so many processes.
        interrupted: whether to begin no more missions and to end those that run.
        prepare: is called first in each process: a function that can be pickled.
    """
    waiting = deque(seeds)
    workers: list[_MissionProcess] = []
    try:
        while (waiting or workers) and not interrupted():
            while waiting and len(workers) < jobs:
                workers.append(_begin(wishes, prepare))
                _give(workers[-1], waiting.popleft(), folder)
            ready = connection.wait([worker.pipe for worker in workers], LOOK_S)
            for worker in [worker for worker in workers if worker.pipe in ready]:
                outcome = _take(worker)
                if not worker.process.is_alive() or not waiting:
                    workers.remove(worker)
                    _end(worker)
                else:
                    _give(worker, waiting.popleft(), folder)
                yield outcome
    finally:
        for worker in workers:
            worker.process.kill()
            _end(worker)


def _begin(wishes: MissionWishes, prepare: Callable[[], None]) -> _MissionProcess:
    ours, theirs = _spawn.Pipe()
    process = _spawn.Process(target=_serve, args=(theirs, wishes, prepare), daemon=True)
    # Ctrl-C reaches all processes of a terminal: the one that gives missions out ends the others. These never see it,
    # as they begin with what is blocked here; the tracker that Python starts beside the first of them would unblock it.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()
    return _MissionProcess(process, ours)


def _give(worker: _MissionProcess, seed: int, folder: Path) -> None:
    worker.seed, worker.out = seed, folder / str(seed)
    try:
        worker.pipe.send((seed, worker.out))
    except OSError:
        pass  # it has ended: that is what reading from it says


def _take(worker: _MissionProcess) -> MissionOutcome:
    """Takes what a process tells of its mission, or sees that it has ended."""
    try:
        outcome = worker.pipe.recv()
        assert isinstance(outcome, MissionOutcome)
        return outcome
    except (EOFError, OSError):
        worker.process.join(END_S)
        return MissionOutcome(worker.seed, worker.out, BROKEN, (_ended(worker.process.exitcode),))


def _ended(code: int | None) -> str:
    if code is not None and code < 0:
        try:
            by = signal.Signals(-code).name
        except ValueError:
            by = f"signal {-code}"
        hint = ": is there enough memory? --jobs runs fewer at once" if by == "SIGKILL" else ""
        return f"its process was ended by {by}{hint}"
    return f"its process ended with exit code {code}"


def _end(worker: _MissionProcess) -> None:
    worker.pipe.close()  # it reads that nothing more comes
    worker.process.join(END_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
    worker.process.close()


def _serve(pipe: connection.Connection, wishes: MissionWishes, prepare: Callable[[], None]) -> None:
    """Runs missions in a process of its own, until none is asked for any more."""
    os.dup2(2, 1)  # what a plug-in prints is no part of the results
    prepare()
    while True:
        try:
            seed, out = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            pipe.send(_outcome(seed, out, wishes))
        except OSError:
            return


def _outcome(seed: int, out: Path, wishes: MissionWishes) -> MissionOutcome:
    said: list[str] = []
    try:
        summary = fly_unattended(seed, out, wishes, said)
    except PancakesError as error:
        return MissionOutcome(seed, out, BROKEN, (str(error),), {}, said)
    except Exception as error:  # one mission that breaks takes no other with it
        return MissionOutcome(seed, out, BROKEN, (describe(error),), {}, said)
    return MissionOutcome(seed, out, str(summary["verdict"]), tuple(summary["reasons"]), summary, said)
