"""Makes the bodies of packets out of what a person writes, and says which field is wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from inspect import get_annotations
from typing import Any

import msgspec

from pancakes.errors import PancakesError
from pancakes.packet import body_class, field_names, known_types
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed
from pancakes.runtime.foundation.suggestion import hint_of


class BadBody(PancakesError):
    """What was written is no body of a packet."""


def body_of(kind: str, text: str) -> Any:
    """Returns the body of a packet of the type `kind`, from JSON. The types have to be loaded (`load_packets`).

    Raises:
        BadBody: there is no such type, or the text does not fit it; the sentence names the field.
    """
    cls = body_class(kind)
    if cls is None:
        raise BadBody(f"no packet type {kind!r} is installed here{hint_of(kind, known_types())}")
    try:
        given: Any = codecs.json_decoder()(text)
    except MALFORMED as error:
        why = why_malformed(error).removeprefix("JSON is malformed: ")
        raise BadBody(f"the body is no JSON: {_lower(why)}") from None
    if not isinstance(given, Mapping):
        raise BadBody(f"the body must be a JSON object with the fields of {kind}: {_fields(cls)}")
    try:
        body: Any = codecs.convert(given, cls)
    except msgspec.ValidationError as error:
        raise BadBody(f"{_sentence(kind, str(error))}; its fields are {_fields(cls)}") from None
    for path, names in _unknown(given, msgspec.to_builtins(body)):
        name = path.rpartition(".")[2]
        whole = f"{kind}.{path.rpartition('.')[0]}".rstrip(".")
        raise BadBody(f"{whole} has no field {name!r}{hint_of(name, names) or ', only none at all'}")
    return body


def _sentence(kind: str, error: str) -> str:
    """Returns what msgspec says, such as "Expected `float`, got `str` - at `$.x_m`", with the field first."""
    what, _, where = error.partition(" - at `$")
    field = f"{kind}{where.rstrip('`')}" if where else kind
    return f"{field}: {_lower(what)}"


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]


def _fields(cls: type) -> str:
    """Returns the fields of a body, each with the type that it must be of."""
    kinds = {name: kind for base in reversed(cls.__mro__) for name, kind in get_annotations(base).items()}
    named = ((name, kinds.get(name, "")) for name in field_names(cls))
    return ", ".join(f"{name} ({getattr(kind, '__name__', kind)})" for name, kind in named) or "none"


def _unknown(given: Any, taken: Any, path: str = "") -> Iterator[tuple[str, list[str]]]:
    """Yields the paths of what was given and not taken, each with the names that there are."""
    if isinstance(given, Mapping) and isinstance(taken, Mapping):
        for name, item in given.items():
            if name not in taken:
                yield f"{path}{name}", list(taken)
            else:
                yield from _unknown(item, taken[name], f"{path}{name}.")
    elif isinstance(given, list) and isinstance(taken, (list, tuple)):
        for index, (one, other) in enumerate(zip(given, taken, strict=False)):
            yield from _unknown(one, other, f"{path}{index}.")
