"""The usual command lines of `pancakes-agent` are read without click, and mean what click says they mean."""

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.cli.agent_command import agent
from pancakes.cli.agent_options import Options, usual

USUAL = {
    ("--config", "a.toml"): Options("a.toml"),
    ("--config=a.toml", "--set", "clock.speed=5", "--set=agent.name=b"): Options(
        "a.toml", ("clock.speed=5", "agent.name=b")
    ),
    ("--config", "a.toml", "--config", "b.toml"): Options("b.toml"),
    ("--config", "a.toml", "--die-with-parent=12", "--ready-fd=3"): Options("a.toml", parent_pid=12, ready_fd=3),
}
WORDS = ("--config", "--set", "--die-with-parent", "--ready-fd", "--check", "--record", "--", "-", "--conf", "--help")
VALUES = ("a.toml", "clock.speed=5", "", "0", "2", "3", "-1", "+4", "1_0", "٣", "--set", "-x")


def by_click(arguments):
    """What click makes of a command line; None where it refuses it, or does something else."""
    try:
        with agent.make_context("pancakes-agent", list(arguments)) as context:
            given = context.params
    except (click.ClickException, click.exceptions.Exit):
        return None
    return Options(
        given["path"], given["sets"], given["record"], given["check"], given["parent_pid"], given["ready_fd"]
    )


@pytest.mark.parametrize("arguments", USUAL, ids=" ".join)
def test_a_usual_command_line_needs_no_click(arguments):
    assert usual(arguments) == USUAL[arguments] == by_click(arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--help",),
        ("--config",),
        ("--config", "a.toml", "--check"),
        ("--config", "a.toml", "--record"),
        ("--config", "a.toml", "more"),
        ("--config", "a.toml", "--ready-fd", "2"),
        ("--config", "a.toml", "--die-with-parent"),
        ("--config", "a.toml", "--die-with-parent", "9" * 5000),
        ("--confg", "a.toml"),
    ],
    ids=lambda arguments: " ".join(arguments)[:60],
)
def test_all_others_are_left_to_click(arguments):
    assert usual(arguments) is None


word = st.sampled_from(WORDS) | st.sampled_from(VALUES)
words = st.lists(word | st.builds("{}={}".format, st.sampled_from(WORDS), st.sampled_from(VALUES)), max_size=5)


@given(words.map(lambda more: ["--config", "a.toml", *more]) | words)
def test_what_is_read_without_click_is_what_click_reads(arguments):
    read = usual(arguments)
    assert read is None or read == by_click(arguments)
