"""The settings of a task as fields of a page: what each is, within which bounds, and how it is changed. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any, Final

from pancakes.runtime.config.toml_text import key_text
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.arrays import without_arrays
from pancakes.tools.schema_rows import arms_of, bounds_of, resolved, type_of, unit_of

LONGEST_VALUE: Final = 2000
"""A value that is longer as JSON is not changed on a page."""
MOST_BYTES: Final = 64 * 1024
"""So long are all fields of a task together as JSON, at most; the others are left out."""
EXACT: Final = 2**53
"""A browser has no larger integers."""
_KINDS: Final = {"number": "number", "integer": "integer", "string": "text", "boolean": "boolean"}


def fields_of(schema: Mapping[str, Any], settings: Mapping[str, Any]) -> tuple[list[dict[str, Any]], int]:
    """Returns a field for each setting, and how many were left out.

    A field has `path` (the keys that lead to the value), `name` (the same as TOML writes it), `kind` (`number`,
    `integer`, `boolean`, `text`, `choice`, or `json` for all else), `type`, `bounds`, `unit`, `description` (for
    people), `value`, `nullable`; and where there are such, `default`, `min`, `max`, `choices`. What is in a table of
    known keys has fields of its own. Where the value cannot be changed on a page, `fixed` says why, and `value` is a
    text.

    Args:
        schema: the JSON Schema of the settings; empty: it is not known.
        settings: the present values, plain or numpy arrays.
    """
    made: list[dict[str, Any]] = []
    left = MOST_BYTES
    found = list(_fields(schema, settings, (), schema.get("$defs", {})))
    for _, group in groupby(found, lambda field: field["path"][0]):
        fields = _changed_together(list(group))
        left -= len(codecs.encode_json(fields))
        if left < 0:
            return made, len(found) - len(made)
        made.extend(fields)
    return made, 0


def _changed_together(fields: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the fields of one table, which is set as a whole: where one cannot be changed, no other can be."""
    fixed = next((field for field in fields if "fixed" in field), None)
    if fixed is None:
        return fields
    reason = f"it is in one table with {fixed['name']}, which is {fixed['fixed']}"
    return [
        field if "fixed" in field else {**field, "value": _shown(field["value"]), "fixed": reason} for field in fields
    ]


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else codecs.encode_json(value).decode()


def _fields(
    schema: Mapping[str, Any], values: Mapping[str, Any], keys: tuple[str, ...], definitions: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    properties = schema.get("properties", {})
    for name in dict.fromkeys((*properties, *values)):
        part = properties.get(name, {})
        path = (*keys, name)
        value = values.get(name)
        arm, nullable = _arm(part, definitions)
        if "properties" in arm and isinstance(value, Mapping) and value:
            yield from _fields(arm, value, path, definitions)
        else:
            yield _field(part, arm, nullable, path, without_arrays(value), definitions)


def _arm(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> tuple[Mapping[str, Any], bool]:
    """Returns the schema that a value has to fit where it is there, and whether it may be nothing instead.

    Where there are several such schemas, the first is empty: no kind of field fits all of them.
    """
    arms = arms_of(resolved(part, definitions), definitions)
    there = [arm for arm in arms if arm.get("type") != "null"]
    return (there[0] if len(there) == 1 else {}), len(there) < len(arms)


def _field(
    part: Mapping[str, Any],
    arm: Mapping[str, Any],
    nullable: bool,
    path: tuple[str, ...],
    value: Any,
    definitions: Mapping[str, Any],
) -> dict[str, Any]:
    choices = [True, False] if nullable and arm.get("type") == "boolean" else _choices(arm)
    if choices and nullable and None not in choices:
        choices = [*choices, None]
    kind = "choice" if choices else _KINDS.get(str(arm.get("type")), "json")
    field: dict[str, Any] = {
        "path": path,
        "name": key_text(path),
        "kind": kind,
        "type": type_of(part, definitions),
        "bounds": bounds_of(resolved(part, definitions)),
        "unit": part.get("unit") or unit_of(path[-1]),
        "description": part.get("description", ""),
        "nullable": nullable,
        "value": value,
    }
    if "default" in part:
        field["default"] = part["default"]
    if choices:
        field["choices"] = choices
    if kind in ("number", "integer"):
        for name, keys in (("min", ("minimum", "exclusiveMinimum")), ("max", ("maximum", "exclusiveMaximum"))):
            bound = next((arm[key] for key in keys if key in arm), None)
            if bound is not None:
                field[name] = bound
    text = codecs.encode_json(value).decode(errors="replace")
    if len(text) > LONGEST_VALUE:
        return {**field, "value": f"{text[:120]}…", "fixed": f"{len(text)} characters long"}
    if _inexact(value):
        return {**field, "value": text, "fixed": "a number that a browser cannot represent"}
    return field


def _choices(arm: Mapping[str, Any]) -> list[Any]:
    if "enum" in arm:
        return list(arm["enum"])
    return [arm["const"]] if "const" in arm else []


def _inexact(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_inexact, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(_inexact, value))
    return isinstance(value, int) and abs(value) > EXACT
