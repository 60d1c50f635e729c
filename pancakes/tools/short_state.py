"""Shorten the state of a task for people: a name and a short text for each value. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

import msgspec

from pancakes.settings import dotted
from pancakes.util import codecs
from pancakes.util.arrays import is_array
from pancakes.util.text import printable

MOST_CHARS: Final = 160
"""The most characters of the text of one value."""
MOST_BYTES: Final = 4096
"""The most bytes of all names and texts together; further values are left out."""
MOST_DEEP: Final = 6
"""The depth of nesting at which a table becomes one value."""
MOST_NODES: Final = 200
"""The most nodes of a behaviour tree; further nodes are left out."""
MOST_DEPTH: Final = 1000
"""The most nodes above one of a behaviour tree: deeper ones Python does not tick."""


class TreeRow(msgspec.Struct, frozen=True):
    """One node of a behaviour tree (`pancakes.trees`).

    Attributes:
        depth: how many nodes are above it.
        name: its name.
        kind: the name of its class.
        status: `INVALID`, `RUNNING`, `SUCCESS` or `FAILURE`.
        message: its feedback message.
    """

    depth: Annotated[int, msgspec.Meta(ge=0, le=MOST_DEPTH)]
    name: str
    kind: str
    status: Literal["INVALID", "RUNNING", "SUCCESS", "FAILURE"]
    message: str


class ShortState(msgspec.Struct, frozen=True):
    """A shortened state.

    Attributes:
        rows: name and text of each value; the name of a value in a table has dots, as in TOML.
        cut: whether something was shortened or left out.
        tree: the nodes of the task's behaviour tree, each before its children; they are not in `rows`. Empty: it has
            none.
    """

    rows: tuple[tuple[str, str], ...]
    cut: bool
    tree: tuple[TreeRow, ...] = ()

    def size(self) -> int:
        """Return its approximate size in memory."""
        of_tree = sum(len(row.name) + len(row.kind) + len(row.message) for row in self.tree)
        return of_tree + sum(len(name) + len(text) for name, text in self.rows)


def shortened(state: Mapping[str, Any], most_chars: int = MOST_CHARS, most_bytes: int = MOST_BYTES) -> ShortState:
    """Shorten a state; a large state takes no longer than a small one.

    Args:
        state: plain values and numpy arrays.
        most_chars: see `MOST_CHARS`.
        most_bytes: see `MOST_BYTES`.
    """
    rows: list[tuple[str, str]] = []
    left = most_bytes
    tree, cut = _tree_in(state, most_chars)
    if tree:
        state = {name: value for name, value in state.items() if name != NODES}
    for keys, value in _leaves(state, ()):
        name, text, whole = printable(dotted(keys)), *_text(value, most_chars)
        if len(name) > most_chars:
            name, whole = f"{name[: most_chars - 1]}…", False
        left -= len(name.encode()) + len(text.encode())
        if left < 0:
            return ShortState(tuple(rows), True, tree)
        rows.append((name, text))
        cut = cut or not whole
    return ShortState(tuple(rows), cut, tree)


NODES: Final = "nodes"
"""The field of the state of a `TreeTask` that has the nodes of its tree."""


def _tree_in(state: Mapping[str, Any], most_chars: int) -> tuple[tuple[TreeRow, ...], bool]:
    """Return the nodes of the behaviour tree in a state, and whether some are shortened or left out."""
    nodes = state.get(NODES)
    if not isinstance(nodes, (list, tuple)) or not nodes:
        return (), False
    try:
        rows = codecs.convert(list(nodes[:MOST_NODES]), list[TreeRow])
    except msgspec.ValidationError:  # a field of this name in the state of any other task
        return (), False
    cut = len(nodes) > MOST_NODES
    short = []
    for row in rows:
        (name, kind, message), whole = zip(
            *(_text(it, most_chars) for it in (row.name, row.kind, row.message)), strict=True
        )
        cut = cut or not all(whole)
        short.append(TreeRow(row.depth, name, kind, row.status, message))
    return tuple(short), cut


def _leaves(value: Mapping[Any, Any], keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, item in value.items():
        inside = (*keys, str(key))
        if isinstance(item, Mapping) and item and len(inside) < MOST_DEEP:
            yield from _leaves(item, inside)
        else:
            yield inside, item


def _text(value: Any, most: int) -> tuple[str, bool]:
    """Return the text of a value, and whether it is complete."""
    if isinstance(value, str):  # only strings inside other values need quotes
        head = printable(value[:most])
        return (head, True) if len(value) <= most else (f"{head}… ({len(value)} characters)", False)
    text, whole = "", True
    for piece in _pieces(value):
        if len(text) + len(piece) > most:
            text, whole = f"{text}{piece[: most - len(text)]}…", False
            break
        text += piece
    return f"{text}{_note(value, whole)}", whole


def _note(value: Any, whole: bool) -> str:
    """Return a note about a value: the type of an array, or the length of a value that was cut."""
    if is_array(value):
        return f" ({value.dtype}, {' x '.join(map(str, value.shape)) or 'one number'})"
    return f" ({len(value)} items)" if not whole and isinstance(value, (list, tuple, Mapping)) else ""


def _pieces(value: Any) -> Iterator[str]:
    """Yield the text of a value in pieces, so that the rest of a large value need not be formatted."""
    if is_array(value):
        if value.ndim == 0:
            yield from _pieces(value.item())
        else:
            yield from _listed(value if value.ndim > 1 else (item.item() for item in value))
    elif isinstance(value, Mapping):
        yield "{"
        for index, (key, item) in enumerate(value.items()):
            yield f"{', ' if index else ''}{printable(str(key))} = "
            yield from _pieces(item)
        yield "}"
    elif isinstance(value, (list, tuple)):
        yield from _listed(value)
    else:
        yield _word(value)


def _listed(items: Any) -> Iterator[str]:
    yield "["
    for index, item in enumerate(items):
        if index:
            yield ", "
        yield from _pieces(item)
    yield "]"


def _word(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (bytes, bytearray, memoryview)):
        return f"{bytes(value[:32]).hex(' ')}{'…' if len(value) > 32 else ''} ({len(value)} bytes)"
    return f'"{printable(value[:MOST_BYTES])}"' if isinstance(value, str) else printable(str(value))
