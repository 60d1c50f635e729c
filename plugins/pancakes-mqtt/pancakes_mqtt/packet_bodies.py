"""Convert bodies of packets to JSON and back. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from msgspec import inspect

from pancakes import Packet
from pancakes.errors import RemoteProtocolError
from pancakes.packet import body_class, body_from_plain, body_to_plain, field_names
from pancakes.settings import required_keys
from pancakes.util import codecs
from pancakes_mqtt.payloads import BadPayload, number_of, plain_json, truth_of, value_at


def payload_of(packet: Packet, whole: bool) -> bytes:
    """Return a packet as JSON, in which NaN and infinity are null.

    Args:
        packet: the packet.
        whole: whether to include more than its body.

    Raises:
        BadPayload: JSON cannot express it.
    """
    try:
        body = body_to_plain(packet.body)
    except (TypeError, ValueError, RecursionError) as error:
        raise BadPayload(f"it cannot be written as JSON: {error}") from None
    if not whole:
        return plain_json(body)
    told = {"source": packet.source, "type": packet.type, "stamp": packet.stamp_s, "seq": packet.seq, "body": body}
    return plain_json(told)


def body_in(payload: bytes, kind: str, paths: Mapping[str, str]) -> tuple[Any, list[str]]:
    """Return the packet body in a payload, and what could not be read.

    Numbers and booleans are read as the drivers of sensors read them: as JSON's own, or as texts. A field with a
        default
    keeps it if its value cannot be read.

    Args:
        payload: JSON.
        kind: the type of the packet.
        paths: the path of each field whose path is not its own name.

    Raises:
        BadPayload: there is no body in it.
    """
    cls = body_class(kind)
    names = field_names(cls) if cls is not None else ()
    value = value_at(payload, "")
    if isinstance(value, Mapping):
        plain = {name: value[name] for name in names if name in value and name not in paths}
        plain.update({name: value_at(payload, path) for name, path in paths.items()})
    elif cls is not None and len(needed := required_keys(cls) or names) == 1:
        plain = {next(iter(needed)): value}
    else:
        raise BadPayload(f"{kind} has the fields {', '.join(names) or 'none'}, and the payload is not a JSON object")
    left_out = list(_read_fields(plain, cls)) if cls is not None else []
    try:
        return body_from_plain(kind, plain), left_out
    except RemoteProtocolError as error:
        raise BadPayload(str(error)) from None


def _read_fields(plain: dict[str, Any], cls: type) -> Iterator[str]:
    """Convert the values of fields to their types; yield why a field is left out.

    Raises:
        BadPayload: a required field cannot be read.
    """
    for field in codecs.type_info(cls).fields:  # type: ignore[attr-defined]
        name = field.encode_name
        if name not in plain:
            continue
        try:
            value = _read_value(plain[name], field.type)
        except BadPayload as error:
            if field.required:
                raise BadPayload(f"{name}: {error}") from None
            yield f"{name}: {error}"
            del plain[name]
        else:
            plain[name] = value


def _read_value(value: Any, kind: inspect.Type) -> Any:
    """Convert a value to a number or boolean type; other types are left to `body_from_plain`."""
    if isinstance(kind, inspect.Metadata) and (kind.extra or {}).get("nan"):  # NaN means unknown
        return math.nan if value is None else value if isinstance(value, (int, float)) else number_of(value)
    kinds = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    kinds = tuple(it.type if isinstance(it, inspect.Metadata) else it for it in kinds)
    if any(isinstance(it, inspect.StrType) for it in kinds):
        return value
    if isinstance(value, float) and not math.isfinite(value):
        raise BadPayload(f"{value} is not a finite number")
    if any(isinstance(it, inspect.BoolType) for it in kinds):
        read: Any = value if isinstance(value, (Mapping, list)) else truth_of(value)
    elif any(isinstance(it, (inspect.FloatType, inspect.IntType)) for it in kinds) and isinstance(
        value, (str, type(None))
    ):
        read = number_of(value)
        if read is not None and read.is_integer() and not any(isinstance(it, inspect.FloatType) for it in kinds):
            read = int(read)
    else:
        return value
    if read is None and not any(isinstance(it, inspect.NoneType) for it in kinds):
        raise BadPayload("the device reports no value")
    return read
