"""`scripts/bench` keeps what it has measured, however it ends, and refuses at once what it could not do."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pykka
import pytest
from benchmarks import big_world, fan_out, virtual_mission
from benchmarks.__main__ import bench
from benchmarks.figure import Figure, Plan
from click.testing import CliRunner, Result


class Bench:
    """Runs the command with topics that are made up: `fan_out` ends with an error, `fleet` does not."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, directory: Path) -> None:
        self.file = directory / "figures.json"
        self.error: BaseException = RuntimeError("a process ended before it had reported anything")
        monkeypatch.setitem(sys.modules, "benchmarks.fan_out", SimpleNamespace(TITLE="one", measure=self.breaks))
        monkeypatch.setitem(sys.modules, "benchmarks.fleet", SimpleNamespace(TITLE="two", measure=self.ends))

    def breaks(self, plan: Plan) -> Iterator[Figure]:
        yield Figure("before the error", "ms", runs=[1.0, 2.0])
        raise self.error

    def ends(self, plan: Plan) -> Iterator[Figure]:
        yield Figure("measured once", "ms", runs=[3.0])

    def run(self, *options: str) -> Result:
        return CliRunner().invoke(bench, ["--only", "fan_out", "--only", "fleet", "--json", str(self.file), *options])

    def names(self) -> list[str]:
        return [record["name"] for record in json.loads(self.file.read_text())]


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bench:
    return Bench(monkeypatch, tmp_path)


def test_a_topic_that_fails_is_told_and_the_others_are_measured(made_up: Bench) -> None:
    result = made_up.run()
    assert result.exit_code == 1
    assert "fan_out failed: RuntimeError: a process ended before it had reported anything\n" in result.output
    assert made_up.names() == ["before the error", "fan_out", "measured once"]
    assert "failed" in json.loads(made_up.file.read_text())[1]


def test_a_row_of_one_run_says_so(made_up: Bench) -> None:
    rows = {line.split("  ")[0]: line for line in made_up.run().output.splitlines()}
    assert rows["measured once"].endswith("(one run)")
    assert rows["before the error"].endswith("(1 to 2)")


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (SystemExit(143), 143)])
def test_an_interrupted_run_keeps_what_it_has(made_up: Bench, error: BaseException, code: int) -> None:
    made_up.error = error
    result = made_up.run()
    assert result.exit_code == code and "measured once" not in result.output
    assert result.output.endswith("\ninterrupted\n") is (code == 130)
    assert made_up.names() == ["before the error"]


def test_peers_are_measured_beside_what_is_named(made_up: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, topic in enumerate(("peer_pairs", "peer_crowds")):
        found = Figure(topic, "ms", runs=[float(number)])
        made = SimpleNamespace(TITLE=topic, measure=lambda plan, found=found: iter([found]))
        monkeypatch.setitem(sys.modules, f"benchmarks.{topic}", made)
    made_up.run("--only", "peer_pairs", "--peers")
    assert made_up.names() == ["before the error", "fan_out", "measured once", "peer_pairs", "peer_crowds"]


def test_the_head_says_how_often_is_measured(made_up: Bench) -> None:
    assert "medians of 5 runs in turns, of 9 where they differ much\n" in made_up.run().output
    assert "medians of 5 runs in turns\n" in made_up.run("--quick").output
    assert "medians of 12 runs in turns\n" in made_up.run("--rounds", "12").output


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--rounds", "4"], "4 is not in the range x>=5"),
        (["--json", "{here}/none/figures.json"], "there is no directory '{here}/none'"),
        (["--json", "{here}"], "is a directory"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_measured(
    made_up: Bench, tmp_path: Path, options: list[str], sentence: str
) -> None:
    result = made_up.run(*(option.format(here=tmp_path) for option in options))
    assert result.exit_code == 2
    assert sentence.format(here=tmp_path) in result.output
    assert "medians" not in result.output


def test_missions_that_differ_much_are_flown_more_often_each_with_a_seed_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(virtual_mission, "mission", lambda seed, share: float(seed))
    (figure,) = virtual_mission.measure(Plan(rounds=5, most_rounds=9))
    assert figure.runs == [float(seed) for seed in range(1, 10)]


def test_worlds_of_which_something_is_wanted_are_measured_more_often_where_they_differ_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    percent = iter(range(1, 100))
    monkeypatch.setattr(big_world, "world", lambda robots, duration_s: [float(next(percent)), 1.0, 1.0, 1.0])
    monkeypatch.setattr(big_world, "simulation_alone", lambda robots, duration_s: 1.0)
    runs = {figure.name: len(figure.runs) for figure in big_world.measure(Plan(rounds=5, most_rounds=9))}
    of_processor = {name: count for name, count in runs.items() if name.endswith(": processor")}
    assert list(of_processor.values()) == [1, 9, 1, 1] and list(of_processor)[2] == "300 robots: processor"
    assert runs["100 robots: the simulation alone"] == 9


def test_an_interrupted_baseline_leaves_no_actors_that_keep_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(fan_out.Countdown, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fan_out.stock_pykka(3, 10)
    assert not pykka.ActorRegistry.get_by_class(fan_out.StockActor)
