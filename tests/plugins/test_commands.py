"""Verbs of `pancakes` that other distributions add by entry point."""

import subprocess
import sys
from pathlib import Path

import pytest

GOOD = """
import click
from pancakes.errors import ControlRefusedError

@click.command()
@click.option("--fail", is_flag=True)
def greet(fail):
    "Greet a fleet."
    if fail:
        raise ControlRefusedError("the fleet does not want that")
    click.echo("good morning")
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory of distributions that `pancakes` finds: one with a good command and two with bad ones."""
    for name, points, source in (
        ("greeting", "greet = plugin_greeting:greet\nlog = plugin_greeting:greet\n", GOOD),
        ("broken", "crash = plugin_broken:crash\n", "import there_is_no_such_module\n"),
        ("number", "seven = plugin_number:seven\n", "seven = 7\n"),
    ):
        information = tmp_path / f"{name}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[pancakes.commands]\n{points}")
        (tmp_path / f"plugin_{name}.py").write_text(source)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


def pancakes(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "pancakes.tools.cli.main", *arguments], capture_output=True, text=True)


def test_it_runs_and_its_errors_are_sentences_as_everywhere(installed: Path):
    greeted, failed = pancakes("greet"), pancakes("greet", "--fail")

    assert (greeted.returncode, greeted.stdout, greeted.stderr) == (0, "good morning\n", "")
    assert (failed.returncode, failed.stdout, failed.stderr) == (1, "", "the fleet does not want that\n")


def test_the_help_lists_it_with_its_distribution_and_imports_none(installed: Path):
    shown = pancakes("--help")

    assert shown.returncode == 0, shown.stderr
    lines = [line.split() for line in shown.stdout.splitlines()]
    assert ["greet", "From", "greeting."] in lines
    assert ["crash", "From", "broken."] in lines


def test_one_that_cannot_be_imported_is_named_and_stops_no_other(installed: Path):
    crashed = pancakes("crash")

    assert crashed.returncode == 1
    assert crashed.stderr.startswith("the command 'crash' of broken 1.0 (plugin_broken:crash) cannot be loaded: ")
    assert "No module named 'there_is_no_such_module'" in crashed.stderr
    assert "Traceback" not in crashed.stderr
    assert pancakes("greet").returncode == 0
    assert pancakes("config", "schema").returncode == 0


def test_one_that_is_no_command_is_named(installed: Path):
    assert pancakes("seven").stderr == "the command 'seven' of number 1.0 is not a click command: 7\n"


def test_none_takes_the_name_of_a_verb_of_pancakes(installed: Path):
    assert "Show the log and the events of agents." in pancakes("--help").stdout
    assert "Log Service" in pancakes("log", "--help").stdout


def test_a_name_like_it_is_suggested(installed: Path):
    assert "Did you mean 'greet'?" in pancakes("gret").stderr
