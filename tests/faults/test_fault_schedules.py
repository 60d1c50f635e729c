"""Two hundred fault schedules of whole virtual agents; ten thousand are run by `scripts/torture schedules`."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from click.testing import CliRunner
from torture import __main__ as command
from torture.schedules import Outcome, run_schedule

from pancakes.migration import core
from pancakes.migration.record import Phase, Record


@pytest.mark.parametrize("first", range(1, 201, 10))
def test_each_task_runs_once_at_most_and_once_in_the_end(first: int) -> None:
    counts: Counter[str] = Counter()
    for seed in range(first, first + 10):
        outcome = run_schedule(seed)
        assert not outcome.violation, f"scripts/torture schedules --first {seed} --seeds 1 --trace: {outcome.violation}"
        counts += outcome.counts
    # It was no idle talk.
    assert counts["moved"] > 5 and counts["kill"] > 5 and counts["late"] + counts["lost"] + counts["doubled"] > 20


def test_a_schedule_does_the_same_again() -> None:
    runs: list[list[str]] = [[], []]
    for lines in runs:
        run_schedule(7, lines.append)
    assert len(runs[0]) > 100 and runs[0] == runs[1]


def convicted(seeds: range) -> list[str]:
    return [outcome.violation for outcome in map(run_schedule, seeds) if outcome.violation]


def test_an_agent_that_takes_back_what_it_has_given_away_is_convicted(monkeypatch: pytest.MonkeyPatch) -> None:
    recover = core.recover

    def forgetful(record: Record, *others: Any) -> Any:
        if record.phase is Phase.COMMITTED:
            from pancakes.migration.source import taken_back

            record = taken_back(record)
        return recover(record, *others)

    monkeypatch.setattr("pancakes.migration.handoff.recover", forgetful)
    assert any(" runs on " in violation for violation in convicted(range(1, 41)))


def test_an_agent_that_forgets_what_it_was_given_is_convicted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is dormant may not be dropped by a time-out: it may have been given away."""
    from pancakes.migration import candidate

    monkeypatch.setattr(candidate, "recover", lambda record, times: [])
    monkeypatch.setattr(candidate, "resend", lambda record, event, times: [])
    monkeypatch.setattr(candidate, "commit", lambda record, event, message: [])
    assert any("after all healed" in violation for violation in convicted(range(1, 6)))


def test_a_violation_gives_exit_code_1_and_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    def one(seeds: range, jobs: int) -> list[Outcome]:
        return [Outcome(seed, violation="One runs on a and on b" if seed == 4 else "") for seed in seeds]

    monkeypatch.setattr(command, "run_schedules", one)
    result = CliRunner().invoke(command.torture, ["schedules", "--first", "3", "--seeds", "2"])
    assert result.exit_code == 1
    assert "seed 4: VIOLATION: One runs on a and on b" in result.output and "1 violations" in result.output
