"""Messages of any type as plain values, and as packets of the type `ros2.message`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from pancakes.packet import packet_type
from pancakes_ros2.conversion import Unusable
from pancakes_ros2.installation import message_class

_NESTED = re.compile(r"([a-z][a-z0-9_]*/[A-Z][A-Za-z0-9]*)")
_NUMBERS = ("float", "double")


@packet_type("ros2.message")
class RosMessage(msgspec.Struct, frozen=True):
    """A message of ROS 2 for which Pancakes has no packet type.

    Attributes:
        type: its message type, such as `geometry_msgs/msg/Wrench`.
        fields: its fields as plain values; messages in it are mappings.
    """

    type: str
    fields: dict[str, Any]


def plain_of(value: Any) -> Any:
    """Returns a message, or a part of one, as mappings, lists, strings, bytes and numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain_of(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, bytes, bool, int, float)):
        return value
    if hasattr(value, "tolist"):  # an array of Python or numpy
        return value.tolist()
    return [plain_of(item) for item in value]


def fill(message: Any, plain: Mapping[str, Any], path: str = "") -> None:
    """Fills a message from plain values; what is not there keeps its default.

    Raises:
        Unusable: a field is unknown, or a value does not fit; the sentence names the field.
    """
    if not isinstance(plain, Mapping):
        raise Unusable(f"{path or 'the message'} is a message, and {plain!r} is no table of its fields")
    kinds = message.get_fields_and_field_types()
    for name, value in plain.items():
        where = f"{path}.{name}" if path else name
        kind = kinds.get(name)
        if kind is None:
            raise Unusable(f"the message has no field {where!r}, only {', '.join(kinds)}")
        try:
            setattr(message, name, _made(getattr(message, name), kind, value, where))
        except (AssertionError, TypeError, ValueError, OverflowError) as error:
            reason = str(error).split("\n")[0] or type(error).__name__
            raise Unusable(f"{value!r} does not fit the field {where!r}, which is a {kind}: {reason}") from None


def _made(present: Any, kind: str, value: Any, where: str) -> Any:
    nested = _NESTED.search(kind)
    if nested is None:
        if kind in _NUMBERS and isinstance(value, int) and not isinstance(value, bool):
            return float(value)
        if any(number in kind for number in _NUMBERS) and isinstance(value, Sequence) and not isinstance(value, str):
            return [float(item) for item in value]
        return value
    if nested[1] == kind:
        fill(present, value, where)
        return present
    made = []
    for number, item in enumerate(value):
        made.append(message_class(nested[1])())
        fill(made[-1], item, f"{where}[{number}]")
    return made


def value_at(plain: Any, path: str) -> Any:
    """Returns what stands at a dotted path of plain values.

    Raises:
        Unusable: there is nothing.
    """
    for part in path.split("."):
        if not isinstance(plain, Mapping) or part not in plain:
            raise Unusable(f"there is no {path!r}")
        plain = plain[part]
    return plain


def put_at(plain: dict[str, Any], path: str, value: Any) -> None:
    """Puts a value at a dotted path of plain values."""
    *outer, last = path.split(".")
    for part in outer:
        plain = plain.setdefault(part, {})
    plain[last] = value
