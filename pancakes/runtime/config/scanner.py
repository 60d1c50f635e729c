"""Finds the line on which each key of a TOML text stands; the standard library's parser does not tell."""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_right
from typing import Final

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
