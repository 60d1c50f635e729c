"""Replace variables in the values of a configuration: `${gateway}` stands for the value of `[vars] gateway`.

A string that is only `${NAME}` becomes the value itself, whatever its type. Within longer text a variable is text, a
number, true or false. `$${` is the text `${`. The environment is not read: a file means the same on each machine.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from pancakes.config.key_lines import KeyPath, KeyPlaces
from pancakes.errors import Fault
from pancakes.util.text import suggestion

TABLE: Final = "vars"
"""The table with the values of variables."""
NAME: Final = r"[A-Za-z_][A-Za-z0-9_-]*"
"""The pattern of a variable's name."""
REFERENCE: Final = rf"\$\{{{NAME}\}}"
"""The pattern of a variable in text."""

MOST_NESTED: Final = 32
"""At most this many variables stand in one another."""
MOST_CHARACTERS: Final = 1 << 20
"""The most characters that the variables of a file come to, wherever they stand."""

_MARK = re.compile(r"\$\$\{|\$\{([^{}]*)(\}?)")


def replace_variables(values: dict[str, Any], places: KeyPlaces) -> list[Fault]:
    """Replace the variables in plain values, and take the table `[vars]` out of them.

    Args:
        values: the plain values of a file, with its overrides; changed in place.
        places: the places of keys; notes which variables a key has in it.

    Returns:
        The faults. A value with a fault stays as it is.
    """
    variables = values.pop(TABLE, {})
    if not isinstance(variables, dict):
        return [places.fault((TABLE,), f"expected a table: [{TABLE}]")]
    found = _Variables(variables, places)
    for name in variables:
        if not re.fullmatch(NAME, name):
            problem = "is no name of a variable: a letter or _, then letters, digits, _ and -"
            found.faults.append(places.fault((TABLE, name), problem))
    for key, value in values.items():
        values[key] = found.replaced(value, (key,))
    return found.faults


class _Variables:
    """The variables of a file, and what is wrong with their use."""

    def __init__(self, variables: Mapping[str, Any], places: KeyPlaces) -> None:
        self._variables = variables
        self._places = places
        self._known: dict[str, Any] = {}
        self._faulty: set[str] = set()  # those that have no value
        self._open: list[str] = []  # those whose value is being worked out
        self._characters = 0  # of all variables that were replaced
        self.faults: list[Fault] = []

    def replaced(self, value: Any, key: KeyPath) -> Any:
        """Return a value with the values of its variables; `key` leads to it."""
        if isinstance(value, dict):
            return {name: self.replaced(it, (*key, name)) for name, it in value.items()}
        if isinstance(value, list):
            return [self.replaced(it, (*key, index)) for index, it in enumerate(value)]
        if not isinstance(value, str) or "${" not in value:
            return value
        try:
            names = list(_names_in(value))
            if used := list(dict.fromkeys(it for name in names for it in self._all_of(name))):
                self._places.note_variables(key, [it for it in used if key != (TABLE, it)])
            if re.fullmatch(REFERENCE, value):
                whole = self._value(names[0])
                self._count(whole)
                return whole
            return _MARK.sub(lambda mark: self._text(mark[1]) if mark[0] != "$${" else "${", value)
        except _FaultyError as error:
            self.faults.append(self._places.fault(key, error.text, error.near))
            return value

    def _all_of(self, name: str) -> list[str]:
        """Return a variable, and those that its value has in it, as far as there are such variables."""
        found: dict[str, None] = {}
        left = [name]
        while left:
            name = left.pop()
            if name in found or name not in self._variables:
                continue
            found[name] = None
            inner = [other for text in _texts(self._variables[name]) for other in _names_in(text)]
            left += reversed(inner)
        return list(found)

    def _value(self, name: str) -> Any:
        if name in self._known:
            return self._known[name]
        if name in self._faulty:
            raise _FaultyError(f"needs the variable {name!r}, which has no value")
        if name not in self._variables:
            defined = ", ".join(self._variables)
            text = f"there is no variable {name!r}, only {defined}" if defined else f"there is no variable {name!r}"
            raise _FaultyError(
                f"{text}: define it in [{TABLE}] (the environment is not read)", suggestion(name, self._variables)
            )
        if name in self._open:
            circle = " → ".join([*self._open[self._open.index(name) :], name])
            raise _FaultyError(f"its variables are defined by one another, in a circle: {circle}")
        if len(self._open) >= MOST_NESTED:
            raise _FaultyError(f"more than {MOST_NESTED} variables are nested")
        self._open.append(name)
        faults = len(self.faults)
        value = self.replaced(self._variables[name], (TABLE, name))
        self._open.remove(name)
        if len(self.faults) > faults:
            self._faulty.add(name)
            raise _FaultyError(f"needs the variable {name!r}, which has no value")
        self._known[name] = value
        return value

    def _text(self, name: str) -> str:
        value = self._value(name)
        if isinstance(value, bool):
            return "true" if value else "false"
        if not isinstance(value, (str, int, float)):
            kind = "a list" if isinstance(value, list) else "a table" if isinstance(value, dict) else "a time"
            raise _FaultyError(f"the variable {name!r} is {kind}, which cannot be a part of text")
        self._count(value)
        return str(value)

    def _count(self, value: Any) -> None:
        """Count what a variable adds: a few lines of variables in variables would fill the memory."""
        if self._characters <= MOST_CHARACTERS:
            self._characters += _length(value)
        if self._characters > MOST_CHARACTERS:
            raise _FaultyError(f"the variables come to more than {MOST_CHARACTERS:,} characters")


class _FaultyError(Exception):
    """A variable cannot be replaced."""

    def __init__(self, text: str, near: str = "") -> None:
        super().__init__(text)
        self.text = text
        self.near = near


def _names_in(text: str) -> Iterator[str]:
    """Yield the names of the variables in a text."""
    for mark in _MARK.finditer(text):
        if mark[0] == "$${":
            continue
        if not mark[2]:
            raise _FaultyError("has ${ without }: write ${NAME} for a variable, and $${ for the text ${")
        if not re.fullmatch(NAME, mark[1]):
            raise _FaultyError(f"{mark[0]} is no variable: write ${{NAME}}, and $${{ for the text ${{")
        yield mark[1]


def _length(value: Any) -> int:
    if isinstance(value, dict):
        return sum(len(key) + _length(inner) for key, inner in value.items())
    return 1 + sum(map(_length, value)) if isinstance(value, list) else len(str(value))


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)
