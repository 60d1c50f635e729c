"""Print the results of verbs: as tables and sentences for people, or as JSON for programs.

`--format` makes a `Printer`. A verb passes it, once, the value and how people see that value.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click
import msgspec

from pancakes.packet import body_to_plain
from pancakes.util.arrays import as_list, is_array
from pancakes.util.codecs import encode_json
from pancakes.util.text import printable, printable_data

if TYPE_CHECKING:
    from rich.table import Table

DRY_RUN: Final = "dry run"
"""The value of the column `done` after a dry run."""


def show_text(text: str = "", *, err: bool = False, nl: bool = True, head: str = "", colour: str | None = None) -> None:
    """Print text, which may come from other programs: its control characters are escaped.

    Args:
        text: what to print.
        err: whether to print it to standard error.
        nl: whether a new line follows.
        head: our own text before it, which may have colours.
        colour: the text's colour, on terminals with colours.
    """
    shown = printable(text)
    click.echo(head + (click.style(shown, fg=colour) if colour else shown), err=err, nl=nl)


class Rows(NamedTuple):
    """A table for people: plain values by the keys of its columns, which are printed in this order."""

    rows: Sequence[Mapping[str, Any]]
    columns: Sequence[str]


Part = str | Rows | Mapping[str, Any] | Iterable["Part"]
"""What people see: text, a table, sections by their titles, or several of these.

A section holds facts (a mapping), a table (rows with the same keys), or text. Empty sections are left out.
"""


class Printer:
    """Print the answer of a verb to standard output, as its option `--format` says.

    Args:
        format_: `table` or `json`.
    """

    def __init__(self, format_: str) -> None:
        self.is_json = format_ == "json"

    def emit(self, value: Any, *parts: Part) -> None:
        """Print an answer.

        Args:
            value: what programs get, as JSON: a plain value. Numbers that JSON lacks (NaN, infinity) become null.
            parts: what people get instead. A generator runs only for people.
        """
        if self.is_json:
            show_text(printable_data(msgspec.json.format(encode_json(body_to_plain(value)), indent=2).decode()))
        else:
            self.tell(*parts)

    def table(self, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
        """Print the same rows and columns for people and for programs."""
        picked = [{column: row[column] for column in columns} for row in rows]
        self.emit(picked, Rows(picked, columns))

    def tell(self, *parts: Part) -> None:
        """Print something that is only for people."""
        if not self.is_json:
            for part in parts:
                _show_part(part)

    def note(self, text: str) -> None:
        """Print a remark: to standard error if standard output is JSON."""
        show_text(text, err=self.is_json)

    def stream(
        self,
        bounded: bool,
        text: Callable[[Any], str],
        colour: Callable[[Any], str | None] = lambda value: None,
    ) -> Stream:
        """Return a `Stream` that prints values as they come, one per line; use it as a context manager.

        Args:
            bounded: whether the verb ends by itself. Then JSON is a list, otherwise one object per line.
            text: formats a value for people.
            colour: returns the colour of a value's text, if it has one.
        """
        return Stream(self.is_json, bounded, text, colour)


class Stream:
    """Print values as they come; see `Printer.stream`."""

    def __init__(
        self, is_json: bool, bounded: bool, text: Callable[[Any], str], colour: Callable[[Any], str | None]
    ) -> None:
        self._json = is_json
        self._list = is_json and bounded
        self._text = text
        self._colour = colour
        self.printed = 0

    def __enter__(self) -> Stream:
        return self

    def show(self, value: Any) -> None:
        """Print a value."""
        if self._list:
            show_text(("[\n  " if self.printed == 0 else ",\n  ") + one_line(value), nl=False)
        elif self._json:
            show_text(one_line(value))
        else:
            show_text(self._text(value), colour=self._colour(value))
        self.printed += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        # Close the JSON list, also if the user ends the command early. A command that failed may not have opened it.
        if self._list and (kind is None or issubclass(kind, KeyboardInterrupt) or self.printed):
            if not isinstance(error, BrokenPipeError):
                show_text("\n]" if self.printed else "[]")


def one_line(value: Any) -> str:
    """Return a value as JSON on one line; numbers that JSON lacks (NaN, infinity) become null."""
    return printable_data(encode_json(body_to_plain(value)).decode())


def _show_part(part: Part) -> None:
    if isinstance(part, str):
        if part:
            show_text(part, nl=not part.endswith("\n"))
    elif isinstance(part, Rows):
        show_drawn(_table(part.rows, part.columns))
    elif isinstance(part, Mapping):
        _show_sections(part)
    else:
        for inner in part:
            _show_part(inner)


def _show_sections(sections: Mapping[str, Any]) -> None:
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
    for column in columns:  # a narrow terminal folds names, because a truncated name is of no use
        table.add_column(column, justify="right" if _numeric(rows, column) else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(_text(row[column])) for column in columns))
    return table


def show_drawn(*things: Any) -> None:
    """Print rich tables and texts to standard output."""
    from rich.console import Console

    # Output to a file or a pipe is not truncated or folded.
    console = Console(width=None if sys.stdout.isatty() else 1000)
    # Print by click, because rich ends the process in its own way if the reader of the output has ended.
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
    """Format a value inside another: a list or table keeps its brackets, so that its end is visible."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{printable(str(key))} {_inner(item)}' for key, item in value.items())}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_inner, value))}]"
    return _text(value)
