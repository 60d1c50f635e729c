"""Payloads: read values by a path in a device's JSON, and write payloads for devices. Pure.

A path is the keys that lead to a value, with dots between them: `SI7021.Temperature`. A number is a place in a list,
from 0; `*` is the only key under which the rest of the path leads on.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import msgspec

from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed
from pancakes.util.text import number_in

TRUE: Final = ("on", "true", "1", "yes", "online", "open", "detected", "occupied", "motion")
FALSE: Final = ("off", "false", "0", "no", "offline", "closed", "clear", "not_detected", "none")
UNKNOWN: Final = ("", "unknown", "unavailable", "null")
"""What devices write for an unknown value."""
SHOWN: Final = 60
_decode: Final = codecs.json_decoder()
_WORDS: Final = re.compile(r'"(?:[^"\\]|\\.)*(?:"|\Z)|[-+]?\b(?:nan|inf|infinity)\b', re.IGNORECASE | re.DOTALL)
"""A text in JSON, or what a C program prints for NaN and infinity."""
_BROKEN: Final = "\ufffd"
"""Replaces bytes that are not UTF-8."""


class BadPayload(ValueError):
    """A payload has no such value; the message says why."""


def value_at(payload: bytes, path: str) -> Any:
    """Return the value that a path leads to in a payload.

    Args:
        payload: JSON, or any text if the path is empty.
        path: the path; empty: the whole payload.

    Returns:
        The value; None if the device wrote null.

    Raises:
        BadPayload: there is no such value.
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
    """Decode a payload of JSON, as far as it can be read: see `oddities`. Raises BadPayload."""
    try:
        return _decode(payload)
    except MALFORMED as error:
        found, value = _decoded_leniently(payload)
        if found:
            return value
        raise BadPayload(f"{shown(payload)} is not JSON ({why_malformed(error)})") from None


def oddities(payload: bytes) -> str:
    """Return the parts of a readable payload that are not JSON: `humidity is nan`; empty: none, or all."""
    try:
        _decode(payload)
        return ""
    except MALFORMED:
        found, value = _decoded_leniently(payload)
    return ", ".join(f"{path or 'it'} {fault}" for path, fault in list(_odd_in(value, ""))[:5]) if found else ""


def _decoded_leniently(payload: bytes) -> tuple[bool, Any]:
    """Read JSON as devices write it: with NaN and inf, bytes that are not UTF-8, a byte order mark, a final zero."""
    text = payload.decode("utf-8", "replace").removeprefix("\ufeff").rstrip("\0")
    try:
        # Python reads only one spelling of these words.
        text = _WORDS.sub(lambda found: _word(found[0]), text)
        return True, json.loads(text, strict=False, parse_int=_whole_number)
    except (ValueError, RecursionError):
        return False, None


def _word(found: str) -> str:
    if found.startswith('"'):
        return found
    if found.lower().endswith("nan"):
        return "NaN"
    return "-Infinity" if found.startswith("-") else "Infinity"


def _whole_number(digits: str) -> float:
    try:
        return int(digits)
    except ValueError:  # Python does not read numbers with thousands of digits
        return math.inf


def _odd_in(value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, float) and not math.isfinite(value):
        yield path, f"is {value}"
    elif isinstance(value, str) and (_BROKEN in value or not value.isprintable()):
        yield path, f"is {shown(value)}"
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _odd_in(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _odd_in(inner, f"{path}.{number}" if path else str(number))


def _whole(payload: bytes) -> Any:
    try:
        return decoded(payload)
    except BadPayload:
        try:
            return payload.decode("utf-8-sig").rstrip("\0")
        except UnicodeDecodeError:
            raise BadPayload(f"{shown(payload)} is not text") from None


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
    raise BadPayload(f"the path {path!r} leads on at {key!r}, but {shown(value)} is there")


def _listed(value: Mapping[Any, Any]) -> str:
    return ", ".join(str(key) for key in list(value)[:10]) or "none"


def number_of(value: Any) -> float | None:
    """Return a value as a number; None if the device reports no value.

    Raises:
        BadPayload: it is not a number, or not finite.
    """
    if value is None or (isinstance(value, str) and value.strip().lower() in UNKNOWN):
        return None
    if isinstance(value, bool):
        raise BadPayload(f"{shown(value)} is not a number")
    try:
        number = number_in(value) if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError):
        raise BadPayload(f"{shown(value)} is not a number") from None
    if not math.isfinite(number):
        raise BadPayload(f"{shown(value)} is not a finite number")
    return number


def truth_of(value: Any, yes: Sequence[str] = (), no: Sequence[str] = ()) -> bool | None:
    """Return a value as yes or no; None if the device reports no value. Raises BadPayload.

    Args:
        value: the value from the device.
        yes: further values for yes, in small letters.
        no: further values for no.
    """
    text = str(value).strip().lower()
    if text in yes:
        return True
    if text in no:
        return False
    if value is None or isinstance(value, bool):
        return value
    if text in UNKNOWN:
        return None
    if text in TRUE:
        return True
    if text in FALSE:
        return False
    raise BadPayload(f"{shown(value)} means neither yes nor no")


def celsius_of(value: float, unit: str) -> float:
    """Return a temperature in degrees Celsius; the unit is C, F or K."""
    if unit == "F":
        return (value - 32.0) / 1.8
    return value - 273.15 if unit == "K" else value


def text_of(value: Any) -> bytes:
    """Return a value as a payload: a text as it is, all else as JSON."""
    return value.encode() if isinstance(value, str) else codecs.encode_json(value)


def written(template: str, values: Mapping[str, float]) -> bytes:
    """Return a template with its placeholders replaced by numbers, such as `{"v": {v_mps}}`."""
    for name, value in values.items():
        template = template.replace(f"{{{name}}}", format(value, ".6g"))
    return template.encode()


def plain_json(value: Any) -> bytes:
    """Return plain values as JSON, in which NaN and infinity are null.

    Raises:
        BadPayload: JSON cannot express it.
    """
    try:
        return codecs.encode_json(value)
    except (TypeError, ValueError, RecursionError, OverflowError, msgspec.MsgspecError) as error:
        raise BadPayload(f"it cannot be written as JSON: {error}") from None


def shown(value: Any) -> str:
    """Return a value for a message, not too long."""
    text = value.decode(errors="replace") if isinstance(value, bytes) else value
    text = repr(text)
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."
