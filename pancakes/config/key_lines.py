"""Find the line of each key of a TOML text, and whether a `--set` overrode it, for messages.

The standard library's parser does not report lines.
"""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import Any, Final

from pancakes.errors import Fault
from pancakes.settings import dotted

KeyPath = tuple[str | int, ...]
"""The keys that lead to a value, from the outermost; an integer is a place in a list, from 0."""

_SIMPLE_KEY: Final = r"""(?:[A-Za-z0-9_-]+|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
_SIMPLE = re.compile(_SIMPLE_KEY)
_KEY = re.compile(rf"{_SIMPLE_KEY}(?:[ \t]*\.[ \t]*{_SIMPLE_KEY})*")
_BLANK = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
_STRING = re.compile(
    r'"""(?:\\.|[^\\])*?"""(?:"{0,2})' r"|'''.*?'''(?:'{0,2})" r'|"(?:\\.|[^"\\\n])*"' r"|'[^'\n]*'",
    re.DOTALL,
)
_SCALAR = re.compile(r"[^,\]}#\n]+")


def key_at(text: str, position: int = 0) -> tuple[list[str], int] | None:
    """Reads a key, such as `task."a.b".rate_hz`.

    Returns:
        The parts of the key and the position after it; None where no key begins at `position`.
    """
    found = _KEY.match(text, position)
    if not found:
        return None
    parts = []
    for simple in _SIMPLE.findall(found[0]):
        if simple[0] == '"':
            simple = tomllib.loads(f"key = {simple}")["key"]
        elif simple[0] == "'":
            simple = simple[1:-1]
        parts.append(simple)
    return parts, found.end()


def lines_of_keys(text: str) -> dict[KeyPath, int]:
    """Returns the line, from 1, of each key and table of a TOML text that has been parsed without an error."""
    return _Scanner(text.replace("\r\n", "\n")).scan()


class _Scanner:
    """Walks once through a sound TOML text. Where the text is not sound it stops, and what was found stays."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._line_starts = [0, *(found.end() for found in re.finditer("\n", text))]
        self._lines: dict[KeyPath, int] = {}
        self._lists: dict[KeyPath, int] = {}  # how many tables each `[[list of tables]]` has so far

    def scan(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        self._skip_blank()
        while self._at < len(self._text):
            start = self._at
            if self._text[self._at] == "[":
                table = self._header()
            else:
                self._pair(table)
            self._skip_blank()
            if self._at == start:
                break
        return self._lines

    def _line(self) -> int:
        return bisect_right(self._line_starts, self._at)

    def _skip_blank(self) -> None:
        found = _BLANK.match(self._text, self._at)
        self._at = found.end() if found else self._at

    def _take(self, mark: str) -> bool:
        if self._text.startswith(mark, self._at):
            self._at += len(mark)
            return True
        return False

    def _key(self) -> list[str]:
        self._skip_blank()
        found = key_at(self._text, self._at)
        if found is None:
            return []
        parts, self._at = found
        self._skip_blank()
        return parts

    def _header(self) -> KeyPath:
        line = self._line()
        is_list = self._take("[[")
        if not is_list:
            self._take("[")
        table: KeyPath = ()
        parts = self._key()
        for depth, part in enumerate(parts):
            table = (*table, part)
            self._lines.setdefault(table, line)
            last = depth == len(parts) - 1
            if last and is_list:
                self._lists[table] = self._lists.get(table, 0) + 1
            if table in self._lists:
                table = (*table, self._lists[table] - 1)
        self._lines[table] = line  # a table that stood in another's header so far gets its own line
        self._take("]]" if is_list else "]")
        return table

    def _pair(self, table: KeyPath) -> None:
        line = self._line()
        path = table
        for part in self._key():
            path = (*path, part)
            self._lines.setdefault(path, line)
        if self._take("="):
            self._skip_blank()
            self._value(path)

    def _value(self, path: KeyPath) -> None:
        if self._take("{"):
            self._inside("}", path)
        elif self._take("["):
            self._inside("]", path)
        else:
            found = _STRING.match(self._text, self._at) or _SCALAR.match(self._text, self._at)
            self._at = found.end() if found else self._at

    def _inside(self, end: str, path: KeyPath) -> None:
        """What stands between brackets: the pairs of an inline table, or the values of a list."""
        index = 0
        self._skip_blank()
        while self._at < len(self._text) and not self._take(end):
            start = self._at
            if end == "}":
                self._pair(path)
            else:
                self._lines[(*path, index)] = self._line()
                self._value((*path, index))
                index += 1
            self._skip_blank()
            self._take(",")
            self._skip_blank()
            if self._at == start:
                return


NAMED_TABLES: Final = ("channel", "device", "service", "task")
"""The tables whose keys are names: `[task.ScanTarget]`."""


class KeyPlaces:
    """Says where a key stands, as `agent1.toml:12` or `--set agent.name=x`.

    Args:
        path: the file, as messages name it.
        lines: the line of each key.
        named: the tables whose keys are names.
    """

    def __init__(self, path: str, lines: dict[KeyPath, int], named: Sequence[str] = NAMED_TABLES) -> None:
        self._path = path
        self._lines = lines
        self._named = named
        self._sets: dict[KeyPath, str] = {}

    def override(self, key: KeyPath, text: str, value: Any) -> None:
        """Notes that `--set text` gave this key its value; what the file says below the key is gone."""
        for known in [path for path in self._lines if path[: len(key)] == key]:
            del self._lines[known]
        for known in [path for path in self._sets if path[: len(key)] == key]:
            del self._sets[known]
        for length in range(1, len(key) + 1):
            if length == len(key) or (key[:length] not in self._lines and key[:length] not in self._sets):
                self._sets[key[:length]] = text
        self._sets.update((inside, text) for inside in _paths(value, key))

    def where(self, *key: str | int) -> str:
        """Returns the place of a key; of the innermost table around it where the key itself is not there."""
        outermost = 2 if len(key) > 1 and key[0] in self._named else 1  # another's [task.NAME] is no place for this
        for length in range(len(key), outermost - 1, -1):
            if key[:length] in self._sets:
                return set_text(self._sets[key[:length]])
            if key[:length] in self._lines:
                return f"{self._path}:{self._lines[key[:length]]}"
        return self._path

    def has(self, *key: str | int) -> bool:
        """Returns whether the file or a `--set` itself has this key."""
        return key in self._lines or key in self._sets

    def is_set(self, *key: str | int) -> bool:
        """Returns whether a key is there only because of a `--set`."""
        return key in self._sets

    def fault(self, key: KeyPath, problem: str, suggestion: str = "") -> Fault:
        """Returns a fault at a key."""
        return Fault(self.where(*key), key_text(key, self._named), problem, suggestion)

    def in_order(self, faults: list[Fault]) -> list[Fault]:
        """Returns faults in the order of the file, those of `--set` last; where a place has several, as they are."""

        def line(fault: Fault) -> float:
            number = fault.where.removeprefix(f"{self._path}:")
            if fault.where == self._path:
                return 0
            return int(number) if number.isdecimal() else float("inf")

        return sorted(faults, key=line)


def set_text(text: str) -> str:
    """Returns an override as messages name it."""
    return f"--set {text if len(text) <= 60 else text[:57] + '...'}"


def _paths(value: Any, key: KeyPath) -> Iterator[KeyPath]:
    """Yields the paths of all that is inside a plain value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for part, inner in items:
        yield (*key, part)
        yield from _paths(inner, (*key, part))


def key_text(key: KeyPath, named: Sequence[str] = NAMED_TABLES) -> str:
    """Returns a key as messages name it: `[task.ScanTarget] restart.policy`, `[agent] name`, `schema`."""
    if key == ("schema",) or not key:
        return dotted(key)
    depth = 2 if key[0] in named and len(key) > 1 else 1
    table, rest = f"[{dotted(key[:depth])}]", dotted(key[depth:])
    return f"{table} {rest}" if rest else table
