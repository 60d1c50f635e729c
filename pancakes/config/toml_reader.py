"""Read a TOML file as plain values with their places, or report all faulty lines.

`read_values` includes the files that it extends, `--set` overrides, and the values of its variables.

A line that cannot be read is a fault, and the rest is still read.
"""

from __future__ import annotations

import os
import re
import tomllib
from codecs import BOM_UTF8
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from pancakes.config.key_lines import NAMED_TABLES, KeyPlaces, key_text, lines_of_keys, split_pair
from pancakes.config.tables import SCHEMA
from pancakes.config.variables import replace_variables
from pancakes.errors import ConfigError, Fault
from pancakes.settings import dotted
from pancakes.util.files import NoPathError, at_home
from pancakes.util.text import suggestion, written_for
from pancakes.util.toml import MOST_CHARACTERS, TomlBoundsError, toml_values

EXAMPLE = "write it as table.key=value, such as clock.speed=5"


def apply_set(text: str, values: dict[str, Any], places: KeyPlaces) -> Fault | None:
    """Apply one override to the values of a configuration.

    A value that is valid TOML is taken as TOML (`5`, `true`, `["a"]`, `{ x = 1 }`), anything else as a string.
    Parts of the key that have dots in them are quoted, as in TOML.

    Args:
        text: the text after `--set`.
        values: the plain values of the file; changed in place.
        places: the places of keys; notes this override.

    Returns:
        The fault, or None.
    """
    change = change_of(text)
    if change is None:
        return Fault(f"--set {text}", "--set", f"is not an override: {EXAMPLE}")
    key, value = change
    if key == ("extends",):
        return Fault(f"--set {text}", "extends", "belongs in a file: --set changes single values of it")
    table = values
    for depth, part in enumerate(key[:-1], start=1):
        table = table.get(part, {})
        if not isinstance(table, dict):
            return Fault(f"--set {text}", key_text(key), f"{key_text(key[:depth])} is a value and has no keys in it")
    places.override(key, text, value)
    table = values
    for part in key[:-1]:
        table = table.setdefault(part, {})
    table[key[-1]] = value
    return None


def change_of(text: str) -> tuple[tuple[str, ...], Any] | None:
    """Read `table.key=value`; return the keys and the value, or None if the text is not of this form."""
    pair = split_pair(text)
    return (pair[0], _value_of(pair[2])) if pair else None


def _value_of(text: str) -> Any:
    """Return the value of typed text: valid TOML is taken as TOML, anything else as a string."""
    try:
        parsed = toml_values(f"value = {text}")
    except ValueError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


_POSITION = r"\s*\(at (?:line (?P<line>\d+), column \d+|end of document)\)$"
MOST_FAULTS: Final = 100
"""At most this many bad lines are reported; a file with more is not TOML at all."""
AGAIN: Final = "a table for the second time"


class Tables(NamedTuple):
    """The contents of a TOML text, even if parts of it cannot be read.

    Attributes:
        values: its plain values; a value that cannot be read is an empty string.
        places: where each key stands.
        faults: what cannot be read.
    """

    values: dict[str, Any]
    places: KeyPlaces
    faults: list[Fault]

    def with_faults(self, found: Sequence[Fault]) -> list[Fault]:
        """Return these faults and those found in the values, without those that only follow from these."""
        broken = {fault.where for fault in self.faults}
        marks = [f": {where}{end}" for where in broken for end in ",)"]  # in the place of a variable
        sound = [it for it in found if it.where not in broken and not any(mark in it.where for mark in marks)]
        return self.faults + sound


def tables_of(text: str, where: str, named: Sequence[str] = NAMED_TABLES) -> tuple[dict[str, Any], KeyPlaces]:
    """Read TOML that must be valid; see `read_tables`.

    Raises:
        ConfigError: it is not valid; it carries each fault.
    """
    values, places, faults = read_tables(text, where, named)
    if faults:
        raise ConfigError(faults)
    return values, places


def read_tables(text: str, where: str, named: Sequence[str] = NAMED_TABLES) -> Tables:
    """Read TOML. A line that cannot be read is a fault, and the lines after it are still read.

    Args:
        text: the TOML text.
        where: its name in messages.
        named: the tables whose keys are names.

    Raises:
        ConfigError: the rest depends on a line that cannot be read; it carries the faults up to there.
    """
    lines = text.splitlines(keepends=True)
    broken: dict[int, _Broken] = {}
    while True:
        try:
            values = toml_values("".join(lines))
        except tomllib.TOMLDecodeError as error:
            number, found = _broken_line(error, lines)
            again = number in broken
            broken.setdefault(number, found)
            if again or not found.mended or len(broken) >= MOST_FAULTS:
                faults = [Fault(f"{where}:{it}", broken[it].key, broken[it].problem) for it in sorted(broken)]
                raise ConfigError(faults) from None
            lines[number - 1] = found.mended
        except TomlBoundsError as error:
            place = f"{where}:{error.line}" if error.line else where
            raise ConfigError([Fault(place, "TOML", str(error))]) from None
        else:
            break
    mended, faults = "".join(lines), []
    if broken:
        # If a line has several keys, the innermost counts. A key without a table is not a table itself.
        keys = sorted(lines_of_keys(mended).items(), key=lambda it: len(it[0]))
        paths = {line: key_text(key, named) if len(key) > 1 else dotted(key) for key, line in keys}
        for number, line in sorted(broken.items()):
            key = paths.get(number, line.key) if line.is_value else line.key
            faults.append(Fault(f"{where}:{number}", key, line.problem))
    return Tables(values, KeyPlaces(where, mended, values, named), faults)


MOST_FILES: Final = 16
"""At most this many files extend one another."""


def read_layers(text: str, where: str, named: Sequence[str] = NAMED_TABLES) -> Tables:
    """Read TOML with the file that it `extends`, and the one which that extends; see `read_tables`.

    Tables are merged, at any depth. Any other value of a file replaces that of the file which it extends.

    Raises:
        ConfigError: the rest depends on what cannot be read; it carries the faults up to there.
    """
    tables = read_tables(text, where, named)
    layers, seen = [tables], [os.path.realpath(where)]
    path, faults = where, list(tables.faults)
    while "extends" in layers[-1].values:
        base, place = layers[-1].values["extends"], layers[-1].places.where("extends")
        try:
            path = _path_of_base(base, path, seen)
            layers.append(read_tables(_text_of_base(path), path, named))
        except _BaseError as error:
            raise ConfigError([*faults, Fault(place, "extends", str(error), error.near)]) from None
        except ConfigError as error:
            raise ConfigError([*faults, *error.faults]) from None
        seen.append(os.path.realpath(path))
        faults += layers[-1].faults
        if fault := fault_of_schema(layers[-1].values):
            faults.append(layers[-1].places.fault(("schema",), fault))
    values, places = layers[-1].values, layers[-1].places
    for layer in reversed(layers[:-1]):
        values = _merged(values, layer.values)
        places = layer.places.above(places, values)
    if len(layers) > 1:
        del values["extends"]
    return Tables(values, places, faults)


class _BaseError(Exception):
    """A file cannot be extended. `near` is the file that was probably meant."""

    def __init__(self, text: str, near: str = "") -> None:
        super().__init__(text)
        self.near = near


def _path_of_base(base: Any, path: str, seen: Sequence[str]) -> str:
    """Return the path of the file that another one extends."""
    if not isinstance(base, str) or not base:
        raise _BaseError(f"expected the path of a file, such as 'common.toml', not {base!r}")
    try:
        found = os.path.join(os.path.dirname(path), at_home(base))
    except NoPathError as error:
        raise _BaseError(str(error)) from None
    whole = os.path.realpath(found)
    if whole in seen:
        names = [os.path.basename(it) for it in (*seen[seen.index(whole) :], whole)]
        raise _BaseError("the files extend one another in a circle: " + " → ".join(names))
    if len(seen) >= MOST_FILES:
        raise _BaseError(f"more than {MOST_FILES} files extend one another")
    return found


def _text_of_base(path: str) -> str:
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise _BaseError(f"{path}: is not a regular file")  # a named pipe may never have an end
    try:
        return text_of(path)
    except ConfigError as error:
        (fault,) = error.faults
        raise _BaseError(f"{path}: {fault.problem}", fault.suggestion) from None


def _merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    values = dict(base)
    for key, value in own.items():
        below = values.get(key)
        values[key] = _merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return values


def read_values(text: str, where: str, sets: Sequence[str] = (), named: Sequence[str] = NAMED_TABLES) -> Tables:
    """Read TOML as it counts: with the files that it extends, overrides, and the values of variables.

    Args:
        text: the TOML text.
        where: its name in messages; the files that it extends are beside it.
        sets: overrides, each as `table.key=value`.
        named: the tables whose keys are names.

    Raises:
        ConfigError: the rest depends on what cannot be read; it carries the faults up to there.
    """
    tables = read_layers(text, where, named)
    faults = [fault for item in sets if (fault := apply_set(item, tables.values, tables.places))]
    return tables._replace(faults=[*tables.faults, *faults, *replace_variables(tables.values, tables.places)])


def self_contained(path: str, sets: Sequence[str] = ()) -> str:
    """Return the text of a file that needs no other one: with what it extends, and with overrides.

    Variables stay variables. A file that extends none and has no overrides stays as it is, with its comments.

    Raises:
        ConfigError: a file cannot be read; it carries each fault.
    """
    text = text_of(path)
    tables = read_layers(text, path)
    if not sets and tables.places.files == [path]:
        return text
    faults = [fault for item in sets if (fault := apply_set(item, tables.values, tables.places))]
    if tables.faults or faults:
        raise ConfigError([*tables.faults, *faults])
    from pancakes.config.toml_writer import document_text

    return document_text(tables.values)


class _Broken(NamedTuple):
    """A line that cannot be read.

    Attributes:
        key: its key, as messages name it.
        problem: what is wrong with it.
        mended: a replacement for the line, so that the rest can be read; empty: the rest depends on the line.
        is_value: whether only the value of its key is wrong.
    """

    key: str
    problem: str
    mended: str
    is_value: bool = False


_MOST_BYTES: Final = 4 * MOST_CHARACTERS
"""The largest file, in bytes."""


def text_of(path: str) -> str:
    """Return the text of a file.

    Raises:
        ConfigError: it does not exist, or cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError([Fault(path, "file", "there is no such file", _neighbour(path))]) from None
    except IsADirectoryError:
        raise ConfigError([Fault(path, "file", "is a directory, not a file")]) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError([Fault(path, "file", f"cannot be read: {reason.lower()}")]) from None
    if len(data) > _MOST_BYTES:  # it may be endless, such as /dev/zero
        raise ConfigError([Fault(path, "file", f"has more than {_MOST_BYTES:,} bytes")])
    data = data.removeprefix(BOM_UTF8)  # some editors write it, and TOML does not allow it
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError([Fault(f"{path}:{line}", "file", "is not UTF-8")]) from None


def _neighbour(path: str) -> str:
    """Return a configuration with a similar name in the same directory."""
    missing = Path(path)
    try:
        near = suggestion(missing.name, [entry.name for entry in missing.parent.glob("*.toml") if entry.is_file()])
    except OSError:
        return ""
    return str(missing.with_name(near)) if near else ""


def _broken_line(error: tomllib.TOMLDecodeError, lines: Sequence[str]) -> tuple[int, _Broken]:
    """Return the number, from 1, of the line that TOML's parser complains about, and the fault."""
    message, number = str(error), max(1, len(lines))
    if found := re.search(_POSITION, message):
        number = int(found["line"]) if found["line"] else number
        message = message[: found.start()]
    line = lines[number - 1] if number <= len(lines) else ""
    end = line[len(line.rstrip("\r\n")) :] or "\n"
    if twice := re.fullmatch(r"Cannot declare \((.*)\) twice", message):
        key = key_text(tuple(re.findall(r"'([^']*)'", twice[1])))
        # Its contents are read as those of another table, and not reported.
        return number, _Broken(key, "the table is defined twice", f'["{number}: {AGAIN}"]{end}')
    if message == "Cannot overwrite a value":
        return number, _Broken("TOML", "a key is defined twice", end)
    problem = message[:1].lower() + message[1:]
    pair = split_pair(line)
    if pair is None:
        return number, _Broken("TOML", problem, "")
    parts, written, value = pair
    return number, _Broken(
        "TOML", _problem_of_value(parts[-1], value) or problem, f'{written} = ""{end}', is_value=True
    )


def _problem_of_value(key: str, value: str) -> str:
    """Return what an invalid value probably means and how to write it; empty: unknown."""
    if not any(mark in value for mark in "\"'[{"):
        value = value.partition("#")[0].strip()
    word = value.lower()
    if word in ("true", "false"):
        return f"{value} is not TOML: write {word}"
    if word in ("yes", "no", "on", "off"):
        return f"{value} is not TOML: write {'true' if word in ('yes', 'on') else 'false'}, or the word in quotes"
    if word in ("none", "null", "nil"):
        return f"{value} is not TOML: leave the key out"
    if word in ("nan", "inf", "infinity"):
        return f"is not a number ({value})"
    if line := written_for(key, value):
        return f"{value} is not TOML: write {line}"
    if re.fullmatch(r"[A-Za-z_./~*$][^\"'\[\]{},\\]*", value):
        return f'{value} is not TOML: write text in quotes, as in {key} = "{value}"'
    return ""


def fault_of_schema(values: Mapping[str, Any]) -> str:
    """Return what is wrong with the format number of a file, as a phrase; empty: nothing."""
    schema = values.get("schema")
    if schema is None:
        return f"is missing: write schema = {SCHEMA}"
    if type(schema) is not int:
        return f"expected an integer, not {schema!r}"
    return "" if schema == SCHEMA else f"the format {schema} is not known to this version, which reads {SCHEMA}"
