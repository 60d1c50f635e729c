"""`scripts/bench`: how it summarizes measurements, and which it saves if it is interrupted or a topic fails."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from benchmarks import crowd, lateness, short
from benchmarks.__main__ import bench
from benchmarks.compare import slower
from benchmarks.environments import SCRIPTS, Peer, PeerMissing, python_of
from benchmarks.figure import Figure, Plan, alone, in_turns_of_all
from benchmarks.observers import Compared, Round, Span, quiet
from benchmarks.peer_runs import pair
from benchmarks.profiles import summary
from click.testing import CliRunner, Result

PARTS = Path(__file__).parents[2] / "trials" / "benchmarks" / "python_parts.py"


def test_bench_keeps_what_it_has_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A failed topic is reported, and the others are measured; an interrupted run has all figures until then."""
    file = tmp_path / "figures.json"
    errors: list[BaseException] = []

    def breaks(plan: Plan) -> Iterator[Figure]:
        yield Figure("before", "ms", runs=[1.0, 2.0])
        if errors:
            raise errors[0]

    def ends(plan: Plan) -> Iterator[Figure]:
        yield Figure("after", "ms", runs=[3.0])

    monkeypatch.setitem(sys.modules, "benchmarks.fan_out", SimpleNamespace(TITLE="one", measure=breaks))
    monkeypatch.setitem(sys.modules, "benchmarks.fleet", SimpleNamespace(TITLE="two", measure=ends))

    def run(*options: str) -> tuple[Result, list[str]]:
        only = ["--only", "fan_out", "--only", "fleet", "--json", str(file)]
        result = CliRunner().invoke(bench, [*only, *options])
        return result, [record["name"] for record in json.loads(file.read_text())] if file.exists() else []

    result, names = run()
    assert (result.exit_code, names) == (0, ["before", "after"])
    errors[:] = [RuntimeError("a process ended")]
    result, names = run()
    assert (result.exit_code, names) == (1, ["before", "fan_out", "after"]) and "a process ended" in result.output
    errors[:] = [KeyboardInterrupt()]
    result, names = run()
    assert (result.exit_code, names) == (130, ["before"])
    file.unlink()
    for options in (["--rounds", "4"], ["--json", f"{tmp_path}/none/figures.json"], ["--json", str(tmp_path)]):
        result, names = run(*options)
        assert (result.exit_code, names) == (2, []), options


def test_bench_figures_are_medians_of_turns() -> None:
    """Each side begins in turn; rounds that differ much are repeated; what is wanted is of the ratio."""
    figure = Figure("x", "ns", wanted=2.0, runs=[30.0, 10.0, 20.0], bare_runs=[10.0, 10.0, 5.0])
    assert (figure.value, figure.baseline, figure.ratio, figure.spread) == (20.0, 10.0, 2.0, (1.0, 4.0))
    assert not figure.is_missed and Figure("x", "1/s", "min", 2.1, figure.runs, figure.bare_runs).is_missed
    by_itself = [Figure("x", "ms", wanted=3.0, absolute=True)]
    (figure,) = alone(Plan(rounds=3), by_itself, iter([[2.0], [5.0], [4.0]]).__next__)
    assert (figure.value, figure.ratio, figure.spread, figure.is_missed) == (4.0, None, (2.0, 5.0), True)
    order = ""

    def side(name: str) -> list[float]:
        nonlocal order
        order += name
        return [1.0]

    runs: dict[str, list[float]] = {name: [] for name in "abc"}
    sides = [(lambda name=name: side(name), [runs[name]]) for name in "abc"]
    in_turns_of_all(Plan(rounds=3), sides, [Figure("x", "s", "max", 1.0, runs["a"], runs["b"])])
    assert order == "abcbcacab"
    for differs_by, rounds in ((1.0, 5), (2.0, 9)):
        wide = Figure("x", "s", wanted=2.0)
        alone(Plan(rounds=5, most_rounds=9), [wide], iter([[1.0], [differs_by]] * 9).__next__)
        assert len(wide.runs) == rounds
    ours = Figure("modules", "")
    in_turns_of_all(
        Plan(rounds=3, most_rounds=5), [(lambda: [7.0], [ours.runs]), (lambda: [0.0], [ours.bare_runs])], [ours]
    )
    assert len(ours.runs) == 3, "what is bare has none of these"


def record(name: str, runs: list[float], bare_runs: list[float] | None = None, sense: str = "max") -> dict[str, Any]:
    return Figure(name, "ns", sense, runs=runs, bare_runs=bare_runs or []).record()


def test_compare_names_what_became_slower() -> None:
    """By more than the noise, in the value and in the ratio; new, missing or faster figures are not listed."""
    quiet_runs, bare = [10.0, 10.2, 10.1, 10.3, 9.9], [5.0] * 5
    slow_runs = [13.0, 13.2, 13.1, 13.3, 12.9]
    old = [record(name, quiet_runs, bare) for name in ("worse", "noisy", "faster", "bare")]
    old += [record("more", quiet_runs, sense="min"), record("once", [10.0]), {"name": "gone", "failed": "it broke"}]
    new = [
        record("worse", slow_runs, bare),
        record("noisy", [13.0, 9.0, 14.0, 10.0, 13.5], bare),
        record("faster", [9.0] * 5, bare),
        record("bare", quiet_runs, [3.0] * 5),
        record("more", [8.0] * 5, sense="min"),
        record("once", [12.0]),
        record("new", slow_runs),
        {"name": "gone", "missing": "it is not here"},
    ]
    assert slower(old, new) == ["worse: 2.02 -> 2.62 of the bare one", "more: 10.1 -> 8 ns"]
    assert slower(new, new) == [] == slower([], new)
    tcp, tls = (
        {"topic": topic, **record("x", [run] * 5)} for topic, run in (("two_processes", 1.0), ("tls_link", 2.0))
    )
    assert slower([tcp, tls], [tcp, tls]) == [] == slower([tls, tcp], [tcp, tls]), "each is another topic's"


def test_compare_ends_with_what_became_slower(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    runs = [1.0, 1.0]
    topic = SimpleNamespace(TITLE="one", measure=lambda plan: iter([Figure("x", "ms", runs=list(runs))]))
    monkeypatch.setitem(sys.modules, "benchmarks.fan_out", topic)
    file, other = tmp_path / "old.json", tmp_path / "other.json"
    other.write_text("{}")

    def run(*options: str | Path) -> Result:
        return CliRunner().invoke(bench, ["--only", "fan_out", *map(str, options)])

    assert run("--json", file).exit_code == 0 == run("--compare", file).exit_code
    runs[:] = [2.0, 2.0]
    result = run("--compare", file)
    assert result.exit_code == 1 and "x: 1 -> 2 ms" in result.output
    assert run("--compare", other).exit_code == 2 and "not what --json writes" in run("--compare", other).output


def test_short_form_fails_for_a_slow_step(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A step that seems slow is measured again before it fails; a step that the file lacks fails as well."""
    file = tmp_path / "cpu.json"
    took = iter([10.0] * 5 + [18.0] * 7 + [10.0] + [18.0] * 15)
    step = short.Step("a step", "ns", lambda: next(took), lambda: 5.0)
    monkeypatch.setattr(short, "FILE", file)
    monkeypatch.setattr(short, "steps", lambda: [step])

    def run(*options: str) -> int:
        return CliRunner().invoke(bench, ["--ci", *options]).exit_code

    assert run("--write") == 0 and json.loads(file.read_text()) == {"a step": 2.0}
    assert run() == 0
    assert run() == 1
    took = iter([10.0] * 5)
    file.write_text("{}")
    assert run() == 1
    assert run("--only", "fan_out") == 2 == CliRunner().invoke(bench, ["--write"]).exit_code


def test_short_form_measures_each_step_of_its_file() -> None:
    """All are measured, none is zero, and their order of magnitude is that of the file in the tree."""
    steps = {step.name: step for step in short.steps()}
    assert set(steps) == set(short.known())
    for name in ("a tick", "a task's memory", "modules of ours at the start"):
        assert 0.1 < steps[name].ours() / steps[name].bare() / short.known()[name] < 10.0


STACKS = """process 7:"agent";thread (7): main;run (pancakes/kernel/actor.py:1);put (pancakes/kernel/mailbox.py:2) 6
process 7:"agent";thread (7): main;run (pancakes/kernel/actor.py:1);encode (msgpack/packer.py:3) 2
process 8:"python -m benchmarks";thread (8): main;tell (pykka/_ref.py:4) 92"""


def test_profile_sums_up_what_pancakes_does() -> None:
    """What others do counts for the function that calls them; stacks without Pancakes do not count."""
    _, first, second = summary(STACKS.splitlines())
    assert first.split() == ["75.0%", "75.0%", "put", "(pancakes/kernel/mailbox.py:2)"]
    assert second.split() == ["25.0%", "100.0%", "run", "(pancakes/kernel/actor.py:1)"]
    start = (
        "main (pancakes/cli.py:1);<module> (pancakes/agent.py:1);<module> (pancakes/task.py:1);cache (pancakes/u.py:2)"
    )
    _, imported = summary([f"{start} 3"])
    assert imported.endswith("(modules that are imported)")
    (only,) = summary(["pykka (pykka/_ref.py:4) 92"])
    assert "nothing" in only


def test_profile_is_of_one_topic(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It runs the topic with the same options, prints the path of its file, and measures nothing itself."""
    asked: list[tuple[str, list[str]]] = []

    def taken(topic: str, command: list[str]) -> Path:
        asked.append((topic, command))
        if topic == "fleet":
            raise RuntimeError("py-spy has written nothing")
        (tmp_path / "profile").write_text(STACKS)
        return tmp_path / "profile"

    monkeypatch.setattr("benchmarks.__main__.profile", taken)
    result = CliRunner().invoke(bench, ["--profile", "fan_out", "--quick"])
    assert result.exit_code == 0 and "mailbox.py" in result.output and str(tmp_path / "profile") in result.output
    assert asked == [("fan_out", ["-m", "benchmarks", "--only", "fan_out", "--rounds", "5", "--quick"])]
    result = CliRunner().invoke(bench, ["--profile", "fleet"])
    assert result.exit_code == 1 and "py-spy has written nothing" in result.output
    for wrong in (["--ci"], ["--only", "fleet"], ["--json", f"{tmp_path}/x.json"]):
        assert CliRunner().invoke(bench, ["--profile", "fan_out", *wrong]).exit_code == 2, wrong


def observed(ratio: float, late_us: int, others_ms: float, bare_ms: float = 100.0) -> Round:
    """A round in which the machine had slowed down by a half when the observer went over to the other fleet."""
    usual_us, seen_us = [90] * 198 + [100] * 2, [90] * 393 + [late_us] * 4 + [3 * late_us] * 3
    bare = Span(bare_ms, usual_us, others_ms), Span(1.5 * bare_ms, usual_us, others_ms)
    ours = Span(bare_ms * ratio, seen_us, 50.0), Span(1.5 * bare_ms * ratio, seen_us, others_ms)
    return Round(ours, bare)


def test_bench_compares_observers_in_quiet_rounds() -> None:
    """Rounds in which others had the machine do not count; if they are all, the quieter half does."""
    processor, p99 = Compared("x", "ms"), Compared("y", "us", share=0.99)
    undisturbed = [observed(1.05, 200, 50.0) for _ in range(9)]
    disturbed = [observed(2.0, 9000, 1e6, bare_ms=300.0) for _ in range(2)]
    for measured in (*undisturbed, *disturbed):
        processor.take(measured)
        p99.take(measured)
    assert (processor.value, processor.baseline) == (pytest.approx(131.25), 125.0)
    assert processor.spread == (pytest.approx(1.05), pytest.approx(1.05))
    assert (p99.ratio, p99.spread) == (2.0, (2.0, 2.0))
    rounds = [observed(1.0, 100, 1e6 * number) for number in range(1, 6)]
    assert quiet(rounds) == rounds[:3]


def test_bench_takes_what_is_lost_for_an_error(tmp_path: Path) -> None:
    """Packets of a crowd and of a peer; missed ticks count as late. A missing peer is named."""
    assert sorted(lateness.all_there([0.1, 0.2], tasks=2, rate_hz=1.0, duration_s=3.0)) == [0.1, 0.2, 3.0, 3.0]
    shape = crowd.Shape("few", range(3), range(3), False, 600)
    reports = crowd.pancakes(shape, 600)
    assert shape.deliveries == 3600 == sum(report["received"] for report in reports.values())
    assert crowd.rate(shape, 600, reports) > 0
    reports[1]["received"] -= 1
    with pytest.raises(RuntimeError, match="1199 of 1200 packets arrived at member 1"):
        crowd.rate(shape, 600, reports)
    script = tmp_path / "over_nothing.py"
    for lost in (0, 1):
        script.write_text(PEER.format(scripts=str(SCRIPTS), lost=lost))
        peer = Peer("nothing", script, ())
        if lost:
            with pytest.raises(RuntimeError, match="99 of 100 packets arrived over nothing"):
                pair(peer, Path(sys.executable), 10, 100, 64)
        else:
            assert pair(peer, Path(sys.executable), 10, 100, 64)["received"] == 100
    missing = Peer("nowhere", SCRIPTS / "over_nowhere.py", ("no_module_of_this_name",), hint="build it yourself")
    with pytest.raises(PeerMissing, match="no_module_of_this_name.*build it yourself"):
        python_of(missing)


PEER = """
import sys
sys.path.insert(0, {scripts!r})
from talk import BODY, KIND, encode, hear, say, unpack
if sys.argv[1] == "far":
    say(at="here")
else:
    plan = hear()
    packet = unpack(encode("load", plan["packets"], bytes(plan["size"])))
    assert packet[KIND] == "load" and len(packet[BODY]["data"]) == 64
    say(times_s=[], per_s=7.0, received=packet[BODY]["number"] - {lost}, near=sys.argv[2])
hear()
"""


def test_the_parts_of_an_agent_are_measured_without_pancakes() -> None:
    """As on a Python that Pancakes cannot be installed on."""
    program = "import sys; sys.modules['pancakes'] = None; import python_parts; print(python_parts.figures(0.001))"
    ended = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(PARTS.parent)},
    )
    made = ast.literal_eval(ended.stdout)
    assert made["gil"] is True and min(it for name, it in made.items() if name not in ("python", "gil")) > 0.0
