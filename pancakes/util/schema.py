"""Make the JSON Schema of a dataclass, with descriptions from its docstring."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from pancakes.util import codecs
from pancakes.util.arrays import is_array_type
from pancakes.util.docstring import docstring_of

_REF: Final = "#/$defs/{name}"


def schema_of(cls: type) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a dataclass, such as the `Settings` of a task.

    A field's `description` comes from the class's docstring, under `Attributes:`. The types of its fields are under
    `$defs`.

    Args:
        cls: a dataclass whose fields have types that msgspec can check.

    Raises:
        TypeError: a field has another type.
    """
    reach = dataclasses_of(cls)
    reference, components = codecs.schema_components(cls, _REF, _array)
    for name, component in components.items():
        found = reach.get(name)
        if found is not None:
            _describe(component, found)
    name = reference["$ref"].rpartition("/")[2] if "$ref" in reference else ""
    schema: dict[str, Any] = components.pop(name, reference)
    if components:
        schema["$defs"] = components
    return schema


def _array(kind: type) -> dict[str, Any]:
    if is_array_type(kind):
        return {"type": "array"}  # of numbers, or nested arrays of numbers
    raise NotImplementedError


def summary_of(cls: type) -> str:
    """Return the first sentence of a class's docstring; empty if it has none."""
    return " ".join(docstring_of(cls).split("\n\n")[0].split())


def field_notes(cls: type) -> dict[str, str]:
    """Return the descriptions of fields in the docstrings of a class and its bases, by name."""
    from docstring_parser import DocstringStyle, parse

    notes: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        for parameter in parse(docstring_of(base), DocstringStyle.GOOGLE).params:
            notes[parameter.arg_name] = " ".join((parameter.description or "").split())
    return notes


def _describe(component: dict[str, Any], cls: type) -> None:
    summary = summary_of(cls)
    if summary:
        component["description"] = summary
    else:
        component.pop("description", None)
    notes = field_notes(cls)
    for name, part in component.get("properties", {}).items():
        if name in notes:
            part["description"] = notes[name]


def dataclasses_of(cls: type) -> dict[str, type]:
    """Return a dataclass and all dataclasses in it, itself first, by msgspec's names."""
    found: dict[str, type] = {}
    ahead = [cls]
    while ahead:
        one = ahead.pop()
        if found.get(one.__name__) is one:
            continue
        found[one.__name__] = one
        info = codecs.type_info(one)
        ahead.extend(_dataclasses_in(info, top=True))
    return found


def _dataclasses_in(info: Any, top: bool = False) -> list[type]:
    """Return the dataclasses directly inside a type."""
    if isinstance(info, (msgspec.inspect.DataclassType, msgspec.inspect.StructType)) and not top:
        return [info.cls]
    inside: list[type] = []
    for name in info.__struct_fields__:
        value = getattr(info, name)
        for item in value if isinstance(value, tuple) else (value,):
            if isinstance(item, msgspec.inspect.Field):
                inside.extend(_dataclasses_in(item.type))
            elif isinstance(item, msgspec.inspect.Type):
                inside.extend(_dataclasses_in(item))
    return inside
