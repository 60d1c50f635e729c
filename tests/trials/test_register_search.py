"""`scripts/check-migration`: its exit code, and that it does not believe itself too easily.

The searches themselves are in `tests/register`.
"""

from __future__ import annotations

from typing import Any

import pytest
from click.testing import CliRunner
from register import __main__ as command
from register.mutants import MUTANTS, Mutant
from register.scenarios import SUITE, Scenario
from register.search import Search
from register.world import Result


def test_register_command_searches_and_convicts(program: Any) -> None:
    """By the real command: its workers must find what they search."""
    ended = program("register", "--jobs", "1", "--only", "move, letters")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "ok  move, letters" in ended.stdout and ended.stdout.rstrip().endswith(", 0 bad")
    ended = program("register", "--jobs", "1", "--mutants", "--only", MUTANTS[0].name)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert f"ok  {MUTANTS[0].name}" in ended.stdout and "1 searches" in ended.stdout


class OneByOne:
    """A pool of no processes."""

    def __enter__(self) -> OneByOne:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def imap(self, function: Any, jobs: Any) -> Any:
        return map(function, jobs)


@pytest.mark.parametrize(
    ("verdict", "mutants", "code"),
    [
        ("ok", False, 0),
        ("S1: it acts on A and on B at once", False, 1),
        ("unfinished", False, 1),
        ("S1: it acts on A and on B at once", True, 0),
        ("ok", True, 1),
        ("unfinished", True, 1),
    ],
)
def test_register_command_fails_unless_all_is_shown(
    verdict: str, mutants: bool, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = Result(verdict, 9, 9, 3, 3, {}, 1.0, ("A starts it.",))
    monkeypatch.setattr(command, "search_one", lambda job: (command.name_of(job[0]), "", result))
    monkeypatch.setattr(command.multiprocessing, "Pool", lambda *_, **__: OneByOne())
    name = MUTANTS[0].name if mutants else SUITE[0].title
    asked = ["--only", name, *(["--mutants"] if mutants else [])]
    assert CliRunner().invoke(command.main, asked).exit_code == code


def test_register_command_refuses_a_name_that_is_none() -> None:
    assert CliRunner().invoke(command.main, ["--only", "no such thing"]).exit_code == 2


def test_register_search_does_not_believe_itself() -> None:
    """It reports if it gave up, if a scenario missed its aim, and if the text that a mutant changes is gone."""
    assert Search(SUITE[0], limit=100).run().verdict == "unfinished"
    assert Search(Scenario("vain", must="B")).run().verdict == "never came to B"
    with pytest.raises(LookupError, match="'rotten' finds its text 0 times"):
        Mutant("rotten", "", (("a text that nobody wrote", ""),)).make()
