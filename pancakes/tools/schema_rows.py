"""Turn a JSON Schema into rows for people: keys, types, defaults and bounds."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from pancakes.config.toml_writer import key_text, value_text

COLUMNS: Final = ("param", "type", "default", "bounds", "unit", "description")

_REF: Final = "#/$defs/"
_TYPES: Final = {
    "string": "text",
    "integer": "integer",
    "number": "number",
    "boolean": "true or false",
    "array": "list",
    "object": "table",
    "null": "nothing",
}
_UNITS: Final = {
    "per_m": "1/m",
    "per_s": "1/s",
    "j_per_m": "J/m",
    "radps": "rad/s",
    "mps": "m/s",
    "mib": "MiB",
    "rad": "rad",
    "deg": "°",
    "mah": "mAh",
    "hz": "Hz",
    "ms": "ms",
    "mm": "mm",
    "m": "m",
    "s": "s",
    "v": "V",
    "w": "W",
    "j": "J",
}
"""Units by the endings of names; longer endings come first."""
_BOUNDS: Final = (
    ("exclusiveMinimum", "> {}"),
    ("minimum", ">= {}"),
    ("exclusiveMaximum", "< {}"),
    ("maximum", "<= {}"),
    ("multipleOf", "a multiple of {}"),
    ("minLength", "at least {} long"),
    ("maxLength", "at most {} long"),
    ("minItems", "at least {} items"),
    ("maxItems", "at most {} items"),
    ("pattern", "matches {}"),
)


def rows_of(
    schema: Mapping[str, Any], keys: tuple[str, ...] = (), definitions: Mapping[str, Any] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield a row for each key of an object, each followed by the rows of the tables inside it.

    A row has `param` (a key as in TOML; `NAME` stands for any name), `type`, `default` (None without a default),
    `required`, `bounds`, `unit` and `description`.

    Args:
        schema: the object's schema, as `pancakes.util.schema` makes it.
        keys: the path of keys to the object.
        definitions: the targets of references; None: the schema's own `$defs`.
    """
    definitions = schema.get("$defs", {}) if definitions is None else definitions
    required = schema.get("required", ())
    for name, part in schema.get("properties", {}).items():
        path = (*keys, name)
        yield {
            "param": key_text(path),
            "type": type_of(part, definitions),
            "default": part.get("default"),
            "required": name in required,
            "bounds": bounds_of(resolved(part, definitions)),
            "unit": part.get("unit") or unit_of(name),
            "description": part.get("description", ""),
        }
        yield from _inside(part, path, definitions)


def unit_of(name: str) -> str:
    """Return the unit at the end of a quantity's name, such as metres for `radius_m`; empty if it has none."""
    return next((unit for ending, unit in _UNITS.items() if name.endswith(f"_{ending}") or name == ending), "")


def _inside(part: Mapping[str, Any], path: tuple[str, ...], definitions: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for arm in arms_of(resolved(part, definitions), definitions):
        if "properties" in arm:
            yield from rows_of(arm, path, definitions)
        values = arm.get("additionalProperties")
        if isinstance(values, Mapping):
            for inner in arms_of(resolved(values, definitions), definitions):
                if "properties" in inner:
                    yield from rows_of(inner, (*path, "NAME"), definitions)


def resolved(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> Mapping[str, Any]:
    """Follow a reference; keys beside the reference override keys of its target."""
    reference = part.get("$ref")
    if not isinstance(reference, str) or not reference.startswith(_REF):
        return part
    found = definitions.get(reference.removeprefix(_REF), {})
    return {**found, **{key: value for key, value in part.items() if key != "$ref"}}


def arms_of(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the alternative schemas, one of which a value must fit."""
    arms = part.get("anyOf") or part.get("oneOf")
    return [resolved(arm, definitions) for arm in arms] if arms else [part]


def type_of(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """Return the type of a value, in words."""
    words = dict.fromkeys(_word(arm, definitions) for arm in arms_of(resolved(part, definitions), definitions))
    # Leave out null: an optional key has no default, and TOML has no null.
    return " or ".join(word for word in words if word != "nothing" or len(words) == 1)


def _word(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if "enum" in part:
        return " or ".join(value_text(value) for value in part["enum"])
    if "const" in part:
        return value_text(part["const"])
    kind = part.get("type")
    if isinstance(kind, list):
        return " or ".join(_TYPES.get(str(one), str(one)) for one in kind)
    if kind == "array" and isinstance(part.get("items"), Mapping) and part["items"]:
        return f"list of {type_of(part['items'], definitions)}"
    return _TYPES.get(str(kind), "anything")


def bounds_of(part: Mapping[str, Any]) -> str:
    """Return the bounds of a value, in words; `part` must be resolved."""
    arms = part.get("anyOf") or [part]
    found = []
    for arm in arms:
        words = [text.format(_short(arm[key])) for key, text in _BOUNDS if key in arm]
        if words:
            found.append(", ".join(words))
    return " or ".join(dict.fromkeys(found))


def _short(value: Any) -> str:
    return re.sub(r"\.0$", "", f"{value:g}" if isinstance(value, float) else str(value))
