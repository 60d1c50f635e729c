"""A TOML file as plain values, each with its place; or what is wrong with it as a file."""

from __future__ import annotations

import re
import tomllib
from codecs import BOM_UTF8
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pancakes.errors import ConfigError, Fault
from pancakes.runtime.config.key_places import NAMED_TABLES, KeyPlaces, key_text
from pancakes.runtime.config.scanner import lines_of_keys
from pancakes.runtime.config.tables import SCHEMA
from pancakes.runtime.foundation.suggestion import suggestion

_POSITION = r"\s*\(at (?:line (?P<line>\d+), column \d+|end of document)\)$"


def tables_of(text: str, where: str, named: Sequence[str] = NAMED_TABLES) -> tuple[dict[str, Any], KeyPlaces]:
    """Reads TOML.

    Args:
        text: the TOML text.
        where: its name in messages.
        named: the tables whose keys are names.

    Returns:
        Its plain values, and where each key stands.

    Raises:
        ConfigError: it is no TOML.
    """
    try:
        return tomllib.loads(text), KeyPlaces(where, lines_of_keys(text), named)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([_syntax_fault(error, text, where)]) from None
    except RecursionError:
        raise ConfigError([Fault(where, "TOML", "is nested too deeply")]) from None


def text_of(path: str) -> str:
    """Returns the text of a file.

    Raises:
        ConfigError: it is not there, or cannot be read.
    """
    try:
        data = Path(path).read_bytes().removeprefix(BOM_UTF8)  # some editors put it in front, and TOML does not know it
    except FileNotFoundError:
        raise ConfigError([Fault(path, "file", "there is no such file", _neighbour(path))]) from None
    except IsADirectoryError:
        raise ConfigError([Fault(path, "file", "is a directory, not a file")]) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError([Fault(path, "file", f"cannot be read: {reason.lower()}")]) from None
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError([Fault(f"{path}:{line}", "file", "is not UTF-8")]) from None


def _neighbour(path: str) -> str:
    """The file of a similar name in the same directory."""
    missing = Path(path)
    try:
        near = suggestion(missing.name, [entry.name for entry in missing.parent.iterdir() if entry.is_file()])
    except OSError:
        return ""
    return str(missing.with_name(near)) if near else ""


def _syntax_fault(error: tomllib.TOMLDecodeError, text: str, where: str) -> Fault:
    message = str(error)
    found = re.search(_POSITION, message)
    line = text.rstrip("\n").count("\n") + 1
    if found:
        line = int(found["line"]) if found["line"] else line
        message = message[: found.start()]
    twice = re.fullmatch(r"Cannot declare \((.*)\) twice", message)
    if twice:
        table = tuple(re.findall(r"'([^']*)'", twice[1]))
        return Fault(f"{where}:{line}", key_text(table), "the table stands here for the second time")
    if message == "Cannot overwrite a value":
        message = "a key stands here for the second time"
    return Fault(f"{where}:{line}", "TOML", message[:1].lower() + message[1:])


def fault_of_schema(values: Mapping[str, Any]) -> str:
    """Says what is wrong with the format that a file states, as a phrase; empty: nothing."""
    schema = values.get("schema")
    if schema is None:
        return f"is missing: the file states its format as schema = {SCHEMA}"
    if type(schema) is not int:
        return f"expected an integer, not {schema!r}"
    return "" if schema == SCHEMA else f"the format {schema} is not known to this version, which reads {SCHEMA}"
