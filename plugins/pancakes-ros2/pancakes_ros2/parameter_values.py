"""The settings of a task as parameters of ROS 2, and back. Pure: values are what has their fields.

A parameter has a flat name, so a key of a table is behind the table's name and a dot. What no parameter can be (a list
of tables, a mixed list, nothing) is left out.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Final

from pancakes_ros2.ros_message import put_at

NOT_SET, BOOL, INTEGER, DOUBLE, STRING = 0, 1, 2, 3, 4
BOOLS, INTEGERS, DOUBLES, STRINGS = 6, 7, 8, 9
"""`type` of rcl_interfaces/ParameterValue; 5 are bytes."""
FIELDS: Final = {
    BOOL: "bool_value",
    INTEGER: "integer_value",
    DOUBLE: "double_value",
    STRING: "string_value",
    5: "byte_array_value",
    BOOLS: "bool_array_value",
    INTEGERS: "integer_array_value",
    DOUBLES: "double_array_value",
    STRINGS: "string_array_value",
}
"""The field of rcl_interfaces/ParameterValue that has the value of a type."""
_KINDS: Final = {bool: (BOOL, BOOLS), int: (INTEGER, INTEGERS), float: (DOUBLE, DOUBLES), str: (STRING, STRINGS)}


def type_of(value: Any) -> int:
    """Returns the parameter type of a plain value; `NOT_SET`: it can be no parameter."""
    if isinstance(value, (list, tuple)):
        kinds = {type(item) for item in value}
        if kinds == {int, float}:
            return DOUBLES
        kind = _KINDS.get(kinds.pop()) if len(kinds) == 1 else None
        return kind[1] if kind is not None else NOT_SET
    kind = _KINDS.get(type(value))
    return kind[0] if kind is not None else NOT_SET


def flat(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Returns the parameters of settings, by name."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{before}{key}"
        if isinstance(value, Mapping):
            found.update(flat(value, f"{name}."))
        elif type_of(value) != NOT_SET:
            found[name] = value
    return found


def fill_value(message: Any, value: Any) -> None:
    """Fills a rcl_interfaces/ParameterValue."""
    kind = type_of(value)
    message.type = kind
    if kind == DOUBLES:
        value = [float(item) for item in value]
    elif isinstance(value, tuple):
        value = list(value)
    if kind != NOT_SET:
        setattr(message, FIELDS[kind], value)


def value_of(message: Any) -> Any:
    """Returns the plain value of a rcl_interfaces/ParameterValue; None: it is not set."""
    field = FIELDS.get(message.type)
    if field is None:
        return None
    value = getattr(message, field)
    return value if isinstance(value, (bool, int, float, str)) else list(value)


def changes_of(settings: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what to ask for so that parameters get other values: whole tables, as `Configure` wants them.

    Args:
        settings: the present settings.
        wanted: the new values, by the name of the parameter.
    """
    changes: dict[str, Any] = {}
    for name, value in wanted.items():
        first = name.partition(".")[0]
        if first not in changes:
            changes[first] = copy.deepcopy(settings.get(first))
        if first == name:
            changes[first] = value
        else:
            if not isinstance(changes[first], dict):
                changes[first] = {}
            put_at(changes, name, value)
    return changes
