"""The help of the programs: sections, whole lines, -h."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from pancakes.tools.cli.agent_command import agent
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.main import HELP, pancakes


def groups() -> Iterator[tuple[str, SectionedGroup]]:
    ctx = click.Context(pancakes)
    for name in HELP:
        command = pancakes.get_command(ctx, name)
        if isinstance(command, SectionedGroup):
            yield name, command


GROUPS = dict(groups())


@pytest.mark.parametrize("name", GROUPS)
def test_help_lists_each_verb_once(name: str):
    listed = GROUPS[name].list_commands(click.Context(pancakes))
    assert sorted(listed) == sorted(GROUPS[name].commands)


@pytest.mark.parametrize("words", [[], *([name] for name in GROUPS)], ids=" ".join)
def test_help_has_whole_lines(words: list[str]):
    result = CliRunner().invoke(pancakes, [*words, "-h"], terminal_width=80)
    assert result.exit_code == 0
    verbs = result.output.partition("Show this message and exit.")[2].splitlines()
    assert len(verbs) > 2
    for line in verbs:
        assert len(line) <= 80
        assert not line or line.endswith((".", ":")), "a line that goes on in the next one"


def test_help_of_both_programs_has_a_short_option():
    for program in (pancakes, agent):
        short, long = (CliRunner().invoke(program, [option]).output for option in ("-h", "--help"))
        assert short == long and "-h, --help" in short
