"""`scripts/soak` refuses at once what it could not do, instead of leaving it out, or failing after an hour."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from soak import __main__ as command


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--steady", "--virtual"], "--steady and --virtual are two runs"),
        (["--steady", "--leak", "1"], "--leak is neither for --steady nor for --virtual"),
        (["--virtual", "--leak", "1"], "--leak is neither for --steady nor for --virtual"),
        (["--steady", "--seed", "1"], "--seed is not for --steady"),
        (["--json", "{here}/none/figures.json"], "there is no directory '{here}/none'"),
        (["--json", "{here}"], "is a directory"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, options: list[str], sentence: str
) -> None:
    monkeypatch.setattr(command, "names_of", None)  # a fleet that is made all the same is none
    monkeypatch.setattr(command, "steady", None)
    monkeypatch.setattr(command, "virtual", None)
    result = CliRunner().invoke(command.soak, [option.format(here=tmp_path) for option in options])
    assert result.exit_code == 2
    assert sentence.format(here=tmp_path) in result.output


def test_figures_tell_the_seed_where_there_is_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seeds = []

    def virtual(agents: int, duration_s: float, seed: int) -> tuple[dict[str, int], list[str]]:
        seeds.append(seed)
        return {"agents": agents}, []

    monkeypatch.setattr(command, "virtual_figures", virtual)
    monkeypatch.setattr(command, "steady_figures", lambda directory, agents, _: ({"agents": agents}, ["a lost b"]))
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.soak, ["--virtual", "--json", str(path)])
    assert (result.exit_code, seeds) == (0, [1])
    assert '"seed": 1' in path.read_text()
    result = CliRunner().invoke(command.soak, ["--steady", "--json", str(path)])
    assert result.exit_code == 1 and "FAULT: a lost b" in result.output
    assert '"seed": null' in path.read_text()
