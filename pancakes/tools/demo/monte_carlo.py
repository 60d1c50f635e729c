"""Run one demo with many seeds, in virtual time, each mission in one of several processes.

`fly_unattended` runs one mission without a view, a page or pictures. The same seed writes the same bytes as `pancakes
demo`.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing import connection, resource_tracker
from pathlib import Path
from typing import Any, Final

from pancakes.errors import PancakesError, describe
from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.demo import Comparison, Demo, Run
from pancakes.tools.demo.launcher import (
    RECORDING,
    DemoPlan,
    NetworkFaults,
    find_configs,
    fresh,
    judge,
    make_plan,
    run_of,
    run_virtual,
    write_results,
)
from pancakes.util.plugins import Plugins


@dataclass(frozen=True, slots=True)
class MissionWishes:
    """The options of a mission besides its seed; it is sent to other processes.

    Attributes:
        demo: the demo's name.
        duration_s: mission seconds; None: the demo's own length.
        configs: the folder with the agents' configurations; None: those of the demo.
        sets: changes of the configurations, as for `--set`.
        faults: whether the network has faults.
        record: whether the packets of all agents are recorded.
    """

    demo: str
    duration_s: float | None = None
    configs: Path | None = None
    sets: tuple[str, ...] = ()
    faults: bool = False
    record: bool = False


def plan_of(found: Demo, out: Path, seed: int, wishes: MissionWishes, plugins: Plugins) -> DemoPlan:
    """Plan a mission.

    Raises:
        PancakesError: a file is missing or invalid.
    """
    duration_s = found.duration_s if wishes.duration_s is None else wishes.duration_s
    recording = (f'record.path="{out / RECORDING}/{{agent}}.mcap"',) if wishes.record else ()
    configs = find_configs(found, wishes.configs)
    return make_plan(found, configs, out, seed, 1.0, duration_s, (*recording, *wishes.sets), False, plugins)


def fly_unattended(seed: int, out: Path, wishes: MissionWishes, said: list[str]) -> Mapping[str, Any]:
    """Run a mission, or all of a comparison, and judge it. The same seed writes the same bytes as `pancakes demo`.

    Args:
        seed: its seed.
        out: the folder for its results, without pictures.
        wishes: its other options.
        said: gets a sentence about each recording that is incomplete.

    Returns:
        The summary.

    Raises:
        PancakesError: the mission cannot be run.
    """
    plugins = Plugins()
    found: Demo | Comparison = plugins.get("pancakes.demos", wishes.demo)
    if isinstance(found, Demo):
        return _fly(found, seed, out, wishes, plugins, said)[1]
    fresh(out, (found.picture,))
    runs: dict[str, Run] = {}
    summaries: dict[str, Mapping[str, Any]] = {}
    timings: dict[str, Mapping[str, Any]] = {}
    for variant in found.variants:
        own = replace(wishes, sets=(*variant.sets, *wishes.sets))
        result = _fly(found.mission, seed, out / variant.name, own, plugins, said)
        runs[variant.name], summaries[variant.name], timings[variant.name] = result
    summary = found.judge(out, runs, summaries)
    write_results(out, summary, timings)
    return summary


def _fly(
    found: Demo, seed: int, out: Path, wishes: MissionWishes, plugins: Plugins, said: list[str]
) -> tuple[Run, Mapping[str, Any], Mapping[str, Any]]:
    plan = plan_of(found, out, seed, wishes, plugins)
    fresh(out, (*found.records.values(), "paths.png"))
    mission = Mission(plan.demo.agents, plan.duration_s)
    faults = NetworkFaults(seed) if wishes.faults else None
    timing = run_virtual(plan, mission, threading.Event(), faults, None, said.append)
    run = run_of(plan, mission)
    return run, judge(plan, run, timing), timing


LOOK_S: Final = 0.1
"""The period, in host time, of the check for an interruption."""
END_S: Final = 1.0
"""How long an idle process may take to end."""
PASSED: Final = "PASS"
BROKEN: Final = "ERROR"
"""The verdict on a mission that could not be run to its end."""

_spawn = multiprocessing.get_context("spawn")


@dataclass(frozen=True, slots=True)
class MissionOutcome:
    """The outcome of one mission.

    Attributes:
        seed: its seed.
        out: the folder with its results.
        verdict: `PASS` or `FAIL` from its judge; `ERROR` if it could not be run to its end.
        reasons: why it is not `PASS`, as sentences.
        summary: the summary of its judge; empty for an `ERROR`.
        said: sentences about incomplete recordings.
    """

    seed: int
    out: Path
    verdict: str
    reasons: Sequence[str]
    summary: Mapping[str, Any] = field(default_factory=dict)
    said: Sequence[str] = ()


@dataclass(eq=False, slots=True)
class _MissionProcess:
    """A process that runs one mission at a time, and its present mission."""

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
    """Run a mission for each seed, and yield the outcomes in the order in which the missions end.

    If a process dies, only its mission is lost: a new process continues with the next seed.

    Args:
        seeds: the seeds.
        folder: the results of each mission go to a folder in it that is named after the seed.
        wishes: the other options of the missions.
        jobs: the number of processes.
        interrupted: returns whether to begin no more missions and to end the running ones.
        prepare: called first in each process; it must be picklable.
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
    # Ctrl-C reaches all processes of a terminal, but only this one should handle it, and end the others. So they
    # inherit a blocked SIGINT. Python's resource tracker must run before that: starting it would unblock the signal.
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
        pass  # the process has ended: `_take` finds that out


def _take(worker: _MissionProcess) -> MissionOutcome:
    """Return the outcome that a process sends, or that of a process that has ended."""
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
    worker.pipe.close()  # tells the process that no more missions come
    worker.process.join(END_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
    worker.process.close()


def _serve(pipe: connection.Connection, wishes: MissionWishes, prepare: Callable[[], None]) -> None:
    """Run the missions that the pipe brings, until it is closed. This is the main function of a process."""
    os.dup2(2, 1)  # keep the output of plug-ins out of the results
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
    except Exception as error:  # a broken mission must not end the other missions
        return MissionOutcome(seed, out, BROKEN, (describe(error),), {}, said)
    return MissionOutcome(seed, out, str(summary["verdict"]), tuple(summary["reasons"]), summary, said)
