"""Check the orders of a page: a message becomes a control packet, or a refusal with a reason. Pure.

`fields_of` describes the settings of a task as form fields: type, bounds, and how to change each.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Annotated, Any, Final, Literal

import msgspec

from pancakes.config.toml_writer import key_text
from pancakes.control import Configure, Drive, EndDrive, EndHalt, Halt, Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefusedError
from pancakes.kernel.handlers import period_of
from pancakes.tools.schema_rows import arms_of, bounds_of, resolved, type_of, unit_of
from pancakes.util import codecs
from pancakes.util.arrays import without_arrays
from pancakes.util.text import NAME

LONGEST_VALUE: Final = 2000
"""The longest value that a page can change, in characters of JSON."""
MOST_BYTES: Final = 64 * 1024
"""The most bytes of JSON for all fields of a task; further fields are left out."""
EXACT: Final = 2**53
"""The largest integer that a browser represents exactly."""
_KINDS: Final = {"number": "number", "integer": "integer", "string": "text", "boolean": "boolean"}


def fields_of(schema: Mapping[str, Any], settings: Mapping[str, Any]) -> tuple[list[dict[str, Any]], int]:
    """Return a field for each setting, and how many were left out.

    A field has `path` (the keys that lead to the value), `name` (the same as TOML writes it), `kind` (`number`,
    `integer`, `boolean`, `text`, `choice`, or `json` for everything else), `type`, `bounds`, `unit`, `description` (for
    people), `value`, `nullable`; and if they exist, `default`, `min`, `max`, `choices`. Each value in a table with
    known keys has its own field. If a page cannot change the value, `fixed` says why, and `value` is a text.

    Args:
        schema: the JSON Schema of the settings; empty: unknown.
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
    """Return the fields of one table. It is set as a whole, so one field that cannot be changed fixes all others."""
    fixed = next((field for field in fields if "fixed" in field), None)
    if fixed is None:
        return fields
    reason = f"it is in the same table as {fixed['name']}, which is {fixed['fixed']}"
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
    """Return the schema of a value that is not null, and whether null is allowed too.

    If several schemas are allowed, the result is empty: no kind of field fits all of them.
    """
    arms = arms_of(resolved(part, definitions), definitions)
    not_null = [arm for arm in arms if arm.get("type") != "null"]
    return (not_null[0] if len(not_null) == 1 else {}), len(not_null) < len(arms)


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
"""The most values in the settings of one order, including those in lists and tables."""
LONGEST_TEXT: Final = 4000
"""The longest text in them, in characters."""
MOST_DEEP: Final = 8
"""The deepest nesting of lists and tables in them."""
MOST_INTEGER: Final = 2**63 - 1

AgentName = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z")]
ServiceTask = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}/{NAME}\Z")]
"""A task on an agent, as `service/task`."""
Method = Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z_]\w{0,99}\Z")]


class PageOrder(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An order of a page to an agent.

    Attributes:
        agent: the agent's name.
        task: the task on it, as `service/task`.
        do: what to do with the task.
        dry_run: whether the agent only checks the order.
        to: the agent that the task migrates to; only with `migrate`.
        rate_hz: the task's new rate; only with `rate`.
        timer: the method that ticks, if the task has several; only with `rate`.
        settings: the new plain values by name; only with `configure`.
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
                raise ValueError(f"{field} belongs to {do!r}, and only to it")
        if self.timer is not None and self.do != "rate":
            raise ValueError("timer belongs to 'rate', and only to it")
        if self.rate_hz is not None:
            period_of(self.rate_hz)  # raises an error for a rate that no agent takes
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


class PageHalt(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A halt that a page orders from an agent, or its end.

    Attributes:
        agent: the agent's name.
        do: which of the two.
        reason: why, for people; only with `halt`.
    """

    agent: AgentName
    do: Literal["halt", "end_halt"]
    reason: Annotated[str, msgspec.Meta(max_length=200)] = ""

    def __post_init__(self) -> None:
        if self.reason and self.do != "halt":
            raise ValueError("reason belongs to 'halt', and only to it")

    def body(self) -> Halt | EndHalt:
        """Return the control packet's body."""
        return Halt(self.reason) if self.do == "halt" else EndHalt()


MOST_SPEED: Final = 1000.0
"""The highest speed, in m/s or rad/s, that a page may ask for: the robot has limits of its own."""
Speed = Annotated[float, msgspec.Meta(ge=-MOST_SPEED, le=MOST_SPEED)]


class PageDrive(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A velocity with which a person on a page drives an actuator, or the end of that drive.

    Attributes:
        agent: the agent's name.
        device: the actuator on it.
        do: which of the two.
        drive: names the drive, a random text of the page; the message itself has an `id`.
        v_mps: forward speed; only with `drive`, as all that follow.
        omega_radps: turning rate, counter-clockwise.
        begin: whether it begins a drive.
        take: whether it takes over from another driver.
    """

    agent: AgentName
    device: AgentName
    do: Literal["drive", "end_drive"]
    drive: Annotated[str, msgspec.Meta(pattern=r"\A[0-9a-f]{8,64}\Z")]
    v_mps: Speed = 0.0
    omega_radps: Speed = 0.0
    begin: bool = False
    take: bool = False

    def __post_init__(self) -> None:
        if self.do != "drive" and (self.v_mps or self.omega_radps or self.begin or self.take):
            raise ValueError("v_mps, omega_radps, begin and take belong to 'drive', and only to it")

    def body(self) -> Drive | EndDrive:
        """Return the control packet's body."""
        if self.do == "end_drive":
            return EndDrive(self.device, self.drive)
        return Drive(self.device, self.drive, self.v_mps, self.omega_radps, self.begin, self.take)


def order_from(message: Any) -> PageOrder | PageHalt | PageDrive:
    """Convert a message of a page to an order.

    Raises:
        ControlRefusedError: the message is not a valid order; the sentence says why.
    """
    try:
        if isinstance(message, Mapping) and message.get("do") in ("halt", "end_halt"):
            return codecs.convert(message, PageHalt)
        if isinstance(message, Mapping) and message.get("do") in ("drive", "end_drive"):
            return codecs.convert(message, PageDrive)
        return codecs.convert(message, PageOrder)
    except msgspec.ValidationError as error:
        raise ControlRefusedError(f"the page sent an invalid order: {_lower(str(error))}") from None


def _lower(text: str) -> str:
    return re.sub(r"^\w", lambda found: found[0].lower(), text)


def _fault_of(settings: Mapping[str, Any]) -> str:
    """Return why settings exceed the limits of a page; empty if they do not. The agent checks the values."""
    if not settings:
        return "settings are empty"
    if len(settings) > MOST_SETTINGS:
        return f"{len(settings)} settings at once are too many, at most {MOST_SETTINGS} are allowed"
    for count, fault in enumerate(_faults(settings, 0)):
        if fault:
            return fault
        if count > MOST_VALUES:
            return f"settings have more than {MOST_VALUES} values"
    return ""


def _faults(value: Any, depth: int) -> Iterator[str]:
    """Yield for each value in settings what is wrong with it; empty if it is valid."""
    if depth > MOST_DEEP:
        yield f"settings are nested more than {MOST_DEEP} deep"
    elif isinstance(value, Mapping):
        yield ""
        for key, item in value.items():
            yield _fault_of_text(key) if isinstance(key, str) else "a key of settings is not a text"
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
