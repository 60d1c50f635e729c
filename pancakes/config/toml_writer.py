"""Write plain values as TOML, as a person would: with comments, and tables under their own heads.

It imports tomlkit, which is large: import this module only when it is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import tomlkit
from tomlkit.items import Array, InlineTable, Item, SingleKey, Table

from pancakes.util.arrays import as_list, is_array

Comment = Callable[[tuple[str, ...]], str]
"""Returns the comment behind a key, given the keys that lead to it; empty: none."""


def key_text(keys: Sequence[str]) -> str:
    """Return keys as TOML writes them: `task."a.b".rate_hz`."""
    return ".".join(SingleKey(key).as_string() for key in keys)


def value_text(value: Any) -> str:
    """Return a plain value as TOML writes it on one line."""
    return _inline(value).as_string()


def leaves(value: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all values in nested tables except non-empty tables, with the keys that lead to them."""
    if _is_table(value):
        for key, inner in value.items():
            yield from leaves(inner, (*keys, key))
    else:
        yield keys, value


def document_text(tables: Mapping[str, Any], comment: Comment = lambda keys: "") -> str:
    """Return plain values as a TOML document. TOML has no `None`: keys with this value are left out.

    Args:
        tables: the document's keys and tables.
        comment: the comment behind each key.
    """
    document = tomlkit.document()
    _fill(document, tables, (), comment)
    return tomlkit.dumps(document).lstrip("\n")


def _fill(container: Any, values: Mapping[str, Any], keys: tuple[str, ...], comment: Comment) -> None:
    """Put values into a table; plain ones first, because everything after a table's header belongs to it."""
    plain = {key: value for key, value in values.items() if value is not None and not _is_table(value)}
    for key, value in plain.items():
        item = _inline(value)
        text = " ".join(comment((*keys, key)).split())
        if text:
            item.comment(text)
        container.add(key, item)
    for key, value in values.items():
        if _is_table(value):
            table = _table(value)
            _fill(table, value, (*keys, key), comment)
            container.add(key, table)


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping) and bool(value)


def _table(values: Mapping[str, Any]) -> Table:
    """Make a table; one that contains only tables needs no header of its own."""
    return tomlkit.table(is_super_table=all(_is_table(value) for value in values.values()))


def _inline(value: Any) -> Item:
    if isinstance(value, Mapping):
        table: InlineTable = tomlkit.inline_table()
        for key, inner in value.items():
            if inner is not None:
                table.append(key, _inline(inner))
        return table
    if isinstance(value, (list, tuple)):
        array: Array = tomlkit.array()
        for inner in value:
            array.append(_inline(inner))
        return array
    if is_array(value):
        return _inline(as_list(value))
    return tomlkit.item(value)
