"""`scripts/check-migration`: its exit code, its figures, and that it does not believe itself too easily.

The searches themselves are in `tests/migration`, `hosting`, `guarding` and `life`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from model import __main__ as command
from model.bounds import SUITE
from model.guarded_mutants import GuardedMutant
from model.guarded_parts import Scenario
from model.guarded_scenarios import SUITE as GUARDED
from model.guarded_search import GuardedSearch
from model.hosting_mutant import HostingMutant
from model.jobs import GuardedJob, Job, Report
from model.mutants import MUTANTS, Mutant
from model.parts import Bounds
from model.search import Result, Search

from pancakes.durable import guarding


def test_model_command_searches_and_convicts(program: Any, tmp_path: Path) -> None:
    """By the real command: its workers must find what they search."""
    path = tmp_path / "figures.json"
    ended = program("model", "--jobs", "1", "--json", path, "--only", SUITE[0])
    assert ended.returncode == 0, ended.stdout + ended.stderr
    figures = json.loads(path.read_text())
    assert figures["states"] > 500 and figures["violations"] == 0 and figures["mutants"] == []
    ended = program("model", "--jobs", "1", "--json", path, "--mutants", "--only", "late NAK believed")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (mutant,) = json.loads(path.read_text())["mutants"]
    assert mutant["convicted"] and mutant["trace"][-1].startswith("That breaks S")


def result(violation: str = "", complete: bool = True) -> Result:
    return Result(violation, ("A starts it.",), states=9, transitions=9, configurations=3, complete=complete)


def test_model_command_fails_unless_all_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """A violation, a search that was given up, a mutant that escaped and one that could not be made are failures."""
    bounds, name = SUITE[0], MUTANTS[0].name
    found = {
        "sound": (Job(bounds), result(), 0),
        "broken": (Job(bounds), result("S1: two run"), 1),
        "given up": (Job(bounds), result(complete=False), 1),
        "convicted": (Job(bounds, name), result("S1: two run"), 0),
        "escaped": (Job(bounds, name), result(), 1),
        "not made": (Job(bounds, name), None, 1),
    }
    for case, (job, came, code) in found.items():
        report = Report(job, came, 1.0)
        monkeypatch.setattr(command, "run", lambda *_, report=report: [report])
        assert CliRunner().invoke(command.check_migration, []).exit_code == code, case
    unknown = CliRunner().invoke(command.check_migration, ["--only", "no such thing"])
    assert unknown.exit_code == 2 and "late NAK believed" in unknown.output


def test_model_search_does_not_believe_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """It reports if it gave up, if a scenario missed its aim, and if the text that a mutant changes is gone."""
    assert not Search(Bounds(), most_states=1000).run().complete
    assert not GuardedSearch(GUARDED["a taker, and crashes"], most_states=200).run().complete
    monkeypatch.setitem(GUARDED, "vain", Scenario("vain", takers="B", called=0, crashes=""))
    assert "never came to: B acts" in GuardedJob("vain").search().violation
    rotten = (
        Mutant("rotten", "", ((MUTANTS[0].edits[0][0], "a text that nobody wrote", ""),)),
        HostingMutant("rotten", "a text that nobody wrote", ""),
        GuardedMutant("rotten", ((guarding, "a text that nobody wrote", ""),)),
    )
    for mutant in rotten:
        with pytest.raises(LookupError, match="'rotten' finds its text 0 times"):
            mutant.make()
