"""Payloads: values out of what devices say, by a path in their JSON, and what devices are told. Pure.

A path is the keys that lead to a value, with dots between them: `SI7021.Temperature`. A number is a place in a list,
from 0; `*` is the one key under which the rest of the path leads on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED, why_malformed

TRUE: Final = ("on", "true", "1", "yes", "online", "open", "detected", "occupied", "motion")
FALSE: Final = ("off", "false", "0", "no", "offline", "closed", "clear", "not_detected", "none")
UNKNOWN: Final = ("", "unknown", "unavailable", "null")
"""What devices say for: I cannot tell."""
SHOWN: Final = 60
_decode: Final = codecs.json_decoder()


class BadPayload(ValueError):
    """A payload has no such value; the sentence says why."""


def value_at(payload: bytes, path: str) -> Any:
    """Returns the value that a path leads to in a payload.

    Args:
        payload: JSON, or any text where the path is empty.
        path: the path; empty: the whole payload.

    Returns:
        The value; None where the device says null there.

    Raises:
        BadPayload: there is none.
    """
    if not path:
        return _whole(payload)
    value = decoded(payload)
    for number, key in enumerate(keys := path.split(".")):
        if value is None:
            return None
        value = _step(value, key, keys[number + 1 :], path)
    return value


def decoded(payload: bytes) -> Any:
    """Returns what a payload says in JSON. Raises BadPayload."""
    try:
        return _decode(payload)
    except MALFORMED as error:
        raise BadPayload(f"{shown(payload)} is no JSON ({why_malformed(error)})") from None


def _whole(payload: bytes) -> Any:
    try:
        return _decode(payload)
    except MALFORMED:
        try:
            return payload.decode()
        except UnicodeDecodeError:
            raise BadPayload(f"{shown(payload)} is no text") from None


def _step(value: Any, key: str, rest: list[str], path: str) -> Any:
    if isinstance(value, Mapping):
        if key in value:
            return value[key]
        if key == "*":
            found = [inner for inner in value.values() if isinstance(inner, Mapping) and (not rest or rest[0] in inner)]
            if len(found) == 1:
                return found[0]
            several = f"leads to {len(found)} values" if found else "leads to nothing"
            raise BadPayload(f"the path {path!r} {several}; its keys are {_listed(value)}")
        raise BadPayload(f"it has no key {key!r} of the path {path!r}, only {_listed(value)}")
    if isinstance(value, list) and key.isdecimal():
        if int(key) < len(value):
            return value[int(key)]
        raise BadPayload(f"the path {path!r} wants item {key}, and its list has {len(value)}")
    raise BadPayload(f"the path {path!r} leads on at {key!r}, where {shown(value)} stands")


def _listed(value: Mapping[Any, Any]) -> str:
    return ", ".join(str(key) for key in list(value)[:10]) or "none"


def number_of(value: Any) -> float | None:
    """Returns a value as a number; None where the device says that it cannot tell.

    Raises:
        BadPayload: it is none, or not finite.
    """
    if value is None or (isinstance(value, str) and value.strip().lower() in UNKNOWN):
        return None
    if isinstance(value, bool):
        raise BadPayload(f"{shown(value)} is no number")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise BadPayload(f"{shown(value)} is no number") from None
    if not math.isfinite(number):
        raise BadPayload(f"{shown(value)} is no finite number")
    return number


def truth_of(value: Any) -> bool | None:
    """Returns a value as yes or no; None where the device says that it cannot tell. Raises BadPayload."""
    if value is None or isinstance(value, bool):
        return value
    text = str(value).strip().lower()
    if text in UNKNOWN:
        return None
    if text in TRUE:
        return True
    if text in FALSE:
        return False
    raise BadPayload(f"{shown(value)} says neither yes nor no")


def celsius_of(value: float, unit: str) -> float:
    """Returns a temperature in degrees Celsius; the unit is C, F or K."""
    if unit == "F":
        return (value - 32.0) / 1.8
    return value - 273.15 if unit == "K" else value


def text_of(value: Any) -> bytes:
    """Returns a value as a payload: a text as it is, all else as JSON."""
    return value.encode() if isinstance(value, str) else codecs.encode_json(value)


def written(template: str, values: Mapping[str, float]) -> bytes:
    """Returns a template with numbers in the places of their names, such as `{"v": {v_mps}}`."""
    for name, value in values.items():
        template = template.replace(f"{{{name}}}", format(value, ".6g"))
    return template.encode()


def plain_json(value: Any) -> bytes:
    """Returns plain values as JSON, in which NaN and infinity are null.

    Raises:
        BadPayload: there is no JSON for it.
    """
    try:
        return codecs.encode_json(value)
    except (TypeError, ValueError, RecursionError, OverflowError, msgspec.MsgspecError) as error:
        raise BadPayload(f"it cannot be said in JSON: {error}") from None


def shown(value: Any) -> str:
    """Returns a value as it stands in a sentence, not too long."""
    text = value.decode(errors="replace") if isinstance(value, bytes) else value
    text = repr(text)
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."
