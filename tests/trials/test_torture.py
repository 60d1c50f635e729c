"""`scripts/torture`: a healthy system passes, a broken one is convicted, and nothing of a run is left behind.

`tests/faults` runs its faults against real agents.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from click.testing import CliRunner
from seeded import for_each
from torture import __main__ as command
from torture import (
    gate_command,
    goals_command,
    live_commands,
    load_commands,
    safety_commands,
    standstill_command,
    storm_command,
    takeover_command,
)
from torture.collisions import Outcome as Collided
from torture.cuts import Case as Cut
from torture.fuzz import Fuzzed, unsound
from torture.gap import Gaps
from torture.gates import BALLAST_BYTES
from torture.goals import GoalTally
from torture.halts import Halting
from torture.late_acts import LateTally, late_between
from torture.missions import Job, fly
from torture.missions import Outcome as Flown
from torture.namespaces import NAMED, Namespaces, NoNamespaces, check
from torture.points import Point
from torture.proxy import Verdict
from torture.schedules import Outcome as Scheduled
from torture.storms import StormEnd
from torture.strokes import KINDS
from torture.takeover_tally import Heard, TakeoverTally, Traces
from torture.tally import Tally
from torture.traps import Field, Trap

from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Standing
from pancakes.durable.store import RECORD
from pancakes.journal import FileJournal, JournalEntry, JournalError

TASK = TaskId("a", "One")


def test_torture_schedules_run_and_write_their_figures(program: Any, tmp_path: Path) -> None:
    """By the real command: its workers must find what they run."""
    figures = tmp_path / "figures.json"
    ended = program("torture", "schedules", "--first", "3", "--seeds", "2", "--jobs", "2", "--json", figures)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = json.loads(figures.read_text())
    assert (found["schedules"], found["violations"]) == (2, {}) and found["counts"]["moved"] > 0


class Judged(NamedTuple):
    """A command of `scripts/torture`, and the source of its figures, with or without a fault."""

    arguments: str
    module: Any
    name: str
    make: Callable[[bool], Any]
    needs: str = ""
    """What else of the module the command enters, which this machine may not have."""


def flown(broken: bool) -> Any:
    summary = {"verdict": "FAIL", "reasons": ["nobody drove"]} if broken else {"verdict": "PASS", "reasons": []}
    return lambda *_: [Flown(Job("encirclement", 7, Path()), summary, 1.0)]


def killed(broken: bool) -> Any:
    def run(random_kills: int, points: list[Point], *_: Any) -> Tally:
        missed = ["no agent came to the point"] * broken
        return Tally(kills=6, points=Counter(point.name for point in points), heals_s=[1.0], missed=missed)

    return run


def cut(broken: bool) -> Any:
    cases = [Cut("commit", "heals at once", "a", "b", 1.0, ("it runs twice",) * broken)]
    return lambda survey: SimpleNamespace(run=lambda *_: cases)


def stormy(violated: bool, caught: bool) -> Any:
    def run(seeds: Any, apart: float, jobs: int) -> list[StormEnd]:
        too_far = apart == storm_command.UNSOUND
        violation = "two act" if violated and not too_far else ""
        return [StormEnd(seed, violation, two=too_far and caught) for seed in seeds]

    return run


def taken_over(broken: bool) -> Any:
    tally = TakeoverTally(Counter(KINDS), standstills=["none acts"] * broken)
    return lambda *_, **__: SimpleNamespace(run=lambda *_: tally)


def stood_still(broken: bool) -> Any:
    return lambda seed, dumps: {"seed": seed, "gaps": {"pool": 1} if broken else {}, "looks": 700, "late": 1}


def collided(broken: bool) -> Any:
    return lambda missions, jobs: [
        Collided(it, int(broken or not it.filtered), 0, 0.1, 1.0, 1e-4, 2e-4, 0.0) for it in missions
    ]


def halted(broken: bool) -> Any:
    return lambda *_: [Halting(("r1", "r2"), (0.1, 0.6 if broken else 0.2), ()), Halting(("r1",), (0.1,), ())]


def drove(on: bool, late: bool) -> GoalTally:
    tally = GoalTally(stood_s=[0.1, 0.2], began_s=[2.1], late_s=[2.0])
    tally.kills["SIGKILL"] += 2
    tally.drove_on += ["its robot stood after 9 s"] * on
    tally.wrong += ["the next robot began after 4 s"] * late
    return tally


JUDGED = (
    Judged("missions --seeds 1", command, "fly_all", flown),
    Judged(
        "schedules --seeds 2",
        command,
        "run_schedules",
        lambda broken: lambda *_: [Scheduled(3), Scheduled(4, "One runs twice" * broken)],
    ),
    Judged(
        "fuzz", command, "fuzz_agent", lambda broken: lambda *_: Fuzzed(9, 2, 1.0, ["a task has a defect"] * broken)
    ),
    Judged("kills --kills 6", live_commands, "run_fleets", killed),
    Judged("cuts --no-netns", live_commands, "Cutter", cut),
    Judged(
        "gap --no-netns",
        live_commands,
        "measure",
        lambda broken: lambda size, *_: Gaps(size, [0.02, 0.06 if broken else 0.03], [], []),
    ),
    Judged(
        "gap --no-netns",
        live_commands,
        "measure",
        lambda broken: lambda size, *_: Gaps(size, [0.02], ["right: it refused"] * broken, [2.1] * broken),
    ),
    Judged(
        "gate --stops 2",
        gate_command,
        "run_late_acts",
        lambda broken: lambda *_: LateTally(2, [1, 1 + broken], [1, 0], [1, 0], [0, 0], 500, [0.1, 0.2]),
    ),
    Judged("load --only peers", load_commands, "slow_peer_rows", lambda broken: lambda *_: [{"faults": [1] * broken}]),
    Judged("standstill --seconds 3", standstill_command, "run_round", stood_still),
    Judged("storms --seeds 2", storm_command, "run_storms", lambda broken: stormy(violated=broken, caught=True)),
    Judged("storms --seeds 2", storm_command, "run_storms", lambda broken: stormy(violated=False, caught=not broken)),
    Judged("takeovers --faults 12", takeover_command, "Takeovers", taken_over),
    Judged("goals --kills 2", goals_command, "kill_agents", lambda broken: lambda *_: drove(on=broken, late=False)),
    Judged("goals --kills 2", goals_command, "kill_agents", lambda broken: lambda *_: drove(on=False, late=broken)),
    Judged("collisions --missions 2 --judge own", safety_commands, "fly_all", collided),
    Judged("halts --rounds 2", safety_commands, "halt_often", halted, needs="namespaces"),
)


def test_torture_commands_convict_only_what_is_broken(tmp_path: Path) -> None:
    """The exit code is 1 if there is a fault, otherwise 0; the figures are written in both cases."""
    file = tmp_path / "figures.json"

    def judge(case: Judged) -> None:
        for broken in (False, True):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(case.module, case.name, case.make(broken))
                if case.needs:
                    patch.setattr(case.module, case.needs, lambda *_: nullcontext((object(), [])))
                clock = SimpleNamespace(monotonic=iter(range(100)).__next__)
                patch.setattr(standstill_command, "time", clock)
                result = CliRunner().invoke(command.torture, [*case.arguments.split(), "--json", str(file)])
            assert result.exit_code == int(broken), f"broken: {broken}, {result.output}"
            assert isinstance(result.exception, SystemExit | None) and json.loads(file.read_text())
            file.unlink()

    assert {case.arguments.split()[0] for case in JUDGED} == set(command.torture.commands)
    for_each(JUDGED, judge)


def test_torture_missions_that_break_down_fail(tmp_path: Path) -> None:
    outcome = fly(Job("no such demo", 1, tmp_path))
    assert outcome.summary["verdict"] == "FAIL" and "no such demo" in outcome.summary["reasons"][0]
    assert CliRunner().invoke(command.torture, ["missions", "--demo", "encirclment"]).exit_code == 2


def test_torture_tally_finds_doubled_lost_and_backwards(tmp_path: Path) -> None:
    def count(durability: str, **files: str) -> Tally:
        for kind, text in files.items():
            (tmp_path / f"One.{kind}").write_text(text)
        tally = Tally()
        tally.count(tmp_path, {"One": durability})
        return tally

    good = count("each", count="1 0 a 7\n2 1 b 8\n3 1 b 8\n2 1 b 9\n", heard="1 0\n2 1\n2 1\n")
    assert (good.doubled, good.lost, good.backwards) == ([], [], [])
    assert (good.moves, good.ticks, good.packets, good.worst_step_back) == (1, 4, 3, 1)
    assert count("each", count="1 1 b 7\n2 0 a 8\n").backwards == ["One ran on a (8) under 0, after 1"]
    assert count("each", heard="1 0\n1 1\n").doubled == ["One heard packet 1 although its state held 1"]
    assert count("each", heard="1 0\n3 1\n").lost == ["One heard packet 3 while its state held 1"]
    assert count("lazy", heard="1 0\n3 1\n").lost == []
    assert count("lazy", heard="", doubled="b/client/One epoch 1 runs beside another\n").doubled


def test_torture_takeovers_judge_acts_and_packets(tmp_path: Path) -> None:
    """An act under a passed epoch is late, two in a row are doubled; a packet has its effect once."""
    cases = {"0a 0a 1b 1b 2c": (0, 0), "0a 1b 0a 1b 2c 1b 2c": (2, 0)}
    cases |= {"0a 1b 0a 0a 1b": (2, 1), "1b 1c 1b 1c 1b 1b": (3, 1)}
    for epochs, (late, doubled) in cases.items():
        path, tally = tmp_path / f"{epochs}.count", TakeoverTally()
        traces = Traces(path)
        for step, epoch in enumerate(epochs.split()):
            whole = path.read_text() if path.exists() else ""
            path.write_text(f"{whole}{step} {epoch[0]} {epoch[1]} {step}\n1 1")  # the next line is on its way
            traces.read(tally)
            path.write_text(path.read_text().removesuffix("1 1"))
        assert (tally.late, tally.doubled, tally.acts) == (late, doubled, len(epochs.split())), epochs
    # A copy that is gone may have heard a packet too.
    for heard, wrong in {"1 0,2 1,3 2": 0, "1 0,2 1,2 1,3 2": 0, "1 0,2 1,2 2": 1, "1 0,3 1": 1}.items():
        path, tally = tmp_path / "One.heard", TakeoverTally()
        path.write_text(heard.replace(",", "\n") + "\n")
        Heard(path).read(tally)
        assert len(tally.wrong) == wrong, heard
    tally = TakeoverTally(Counter({"short stop": 1}), late=2)
    assert tally.failures(("short stop",)) == [] and len(tally.failures(("cut",))) == 1
    tally.late = 3
    assert len(tally.failures(())) == 1
    acts = [(10, 1), (20, 2), (30, 3), (30, 4), (40, 5)]
    assert (late_between(acts, 10, 30), late_between(acts, 40, 50)) == ([(20, 2)], [])
    assert unsound(Fuzzed(9, 2, 33.0, [])) and not unsound(Fuzzed(9, 2, 31.0, []))


def row(kind: str, source: str, to: str, task_id: Any = TASK) -> list[Any]:
    body = {"task_id": list(task_id)}
    return ["network", kind, f"{source}/client", f"{to}/client", 0.0, 1, None, body, None]


def test_torture_traps_kill_the_sender_at_its_word(tmp_path: Path) -> None:
    def trap(point: Point) -> tuple[Trap, list[str]]:
        killed: list[str] = []
        return Trap(point, Field(TASK, tmp_path, tmp_path, killed.append)), killed

    before, killed = trap(Point("", "task.promise", "lost"))
    assert before.watch(row("task.promise", "b", "c", TaskId("c", "Other"))) is Verdict.PASS
    assert before.watch(row("task.prepare", "b", "a")) is Verdict.PASS and not killed
    assert before.watch(row("task.promise", "a", "b")) is Verdict.END
    assert killed == ["a"] and before.spring(0.0) == "a"
    assert before.watch(row("system", "a", "c")) is Verdict.END, "the dead say nothing"
    assert before.watch(row("task.promise", "b", "a")) is Verdict.PASS, "one agent is killed, not two"
    after, killed = trap(Point("", "task.promise", "sent"))
    assert after.watch(row("task.promise", "a", "b")) is Verdict.PASS and killed == ["a"]
    losing, killed = trap(Point("", "task.known", "lost", lose="task.prepare"))
    assert losing.watch(row("task.prepare", "b", "a")) is Verdict.LOSE and not killed
    assert losing.watch(row("task.known", "a", "b")) is Verdict.END and killed == ["a"]


def test_torture_trap_holds_an_agent_in_its_write(tmp_path: Path) -> None:
    """The gates know where a journal has its files."""
    journal = FileJournal(tmp_path / "a")
    failures: list[str] = []

    a, b = Identity("a"), Identity("b")
    owned = Register(Epoch(0, a), 0, ((a,),), state=bytes(BALLAST_BYTES), promised=Epoch(0, a))

    def write(register: Register) -> None:
        record = Record(TASK, register, a)
        try:
            journal.write([JournalEntry(RECORD, str(TASK), record.encode())])
        except JournalError as error:
            failures.append(str(error))

    write(owned)
    killed: list[str] = []
    offered = Point("", "task.prepare", "write", Standing.OFFERED)
    trap = Trap(offered, Field(TASK, tmp_path, tmp_path, killed.append))
    assert trap.watch(row("task.prepare", "b", "a")) is Verdict.PASS
    agent = threading.Thread(target=write, args=(owned._replace(no=1, heir=b),))
    agent.start()
    assert trap.spring(10.0) == "a" and killed == ["a"] and not failures, "it waits in the write"
    trap.clear()  # in a test it lives, and its write fails
    agent.join(10.0)
    assert failures and trap.no_disk_s > 0.0
    journal.close()
    (kept,) = FileJournal(tmp_path / "a").entries(RECORD)
    assert Record.decode(kept.data).standing is Standing.OWNER


LOADED = "from torture.load_fleet import LoadedFleet; fleet = LoadedFleet(Path(sys.argv[1]), {'a': {}})"
LIVE = (
    "from torture.live import LiveFleet; fleet = LiveFleet(Path(sys.argv[1]), ['a'], {}); fleet.start('a', wait=True)"
)
RUN = "import sys\nfrom pathlib import Path\n{fleet}\nprint(fleet.running['a'].pid, flush=True)\nsys.stdin.read()"


def test_torture_agents_end_with_their_run(begun: Any, tmp_path: Path) -> None:
    """Ctrl-C at a terminal reaches the whole process group, but must not interrupt the agents."""
    for number, fleet in enumerate((LOADED, LIVE)):
        directory = tmp_path / str(number)
        directory.mkdir()
        run: subprocess.Popen[str] = begun(RUN.format(fleet=fleet), directory)
        assert run.stdout is not None
        pid = int(run.stdout.readline())
        agent = os.pidfd_open(pid)
        try:
            assert os.getpgid(pid) != os.getpgid(run.pid)
            run.kill()
            assert select.select([agent], [], [], 10.0)[0], fleet
        finally:
            os.close(agent)


IN_NAMESPACE = """
import subprocess, threading
from harness.ending import interruptible
from torture.namespaces import Namespaces
with interruptible(), Namespaces() as spaces:
    place = spaces.add()
    inside = subprocess.Popen([*place.command, "sleep", "600"], stdout=subprocess.DEVNULL)
    print(place.name, inside.pid, flush=True)
    threading.Event().wait()
"""


def test_torture_namespaces_are_removed_at_any_end(begun: Any) -> None:
    """By a run that is stopped; and by the next one, if a run was killed. A live run keeps its own."""
    try:
        check()
    except NoNamespaces as error:
        pytest.skip(str(error))

    def begin() -> tuple[subprocess.Popen[str], Path, int]:
        run: subprocess.Popen[str] = begun(IN_NAMESPACE)
        assert run.stdout is not None
        name, pid = run.stdout.readline().split()
        return run, NAMED / name, os.pidfd_open(int(pid))

    asked, killed = begin(), begin()
    assert asked[1].exists() and killed[1].exists()
    killed[0].kill()
    killed[0].wait(20)
    with Namespaces():
        assert not killed[1].exists() and asked[1].exists()
    asked[0].send_signal(signal.SIGTERM)
    asked[0].wait(20)
    assert not asked[1].exists()
    for _, _, inside in (asked, killed):
        assert select.select([inside], [], [], 10.0)[0]
        os.close(inside)


def test_torture_names_what_it_cannot_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without network namespaces the rest is run; if they are requested, this is an error."""

    def cannot() -> None:
        raise NoNamespaces("only root can make network namespaces")

    monkeypatch.setattr(live_commands, "check", cannot)
    monkeypatch.setattr(live_commands, "Cutter", cut(broken=False))
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.torture, ["cuts", "--json", str(path)])
    assert result.exit_code == 0 and "only root" in json.loads(path.read_text())["not_run"][0]
    result = CliRunner().invoke(command.torture, ["cuts", "--netns"])
    assert result.exit_code == 1 and "only root" in result.output
