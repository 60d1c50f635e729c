"""What a page may ask for, checked: a message becomes a control packet, or a sentence why not. Pure.

`fields_of` describes the settings of a task as form fields: type, bounds, and how each is changed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Annotated, Any, Final, Literal

import msgspec

from pancakes.config.toml_writer import key_text
from pancakes.control import Configure, Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefused
from pancakes.kernel.handlers import period_of
from pancakes.tools.schema_rows import arms_of, bounds_of, resolved, type_of, unit_of
from pancakes.util import codecs
from pancakes.util.arrays import without_arrays
from pancakes.util.text import NAME

LONGEST_VALUE: Final = 2000
"""A value that is longer as JSON is not changed on a page."""
MOST_BYTES: Final = 64 * 1024
"""So long are all fields of a task together as JSON, at most; the others are left out."""
EXACT: Final = 2**53
"""A browser has no larger integers."""
_KINDS: Final = {"number": "number", "integer": "integer", "string": "text", "boolean": "boolean"}


def fields_of(schema: Mapping[str, Any], settings: Mapping[str, Any]) -> tuple[list[dict[str, Any]], int]:
    """Return a field for each setting, and how many were left out.

    A field has `path` (the keys that lead to the value), `name` (the same as TOML writes it), `kind` (`number`,
    `integer`, `boolean`, `text`, `choice`, or `json` for all else), `type`, `bounds`, `unit`, `description` (for
    people), `value`, `nullable`; and if there are such, `default`, `min`, `max`, `choices`. What is in a table of
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
    """Return the fields of one table, which is set as a whole: if one cannot be changed, no other can be."""
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
    """Return the schema that a value has to fit where it is there, and whether it may be nothing instead.

    If there are several such schemas, the first is empty: no kind of field fits all of them.
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


MOST_SETTINGS: Final = 64
"""The most settings that one order may change."""
MOST_VALUES: Final = 1000
"""The most values in them, those in lists and tables counted."""
LONGEST_TEXT: Final = 4000
"""The most characters of one text in them."""
MOST_DEEP: Final = 8
"""The most lists and tables that may lie in each other."""
MOST_INTEGER: Final = 2**63 - 1

AgentName = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z")]
ServiceTask = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}/{NAME}\Z")]
"""A task on an agent, as `service/task`."""
Method = Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z_]\w{0,99}\Z")]


class PageOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a page may ask of an agent.

    Attributes:
        agent: the agent's name.
        task: the task on it, as `service/task`.
        do: what is to be done with the task.
        dry_run: whether the agent only checks it.
        to: the agent that the task moves to; of `migrate` alone.
        rate_hz: the task's new rate; of `rate` alone.
        timer: the method that ticks, where the task has several; of `rate` alone.
        settings: the new values by name, plain; of `configure` alone.
    """

    agent: AgentName
    task: ServiceTask
    do: Literal["migrate", "rate", "configure", "stop", "start", "restart"]
    dry_run: bool = False
    to: AgentName | None = None
    rate_hz: float | None = None
    timer: Method | None = None
    settings: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        for field, do, given in (
            ("to", "migrate", self.to),
            ("rate_hz", "rate", self.rate_hz),
            ("settings", "configure", self.settings),
        ):
            if (given is not None) != (self.do == do):
                raise ValueError(f"{field} goes with {do!r}, and with nothing else")
        if self.timer is not None and self.do != "rate":
            raise ValueError("timer goes with 'rate', and with nothing else")
        if self.rate_hz is not None:
            period_of(self.rate_hz)  # it says so of one that no agent takes
        if self.settings is not None and (fault := _fault_of(self.settings)):
            raise ValueError(fault)

    def body(self) -> Migrate | Reschedule | Configure | Stop | Start | Restart:
        """Return the control packet's body."""
        if self.to is not None:
            return Migrate(self.task, self.to, dry_run=self.dry_run)
        if self.rate_hz is not None:
            return Reschedule(self.task, self.rate_hz, self.timer or "", self.dry_run)
        if self.settings is not None:
            return Configure(self.task, self.settings, self.dry_run)
        return _PLAIN[self.do](self.task, dry_run=self.dry_run)


_PLAIN: Final[Mapping[str, type[Stop] | type[Start] | type[Restart]]] = {
    "stop": Stop,
    "start": Start,
    "restart": Restart,
}


def order_from(message: Any) -> PageOrder:
    """Make an order of a message.

    Raises:
        ControlRefused: it is none; the sentence says what is wrong with it.
    """
    try:
        return codecs.convert(message, PageOrder)
    except msgspec.ValidationError as error:
        raise ControlRefused(f"the page asked for what it cannot have: {_lower(str(error))}") from None


def _lower(text: str) -> str:
    return re.sub(r"^\w", lambda found: found[0].lower(), text)


def _fault_of(settings: Mapping[str, Any]) -> str:
    """Say why settings are more than a page may ask for; whether they are good the agent says. Empty: they are not."""
    if not settings:
        return "settings are empty"
    if len(settings) > MOST_SETTINGS:
        return f"{len(settings)} settings at once are too many, {MOST_SETTINGS} may be"
    for count, fault in enumerate(_faults(settings, 0)):
        if fault:
            return fault
        if count > MOST_VALUES:
            return f"settings of more than {MOST_VALUES} values are too many"
    return ""


def _faults(value: Any, depth: int) -> Iterator[str]:
    """Yield for each value in settings what is wrong with it; an empty text if nothing is."""
    if depth > MOST_DEEP:
        yield f"settings are nested more than {MOST_DEEP} deep"
    elif isinstance(value, Mapping):
        yield ""
        for key, item in value.items():
            yield _fault_of_text(key) if isinstance(key, str) else "a key of settings is no text"
            yield from _faults(item, depth + 1)
    elif isinstance(value, list):
        yield ""
        for item in value:
            yield from _faults(item, depth + 1)
    elif isinstance(value, str):
        yield _fault_of_text(value)
    elif isinstance(value, float):
        yield "" if math.isfinite(value) else "a number in settings is not finite"
    elif isinstance(value, int):
        yield "" if abs(value) <= MOST_INTEGER else "a number in settings is too large"
    else:
        yield "" if value is None else f"a value in settings is a {type(value).__name__}"


def _fault_of_text(text: str) -> str:
    return "" if len(text) <= LONGEST_TEXT else f"a text in settings has more than {LONGEST_TEXT} characters"
