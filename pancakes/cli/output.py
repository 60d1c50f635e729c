"""How the verbs print what they have found: as a table for people, or as JSON for programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import click


def show_json(value: Any) -> None:
    """Prints a plain value to standard output, as JSON."""
    click.echo(json.dumps(value, indent=2, ensure_ascii=False))


def show(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], format_: str) -> None:
    """Prints rows to standard output.

    Args:
        rows: what to print, plain values.
        columns: the keys to print, in this order.
        format_: `table` or `json`.
    """
    picked = [{column: row[column] for column in columns} for row in rows]
    if format_ == "json":
        show_json(picked)
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="right" if _numeric(picked, column) else "left")
    for row in picked:
        table.add_row(*(Text(_text(value)) for value in row.values()))
    # Into a file or a pipe nothing is cut off or folded.
    Console(width=None if sys.stdout.isatty() else 1000).print(table)


def _numeric(rows: Sequence[Mapping[str, Any]], column: str) -> bool:
    values = [row[column] for row in rows if row[column] is not None]
    return bool(values) and all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}" if abs(value) < 1e-3 else f"{value:.3f}".rstrip("0").rstrip(".")
    if isinstance(value, (list, tuple)):
        return ", ".join(str(item) for item in value) or "-"
    return str(value)
