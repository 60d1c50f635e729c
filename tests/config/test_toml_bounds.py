"""Configurations that no person writes: a sentence each, in no time, and in little memory."""

import pytest

from pancakes.config import parse
from pancakes.errors import ConfigError
from pancakes.util.toml import MOST_CHARACTERS, MOST_PARTS, toml_values

HEAD = 'schema = 1\n\n[agent]\nname = "a"\n'


@pytest.mark.parametrize(
    ("rest", "fault"),
    [
        ("seed = " + "9" * 100_000, "a.toml:5: TOML: an integer lies far beyond what can be saved"),
        ("seed = 0x" + "f" * 10_000, "a.toml:5: TOML: seed lies far beyond what can be saved"),
        ("peers = " + "[" * 5000 + "]" * 5000, "a.toml: TOML: is nested too deeply"),
        ("x = " + "{a = " * 5000 + "1" + "}" * 5000, "a.toml: TOML: is nested too deeply"),
        ("x" + ".b" * 20_000 + " = 1", f"a.toml:5: TOML: a key has more than {MOST_PARTS} parts"),
        ("[x" + ".b" * 20_000 + "]", f"a.toml:5: TOML: a key has more than {MOST_PARTS} parts"),
        ("x = {b" + ' . "c"' * 20_000 + " = 1}", f"a.toml:5: TOML: a key has more than {MOST_PARTS} parts"),
        ("#" * MOST_CHARACTERS, "a.toml: TOML: has 1,048,607 characters, but at most 1,048,576 are allowed"),
    ],
    ids=["digits", "hexadecimal", "lists", "tables", "key", "header", "inline", "length"],
)
def test_what_is_beyond_all_bounds_is_a_sentence(rest, fault):
    with pytest.raises(ConfigError) as error:
        parse(HEAD + rest, "a.toml")
    assert str(error.value) == fault


def test_thousands_of_tables_are_checked():
    """The limit of a test's CPU time refuses what grows with the square of their number."""
    tables = "".join(f"[task.T{number}.migrate.x]\nx = 1\n" for number in range(3000))
    with pytest.raises(ConfigError) as error:
        parse(HEAD + tables, "a.toml")
    assert len(error.value.faults) >= 3000


def test_what_people_write_is_within_the_bounds():
    assert toml_values(f"seed = {2**63 - 1}\nlow = {-(2**63)}\n") == {"seed": 2**63 - 1, "low": -(2**63)}
    assert toml_values('text = "' + "1.2." * 50 + '"\n')["text"].startswith("1.2.")
    deepest = ".".join(["k"] * MOST_PARTS)
    assert toml_values(f"[{deepest}]\nx = 1\n")


def test_a_change_on_the_command_line_beyond_the_bounds_is_text():
    with pytest.raises(ConfigError, match=r"--set agent\.seed=999"):
        parse(HEAD, "a.toml", ["agent.seed=" + "9" * 100_000])
