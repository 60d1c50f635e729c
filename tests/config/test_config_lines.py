"""The line of each key, which tomlkit finds once there is a fault to report."""

import tomllib
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from pancakes.config.key_lines import lines_of_keys


def test_tables_and_keys():
    lines = lines_of_keys("a = 1\n\n# remark [x]\n[agent]  # remark\nname = 'x'\n  role = 'y'\n")

    assert lines == {("a",): 1, ("agent",): 4, ("agent", "name"): 5, ("agent", "role"): 6}


def test_dotted_quoted_and_inline_keys():
    lines = lines_of_keys("""[task."a.b"]
restart.policy = "x"
'lit.eral' = 1
settings = { x = 1, y = { z = [1, 2] } }
""")

    assert lines[("task", "a.b", "restart", "policy")] == 2
    assert lines[("task", "a.b", "lit.eral")] == 3
    assert lines[("task", "a.b", "settings", "y", "z", 1)] == 4


def test_what_looks_like_a_key_inside_of_a_string_is_none():
    lines = lines_of_keys('''a = """
b = 1
[c]
"quoted" \\""" still
"""
d = \'\'\'
e = 1\'\'\'
f = "g = 1 # \\" [h]"
i = 2
''')

    assert lines == {("a",): 1, ("d",): 6, ("f",): 8, ("i",): 9}


def test_lists_over_several_lines():
    lines = lines_of_keys("peers = [  # all\n  'a',\n\n  'b', # ]\n]\nx = 1\n")

    assert (lines[("peers", 0)], lines[("peers", 1)], lines[("x",)]) == (2, 4, 6)


def test_lists_of_tables_are_numbered():
    lines = lines_of_keys("[[a.b]]\nx = 1\n[[a.b]]\nx = 2\n[a.b.c]\ny = 3\n")

    assert (lines[("a", "b", 0, "x")], lines[("a", "b", 1, "x")], lines[("a", "b", 1, "c", "y")]) == (2, 4, 6)


def test_a_table_has_the_line_of_its_own_header():
    lines = lines_of_keys("[a.b]\nx = 1\n[a]\ny = 1\n")

    assert lines[("a",)] == 3


def test_the_table_around_others_has_the_line_of_the_first():
    lines = lines_of_keys("[a.b.c]\nx = 1\n\n[a.b]\ny.z = 1\n")

    assert (lines[("a",)], lines[("a", "b")], lines[("a", "b", "y")], lines[("a", "b", "y", "z")]) == (1, 4, 5, 5)


def test_a_text_that_tomlkit_would_write_in_another_order_has_no_lines():
    assert lines_of_keys("[[a]]\nx = 1\n[b]\n[[a]]\nx = 2\n") == {}


def test_windows_line_ends():
    assert lines_of_keys("a = 1\r\nb = 2\r\n")[("b",)] == 2


KEYS = st.text("ab.\"' é", min_size=1, max_size=4)
VALUES: Any = st.recursive(
    st.one_of(st.integers(), st.booleans(), st.text("a\"'#[]{},=\\ ")),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(KEYS, inner, max_size=3)),
    max_leaves=8,
)


def toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list):
        return "[\n" + ",\n".join(toml(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(key)} = {toml(item)}" for key, item in value.items()) + "}"
    return str(value)


def paths(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, item in items for found in ((*path, key), *paths(item, (*path, key)))]


@given(st.dictionaries(KEYS, VALUES, max_size=4))
def test_it_finds_every_key_that_the_parser_finds(values: dict[str, Any]):
    text = "".join(f"{toml(key)} = {toml(value)}\n" for key, value in values.items())
    assert tomllib.loads(text) == values

    assert sorted(lines_of_keys(text), key=repr) == sorted(paths(values), key=repr)
