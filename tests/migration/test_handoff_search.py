"""The core keeps its promises in every interleaving, and the search would see it if it did not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from benchmarks.agent_process import PYTHON_PATH
from model.bounds import DEEP, SUITE
from model.mutants import MUTANTS, Mutant
from model.parts import Bounds
from model.search import Search


@pytest.mark.parametrize("bounds", SUITE, ids=str)
def test_no_interleaving_breaks_a_promise(bounds: Bounds) -> None:
    result = Search(bounds).run()
    assert result.violation == "", "\n".join([result.violation, *result.trace])
    assert result.complete
    assert result.states > 500


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_every_mutant_is_convicted(mutant: Mutant) -> None:
    result = Search(mutant.bounds, mutant.make(), strict=False).run()
    assert result.violation, f"{mutant.story}: and nobody noticed, in {result.states} states"
    assert result.trace[0].startswith("The task is started on agent A for the first time in its life: A persists OWNER")
    assert all(sentence[0].isupper() and sentence.endswith(".") for sentence in result.trace)


def test_a_mutant_whose_text_is_gone_says_so() -> None:
    mutant = Mutant("rotten", "", ((MUTANTS[0].edits[0][0], "a text that nobody wrote", ""),))
    with pytest.raises(LookupError, match="'rotten' finds its text 0 times"):
        mutant.make()


def test_the_search_gives_up_rather_than_believe_itself() -> None:
    result = Search(Bounds(), most_states=1000).run()
    assert not result.complete and result.violation == ""


def test_a_shortest_trace_is_told_in_words() -> None:
    mutant = next(mutant for mutant in MUTANTS if mutant.name == "commit sent before it is persisted")
    result = Search(mutant.bounds, mutant.make(), strict=False).run()
    assert result.violation == "S1: the task runs on A and on B at the same time"
    assert result.trace[-2:] == (
        "Agent A receives PREPARED 1@A from B: A sends COMMIT 1@A to B, crashes, comes back as FROZEN,"
        " persists OWNER (epoch 0@A), starts the task under epoch 0@A.",
        "Agent B receives COMMIT 1@A from A: B persists OWNER (epoch 1@A), starts the task under epoch 1@A,"
        " sends ACTIVATED 1@A to A.",
    )
    assert len(result.trace) == 8


def test_bounds_and_mutants_have_names_of_their_own() -> None:
    names = [*map(str, SUITE), *map(str, DEEP), *(mutant.name for mutant in MUTANTS)]
    assert len(names) == len(dict.fromkeys(names))


@pytest.fixture
def check_migration(tmp_path: Path) -> Iterator[object]:
    def run(*arguments: str) -> tuple[int, str, dict[str, object]]:
        figures = tmp_path / "figures.json"
        done = subprocess.run(
            [sys.executable, "-m", "model", "--jobs", "1", "--json", str(figures), *arguments],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(PYTHON_PATH)},
            capture_output=True,
            text=True,
        )
        read = json.loads(figures.read_text()) if figures.exists() else {}
        return done.returncode, done.stdout + done.stderr, read

    yield run


def test_the_script_prints_and_writes_its_figures(check_migration: object) -> None:
    code, out, figures = check_migration("--only", str(SUITE[0]))  # type: ignore[operator]
    assert code == 0, out
    assert f"{figures['states']:,} states" in out and figures["violations"] == 0 and figures["mutants"] == []
    code, out, figures = check_migration("--mutants", "--only", "late NAK believed")  # type: ignore[operator]
    assert code == 0, out
    (mutant,) = figures["mutants"]
    assert mutant["name"] == "late NAK believed" and mutant["convicted"]
    assert mutant["trace"][-1].startswith("That breaks S") and mutant["trace"][0] in out


def test_the_script_knows_what_it_cannot_find(check_migration: object) -> None:
    code, out, _ = check_migration("--only", "no such thing")  # type: ignore[operator]
    assert code == 2 and "'no such thing'" in out and "late NAK believed" in out
