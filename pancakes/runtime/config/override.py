"""`--set table.key=value`: one key of a configuration, given at the command line."""

from __future__ import annotations

from typing import Any

from pancakes.errors import Fault
from pancakes.runtime.config.key_places import KeyPlaces, key_text
from pancakes.runtime.config.scanner import key_at
from pancakes.runtime.foundation.toml_values import toml_values

EXAMPLE = "write it as table.key=value, such as clock.speed=5"


def apply_set(text: str, values: dict[str, Any], places: KeyPlaces) -> Fault | None:
    """Puts one override into the values of a configuration.

    A value that reads as TOML is taken as such (`5`, `true`, `["a"]`, `{ x = 1 }`), anything else as a string.
    Parts of the key that have dots in them are quoted, as in TOML.

    Args:
        text: what stood after `--set`.
        values: the plain values of the file; changed in place.
        places: where keys stand; learns that this one was overridden.

    Returns:
        What is wrong with it, or None.
    """
    change = change_of(text)
    if change is None:
        return Fault(f"--set {text}", "--set", f"is no override: {EXAMPLE}")
    key, value = change
    table = values
    for depth, part in enumerate(key[:-1], start=1):
        inner = table.setdefault(part, {})
        if not isinstance(inner, dict):
            return Fault(f"--set {text}", key_text(key), f"{key_text(key[:depth])} is a value and has no keys in it")
        table = inner
    table[key[-1]] = value
    places.override(key, text, value)
    return None


def change_of(text: str) -> tuple[tuple[str, ...], Any] | None:
    """Reads `table.key=value`; returns the keys and the value, None where it is no such text."""
    try:
        found = key_at(text.strip())
    except ValueError:
        return None
    rest = text.strip()[found[1] :].lstrip() if found else ""
    if found is None or not rest.startswith("="):
        return None
    return tuple(found[0]), _value_of(rest[1:].strip())


def _value_of(text: str) -> Any:
    """Returns the value that a person has typed: text that is TOML is taken as such, anything else as a string."""
    try:
        parsed = toml_values(f"value = {text}")
    except ValueError:
        return text
    return parsed["value"] if len(parsed) == 1 else text
