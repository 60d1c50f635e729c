"""How the verbs print what they have found: as a table for people, or as JSON for programs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from pancakes.packet import body_to_plain
from pancakes.util.arrays import as_list, is_array
from pancakes.util.codecs import encode_json
from pancakes.util.text import printable, printable_data

if TYPE_CHECKING:
    from rich.table import Table

DRY_RUN: Final = "dry run"
"""What stands under `done` where it was only asked whether it would be."""


def show_text(text: str = "", *, err: bool = False, nl: bool = True, head: str = "", colour: str | None = None) -> None:
    """Prints text, which may be of others: with its control characters escaped.

    Args:
        text: what to print.
        err: whether to standard error.
        nl: whether a new line follows.
        head: our own words before it, which may be coloured.
        colour: the text's colour, where its terminal has any.
    """
    shown = printable(text)
    click.echo(head + (click.style(shown, fg=colour) if colour else shown), err=err, nl=nl)


def show_json(value: Any) -> None:
    """Prints a plain value to standard output, as JSON; numbers that JSON does not know (NaN, infinity) become null."""
    show_text(printable_data(msgspec.json.format(encode_json(body_to_plain(value)), indent=2).decode()))


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
    show_drawn(_table(picked, columns))


def show_sections(sections: Mapping[str, Mapping[str, Any] | Sequence[Mapping[str, Any]] | str]) -> None:
    """Prints all about one thing, for people.

    Under each title stand facts (a mapping), a table (rows of the same keys), or text as it is (a string).

    Where there is nothing under a title, it is left out.
    """
    from rich.table import Table
    from rich.text import Text

    for title, content in sections.items():
        if not content:
            continue
        table: Table | Text
        if isinstance(content, str):
            table = Text("\n".join(printable(f"  {line}") for line in content.splitlines()))
        elif isinstance(content, Mapping):
            table = Table.grid(padding=(0, 2), pad_edge=False)
            for name, value in content.items():
                table.add_row(Text(printable(f"  {name}")), Text(_text(value) or "-"))
        else:
            table = _table(content, list(content[0]))
        show_drawn(Text(title, style="bold"), table)


def _table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:  # in a narrow terminal a name is folded, because one that is cut off is of no use
        table.add_column(column, justify="right" if _numeric(rows, column) else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(_text(row[column])) for column in columns))
    return table


def show_drawn(*things: Any) -> None:
    """Prints tables and texts of rich to standard output."""
    from rich.console import Console

    # Into a file or a pipe nothing is cut off or folded.
    console = Console(width=None if sys.stdout.isatty() else 1000)
    # click prints it, because rich ends the process in its own way where the reader of the output has ended.
    with console.capture() as captured:
        for thing in things:
            console.print(thing)
    click.echo(captured.get(), nl=False)


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
    if isinstance(value, Mapping):
        return ", ".join(f"{printable(str(key))} {_inner(item)}" for key, item in value.items()) or "-"
    if isinstance(value, (list, tuple)):
        nested = any(isinstance(item, (list, tuple, Mapping)) for item in value)
        return _inner(value) if nested else ", ".join(_text(item) for item in value) or "-"
    if is_array(value):
        return f"{as_list(value)} ({value.dtype}, {' x '.join(map(str, value.shape)) or 'one number'})"
    return printable(str(value))


def _inner(value: Any) -> str:
    """A value as it stands within another: a list or table keeps its brackets, so that its end can be seen."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{printable(str(key))} {_inner(item)}' for key, item in value.items())}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_inner, value))}]"
    return _text(value)
