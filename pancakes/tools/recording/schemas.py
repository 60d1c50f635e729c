"""The schemas that a recording has, in the few words of JSON Schema that viewers understand.

Foxglove, and what is made of it, makes a table of a message's fields of its schema. It wants a `type` for each field,
`properties` for each object and `items` for each array, and gives up a whole topic where it finds a reference, a choice
or an array of arrays. What cannot be said in these words is left out of a schema; it is in the messages all the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pancakes.packet import body_class
from pancakes.runtime.foundation.schema import schema_of

SCHEMAS: Final = "pancakes."
"""What the names of the schemas of packets begin with."""
_SIMPLE: Final = {"boolean": bool, "string": str, "integer": int, "number": float}
_KEPT: Final = ("title", "description", "default")


def schema_for(type_name: str) -> dict[str, Any]:
    """Returns the JSON Schema of the messages of one packet type; of a type that is unknown here, of any body."""
    cls = body_class(type_name)
    try:
        told: dict[str, Any] = schema_of(cls) if cls is not None else {}
    except (TypeError, NameError):  # JSON Schema has no word for a part of it, or it is imported for checks only
        told = {}
    body = viewable(told, told.get("$defs", {}))
    return {
        "title": SCHEMAS + type_name,
        "description": (
            "A packet. Besides what is said here it has `cause`, the source and number of the packet that led to it,"
            " and `fence`, the identity and epoch of the task that published it; both may be null."
        ),
        "type": "object",
        "properties": {
            "source": {"type": "string", "description": "address of the publisher."},
            "destination": {"type": "string", "description": "the address that it is for; empty: all subscribers."},
            "stamp": {"type": "number", "description": "mission time at the publisher, in seconds."},
            "seq": {"type": "integer", "description": "its number among its source's packets."},
            "body": body if body is not None and body["type"] == "object" else {"type": "object", "properties": {}},
            "exact": {
                "type": "string",
                "description": "the packet as it travels, where JSON cannot express all of it.",
            },
        },
    }


def viewable(
    schema: Mapping[str, Any], definitions: Mapping[str, Any], inside: tuple[str, ...] = ()
) -> dict[str, Any] | None:
    """Returns a schema in the words that viewers understand; None where it cannot be said in them.

    What may be missing (null) is described as what it is where it is there.

    Args:
        schema: a schema, as msgspec makes it.
        definitions: what it refers to, by name.
        inside: the names of the definitions that it stands in: what contains itself cannot be written out.
    """
    reference = schema.get("$ref")
    if reference is not None:
        name = reference.rpartition("/")[2]
        if name in inside or name not in definitions:
            return None
        found = viewable(definitions[name], definitions, (*inside, name))
        return found if found is None else {**found, **_kept(schema)}
    if "anyOf" in schema:
        choices = [choice for choice in schema["anyOf"] if choice.get("type") != "null"]
        found = viewable(choices[0], definitions, inside) if len(choices) == 1 else None
        return found if found is None else {**found, **_kept(schema)}
    kind = schema.get("type") or _kind_of(schema.get("enum", ()))
    if kind in _SIMPLE:
        return {"type": kind, **_kept(schema)}
    if kind == "object":
        fields = {name: viewable(field, definitions, inside) for name, field in schema.get("properties", {}).items()}
        there = {name: field for name, field in fields.items() if field is not None}
        return {"type": "object", **_kept(schema), "properties": there}
    if kind == "array":
        items = viewable(_item_of(schema), definitions, inside)
        if items is None or items["type"] == "array":
            return None
        return {"type": "array", **_kept(schema), "items": items}
    return None


def _kept(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {word: schema[word] for word in _KEPT if schema.get(word) is not None}


def _kind_of(values: Any) -> str:
    """Returns the type of all values that a field may have; empty where they have several."""
    return next((kind for kind, cls in _SIMPLE.items() if values and all(type(it) is cls for it in values)), "")


def _item_of(schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the schema of each item of an array; an empty one where they differ."""
    first, *others = schema.get("prefixItems") or [schema.get("items") or {}]
    found: Mapping[str, Any] = first if all(other == first for other in others) else {}
    return found
