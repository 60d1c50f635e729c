"""Find the line of each key of a TOML text, and whether a `--set` overrode it, for error messages.

The standard library's parser does not report lines.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import Fault
from pancakes.settings import dotted
from pancakes.util.toml import toml_values

if TYPE_CHECKING:
    from tomlkit.items import Item, Key, Table

KeyPath = tuple[str | int, ...]
"""The keys that lead to a value, from the outermost; an integer is a place in a list, from 0."""

MOST_EQUAL_SIGNS: Final = 16
"""At most this many equal signs are expected in a quoted key."""


def split_pair(text: str) -> tuple[tuple[str, ...], str, str] | None:
    """Split `task."a.b".rate_hz = 5` at its equal sign.

    Returns:
        The parts of the key, the key as it is written, and what follows the equal sign; None if the text does not begin
        with a key.
    """
    for found in islice(re.finditer("=", text), MOST_EQUAL_SIGNS):  # a quoted key may contain one
        written = text[: found.start()].strip()
        try:
            value: Any = toml_values(f"{written} = 0")
        except ValueError:
            continue
        parts = []
        while isinstance(value, dict) and len(value) == 1:
            part, value = next(iter(value.items()))
            parts.append(part)
        if value == 0 and "\n" not in written:
            return tuple(parts), written, text[found.end() :].strip()
    return None


def lines_of_keys(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of each key and table of a TOML text that has been parsed without an error.

    It imports tomlkit, which is large and slow: call it only to report something.
    """
    import tomlkit

    try:
        document = tomlkit.parse(text)
    except (ValueError, RecursionError):  # text that only the standard library's parser can read has no lines
        return {}
    if document.as_string() != text:  # tomlkit moves a list of tables that has another table in the middle
        return {}
    lines = _Lines()
    lines.read_body(document.body, ())
    return lines.of_keys


class _Lines:
    """Walk through a document of tomlkit in the order of its text, and count the lines."""

    def __init__(self) -> None:
        self.of_keys: dict[KeyPath, int] = {}
        self._line = 1
        self._tables: dict[KeyPath, int] = {}  # how many tables each `[[list of tables]]` has so far

    def read_body(self, body: Sequence[tuple[Key | None, Item]], table: KeyPath) -> int:
        """Walk through the keys, tables, space and comments of a table; return the line of its first key."""
        from tomlkit.items import AoT, Table

        first = 0
        for key, item in body:
            if key is None:
                self._line += item.as_string().count("\n")
                continue
            path = (*table, key.key)
            if isinstance(item, AoT):
                for one in item.body:
                    number = self._tables[path] = self._tables.get(path, -1) + 1
                    self._read_table(one, (*path, number))
                    self.of_keys.setdefault(path, self.of_keys[(*path, number)])
            elif isinstance(item, Table) and not item.is_super_table():
                self._read_table(item, path)
            elif isinstance(item, Table):  # it appears in the headers or dotted keys of its contents
                self.of_keys.setdefault(path, self.read_body(item.value.body, path))
            else:
                self._line += item.trivia.indent.count("\n")
                self.of_keys.setdefault(path, self._line)
                self._read_value(item, path)
                self._line += item.trivia.trail.count("\n")
            first = first or self.of_keys[path]
        return first or self._line

    def _read_table(self, table: Table, path: KeyPath) -> None:
        self._line += table.trivia.indent.count("\n")
        self.of_keys[path] = self._line  # also if it appeared only in another header so far
        self._line += table.trivia.trail.count("\n")
        self.read_body(table.value.body, path)

    def _read_value(self, value: Item, path: KeyPath) -> None:
        from tomlkit.items import Array, Comment, InlineTable, Null, Whitespace

        if isinstance(value, InlineTable):
            self.read_body(value.value.body, path)
        elif isinstance(value, Array):
            index = 0
            for item in value._iter_items():  # noqa: SLF001  its public items have no space between them
                if isinstance(item, (Whitespace, Comment, Null)):
                    self._line += item.as_string().count("\n")
                    continue
                self.of_keys[(*path, index)] = self._line
                self._read_value(item, (*path, index))
                index += 1
        else:
            self._line += value.as_string().count("\n")


NAMED_TABLES: Final = ("channel", "device", "filter", "service", "task")
"""The tables whose keys are names: `[task.ScanTarget]`."""


class _File:
    """One of the files that a configuration is made of.

    Args:
        path: the file, as messages name it.
        text: its text, in which lines are counted once one is asked for.
        values: its own plain values.
    """

    def __init__(self, path: str, text: str, values: Mapping[str, Any]) -> None:
        self.path = path
        self._text = text
        self._values = values

    @cached_property
    def lines(self) -> dict[KeyPath, int]:
        return lines_of_keys(self._text)

    def hides(self, key: KeyPath) -> bool:
        """Return whether a value of this file replaces everything that files below it have at a key."""
        value: Any = self._values
        for part in key:
            if not isinstance(value, dict):
                return True
            if part not in value:
                return False
            value = value[part]
        return not isinstance(value, dict)


class KeyPlaces:
    """Find the place of each key: `agent1.toml:12` or `--set agent.name=x`.

    The place of a value with variables in it names their places too: `agent1.toml:12 (gateway: common.toml:3)`.

    Args:
        path: the file, as messages name it.
        text: its text, in which lines are counted once one is asked for.
        values: its plain values, which overrides may change.
        named: the tables whose keys are names.
    """

    def __init__(self, path: str, text: str, values: Mapping[str, Any], named: Sequence[str] = NAMED_TABLES) -> None:
        self._path = path
        self._values = values
        self._named = named
        self._files = [_File(path, text, values)]
        self._overridden: list[KeyPath] = []
        self._sets: dict[KeyPath, str] = {}
        self._variables: dict[KeyPath, tuple[str, ...]] = {}

    def above(self, base: KeyPlaces, values: Mapping[str, Any]) -> KeyPlaces:
        """Return the places of keys if this file extends a `base`.

        Args:
            base: the places of keys of the file that this one extends.
            values: the values of both, which overrides may change.
        """
        places = KeyPlaces(self._path, "", values, self._named)
        places._files = [*self._files, *base._files]
        return places

    @property
    def files(self) -> list[str]:
        """The files that the keys are in, as messages name them: the file itself, the one it extends, and so on."""
        return [file.path for file in self._files]

    def override(self, key: KeyPath, text: str, value: Any) -> None:
        """Note that `--set text` is about to set this key; everything below the key in the file is replaced."""
        self._overridden.append(key)
        for known in [path for path in self._sets if path[: len(key)] == key]:
            del self._sets[known]
        for length in range(1, len(key)):
            if not self.has(*key[:length]):
                self._sets[key[:length]] = text
        self._sets[key] = text
        self._sets.update((inside, text) for inside in _paths(value, key))

    def note_variables(self, key: KeyPath, names: Sequence[str]) -> None:
        """Note the variables that the value of a key has in it."""
        self._variables[key] = tuple(names)

    def where(self, *key: str | int) -> str:
        """Return the place of a key; if it is missing, of the innermost table around it."""
        inner, place = self._place(key)
        names = self._names_in(inner)
        said = ", ".join(f"{name}: {self._place(('vars', name))[1]}" for name in names)
        return f"{place} ({said})" if said else place

    def file(self, *key: str | int) -> str:
        """Return the file that has a key, or the innermost table around it; the file itself if a `--set` has it."""
        _, place = self._place(key)
        path = place.rpartition(":")[0]
        return path if path in self.files else self._path

    def _place(self, key: KeyPath) -> tuple[KeyPath, str]:
        """Return the innermost part of a key that is somewhere, and its place."""
        outermost = 2 if len(key) > 1 and key[0] in self._named else 1  # another [task.NAME] is not its place
        for length in range(len(key), outermost - 1, -1):
            inner = key[:length]
            if inner in self._sets:
                return inner, set_text(self._sets[inner])
            if any(inner[: len(it)] == it for it in self._overridden):
                continue
            for file in self._files:
                if inner in file.lines:
                    return inner, f"{file.path}:{file.lines[inner]}"
                if file.hides(inner):
                    break
        return (), self._path

    def _names_in(self, key: KeyPath) -> list[str]:
        """Return the variables in the value at a key, if it is no table."""
        value: Any = self._values
        for part in key:
            try:
                value = value[part]
            except (LookupError, TypeError):
                break
        within = () if isinstance(value, dict) else (it for it in self._variables if it[: len(key)] == key)
        found = [name for it in (key, *within) for name in self._variables.get(it, ())]
        return list(dict.fromkeys(found)) if key else []

    def has(self, *key: str | int) -> bool:
        """Return whether the file or a `--set` has exactly this key."""
        value: Any = self._values
        for part in key:
            try:
                value = value[part]
            except (LookupError, TypeError):
                return False
        return True

    def is_set(self, *key: str | int) -> bool:
        """Return whether a key comes only from a `--set`."""
        return key in self._sets

    def fault(self, key: KeyPath, problem: str, suggestion: str = "") -> Fault:
        """Return a fault at a key."""
        return Fault(self.where(*key), key_text(key, self._named), problem, suggestion)

    def in_order(self, faults: list[Fault]) -> list[Fault]:
        """Return faults in the order of the files, those of `--set` last; faults at one place keep their order."""
        files = {path: number for number, path in enumerate(self.files)}

        def order(fault: Fault) -> tuple[int, int]:
            place = fault.where.partition(" (")[0]
            path, _, line = place.rpartition(":")
            if place in files:
                return files[place], 0
            return (files[path], int(line)) if path in files and line.isdecimal() else (len(files), 0)

        return sorted(faults, key=order)


def set_text(text: str) -> str:
    """Return an override as messages name it."""
    return f"--set {text if len(text) <= 60 else text[:57] + '...'}"


def _paths(value: Any, key: KeyPath) -> Iterator[KeyPath]:
    """Yield the paths of all values inside a plain value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for part, inner in items:
        yield (*key, part)
        yield from _paths(inner, (*key, part))


def key_text(key: KeyPath, named: Sequence[str] = NAMED_TABLES) -> str:
    """Return a key as messages name it: `[task.ScanTarget] restart.policy`, `[agent] name`, `schema`."""
    if key == ("schema",) or not key:
        return dotted(key)
    depth = 2 if key[0] in named and len(key) > 1 else 1
    table, rest = f"[{dotted(key[:depth])}]", dotted(key[depth:])
    return f"{table} {rest}" if rest else table
