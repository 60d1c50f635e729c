"""Settings of tasks as TOML, as in a configuration file: written by `param dump`, read by `param load`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pancakes.config.toml_reader import tables_of, text_of
from pancakes.config.toml_writer import document_text
from pancakes.errors import PancakesError

STDIN = Path("-")
_TABLES = ("task", "device")


def dumped(rows: list[dict[str, Any]]) -> str:
    """Return the settings of tasks as a TOML document with tables `[task.NAME.settings]` and `[device.NAME.settings]`.

    Args:
        rows: the agent's description of each task (see `Describe`).

    Raises:
        PancakesError: two of them have the same name.
    """
    tables: dict[str, dict[str, Any]] = {}
    for row in rows:
        table = tables.setdefault("device" if row.get("device") else "task", {})
        if row["task"] in table:
            raise PancakesError(f"{row['agent']} has several tasks {row['task']!r}: dump them one at a time")
        table[row["task"]] = {"settings": row["settings"]}
    return document_text(tables)


def read(path: Path) -> dict[str, Mapping[str, Any]]:
    """Return the settings in a TOML file by task; other tables, such as those of a configuration, are ignored.

    Args:
        path: the file; `-` is standard input.

    Raises:
        PancakesError: the file cannot be read, or has no settings.
    """
    where = "standard input" if path == STDIN else str(path)
    values, _ = tables_of(sys.stdin.read() if path == STDIN else text_of(str(path)), where)
    found: dict[str, Mapping[str, Any]] = {}
    for table in _TABLES:
        entries = values.get(table, {})
        for name, entry in entries.items() if isinstance(entries, Mapping) else ():
            settings = entry.get("settings") if isinstance(entry, Mapping) else None
            if isinstance(settings, Mapping):
                if name in found:
                    raise PancakesError(f"{where} has a task and a device called {name!r}: load them one at a time")
                found[name] = settings
    if not found:
        raise PancakesError(f"{where} has no settings: put them in tables such as [task.NAME.settings]")
    return found


def changes_of(present: Mapping[str, Any], texts: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Return the settings to configure, by outermost key, so that some values change.

    Args:
        present: the present settings.
        texts: new values by their path of keys; a path of several keys leads into a table.

    Raises:
        PancakesError: a path leads through a value that is not a table.
    """
    import copy

    changes: dict[str, Any] = {}
    for keys, value in texts.items():
        if len(keys) == 1:
            changes[keys[0]] = value
            continue
        changes.setdefault(keys[0], copy.deepcopy(present.get(keys[0], {})))
        table = changes
        for depth, key in enumerate(keys[:-1], start=1):
            table = table.setdefault(key, {})
            if not isinstance(table, dict):
                raise PancakesError(f"{'.'.join(keys[:depth])} is not a table, so it has no keys")
        table[keys[-1]] = value
    return changes
