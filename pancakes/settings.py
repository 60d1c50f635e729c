"""Check settings: a dataclass says what may be set, plain values say what is set.

The values come from a configuration file or from a packet, so nothing about them is taken on trust. msgspec
checks each value but stops at its first error; here the dataclass is walked, so that a person sees all
mistakes at once, each with its key.

A `msgspec.Struct` does as well as a dataclass, and is made in a tenth of the time, when its module is imported.

In plain values a numpy array is an array, a read-only copy; a list is read as well.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from pancakes.errors import PancakesError, describe
from pancakes.packet import field_names, has_fields
from pancakes.util import codecs
from pancakes.util.arrays import array_of, check_items, is_array, is_array_type, is_number
from pancakes.util.files import NoPathError, at_home
from pancakes.util.text import key_for, suggestion, written_for

_T = TypeVar("_T")

_PATH: Final = {"format": "path"}
FilePath = Annotated[str, msgspec.Meta(extra_json_schema=_PATH)]
"""The type of a setting that is the path of a file, or of a folder.

`~` at its beginning is the home of the user as whom the agent runs. A control packet, or a task that comes from another
agent, sets it only below the folders that the agent's own configuration names."""
Positive: TypeAlias = Annotated[float, msgspec.Meta(gt=0)]
"""The type of a setting that is a number above 0."""
NotNegative: TypeAlias = Annotated[float, msgspec.Meta(ge=0)]
"""The type of a setting that is a number from 0."""
Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
"""The type of a setting that is a number from 0 to 1."""
PositiveShare: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=1)]
"""The type of a setting that is a number above 0, up to 1."""

UNKNOWN_KEY: Final = "unknown key"
LEAST_INT: Final = -(2**63)
MOST_INT: Final = 2**64 - 1
"""msgpack writes no integers beyond these two."""

_LEAVES: Final = frozenset((str, int, float, bool, type(None)))
_WORDS = {
    "str": "a string",
    "int": "an integer",
    "float": "a number",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "null": "nothing",
}


class Problem(msgspec.Struct, frozen=True):
    """One mistake in settings.

    Attributes:
        path: the keys that lead to it, from the outermost; an integer is a place in a list, from 0. Empty if
            the settings as a whole are at fault.
        text: what is wrong, as a phrase.
        suggestion: what was probably meant, or an empty string.
    """

    path: tuple[str | int, ...]
    text: str
    suggestion: str = ""

    def __str__(self) -> str:
        key = f"{dotted(self.path)}: " if self.path else ""
        hint = f", did you mean {self.suggestion!r}?" if self.suggestion else ""
        return f"{key}{self.text}{hint}"


class SettingsError(PancakesError):
    """Settings, or the state of a task, do not fit. Carries all of their problems at once."""

    code = "invalid"

    def __init__(self, owner: str, problems: Sequence[Problem], noun: str = "settings") -> None:
        self.problems = tuple(problems)
        super().__init__(f"bad {noun} for {owner}: " + "; ".join(str(problem) for problem in self.problems))

    def plain(self) -> list[dict[str, Any]]:
        """Return the problems as plain values: for each its `path`, and the `text` with what was probably meant."""
        return [{"path": list(it.path), "text": str(Problem((), it.text, it.suggestion))} for it in self.problems]


def dotted(path: Sequence[str | int]) -> str:
    """Return a path as a person would write it: `legs[2].length_m`."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = part if re.fullmatch(r"[A-Za-z0-9_-]+", part) else '"' + part.replace('"', '\\"') + '"'
            text += f".{name}" if text else name
    return text


def check_settings(cls: type, settings: Any, allow_nan: bool = False) -> list[Problem]:
    """Return all that is wrong with plain values as settings of a class.

    Unknown and missing keys, wrong types, numbers out of the range that `Annotated[float, msgspec.Meta(...)]`
    states, NaN, what cannot be saved, and what the dataclass refuses itself (an error from its `__post_init__`).

    Args:
        cls: a dataclass or `msgspec.Struct`, such as the `Settings` of a task, a driver or a service.
        settings: the values as TOML or msgpack give them.
        allow_nan: whether NaN is good for a number: not in settings, but in what a task has computed.
    """
    fault = fault_of_class(cls)
    if fault:
        return [Problem((), fault)]
    if isinstance(settings, dict) and _is_simple(cls, settings, allow_nan):
        try:
            _convert(settings, cls)
            return []
        except (Exception, SystemExit):  # what its author wrote in __post_init__ may raise anything
            pass  # the walk says what is wrong, and where
    try:
        problems = list(_walk(cls, settings, ()))
        odd = [Problem(path, text) for path, text in _odd_in(settings, (), allow_nan)]
    except (TypeError, NameError, RecursionError) as error:  # a type that msgspec cannot check, or cannot resolve
        return [Problem((), f"{cls.__qualname__} cannot be checked: {error}")]
    odd += [Problem(path, text) for path, text in _no_paths(cls, settings)]
    return odd + [problem for problem in problems if all(problem.path != it.path for it in odd)]


def why_unreadable(cls: type, plain: Mapping[str, Any], allow_nan: bool = False) -> list[Problem]:
    """Return why plain values that came of an instance of a class could not be made an instance again.

    What is good costs no more than to make it; see `check_settings`.
    """
    try:
        codecs.convert(plain, cls, array_of)
        if allow_nan or next(_odd_in(plain, (), allow_nan), None) is None:
            return []
    except (Exception, SystemExit):  # as in `check_settings`
        pass
    return check_settings(cls, plain, allow_nan)


def make_settings(
    cls: type[_T], settings: Mapping[str, Any], allow_nan: bool = False, owner: str = "", noun: str = "settings"
) -> _T:
    """Make settings from plain values; see `check_settings` for the other arguments.

    Args:
        owner: the name of the task, device or service that they are for; empty: an error names the class.
        noun: what an error calls them.

    Raises:
        SettingsError: they do not fit; it names every mistake.
    """
    if _is_simple(cls, settings, allow_nan):
        try:
            return _convert(settings, cls) if settings else _at_home(cls())
        except (Exception, SystemExit):  # as in `check_settings`
            pass
    problems = check_settings(cls, settings, allow_nan)
    if problems:
        raise SettingsError(owner or _owner(cls), problems, noun)
    return _convert(settings, cls)


def _is_simple(cls: type, settings: Mapping[str, Any], allow_nan: bool) -> bool:
    """Return whether msgspec alone knows whether settings are good: no tables or lists, no key that is not there.

    Nearly all settings are like that, and a walk through them takes ten times as long (60 µs of the 75 that a task of
    ten thousand may take to start).
    """
    if fault_of_class(cls):
        return False
    known = known_keys(cls)
    for key, value in settings.items():
        kind = type(value)
        if key not in known or not (kind is str or kind is int or kind is bool or kind is float):
            return False
        if next(_odd_in(value, (), allow_nan), None) is not None:
            return False
    return True


def change_settings(settings: _T, changes: Mapping[str, Any], owner: str = "") -> _T:
    """Make new settings from present ones, with some keys changed; the present ones stay as they are.

    Args:
        settings: the present settings.
        changes: plain values by key. A key that is left out keeps its value; a table is replaced as a whole.
        owner: see `make_settings`.

    Raises:
        SettingsError: the changes do not fit; it names every mistake.
    """
    return change_plain(type(settings), plain_settings(settings), changes, owner)


def change_plain(cls: type[_T], plain: Mapping[str, Any], changes: Mapping[str, Any], owner: str = "") -> _T:
    """Make settings from plain values, with some keys changed; see `change_settings`."""
    merged = {**plain, **changes}
    problems = [_hinted(problem, cls, changes) for problem in check_settings(cls, merged)]
    if problems:
        raise SettingsError(owner or _owner(cls), problems)
    return _convert(merged, cls)


def _hinted(problem: Problem, cls: type, changes: Mapping[str, Any]) -> Problem:
    """Suggest a key that is set already: a change of settings means one of those."""
    if problem.text != UNKNOWN_KEY or problem.suggestion or len(problem.path) != 1:
        return problem
    keys = [name for name in known_keys(cls) if name not in changes]
    return msgspec.structs.replace(problem, suggestion=suggestion(str(problem.path[0]), keys))


@cache
def known_keys(cls: type) -> tuple[str, ...]:
    """Return the keys of a dataclass, in their order."""
    if not dataclasses.is_dataclass(cls):
        return field_names(cls)
    return tuple(field.name for field in dataclasses.fields(cls) if field.init)


@cache
def required_keys(cls: type) -> tuple[str, ...]:
    """Return the keys of a dataclass that have no default, in their order."""
    if not dataclasses.is_dataclass(cls):
        names, defaults = cls.__struct_fields__, cls.__struct_defaults__  # type: ignore[attr-defined]
        without = len(names) - len(defaults)
        later = zip(names[without:], defaults, strict=True)  # one that is given by its name may follow a default
        return (*names[:without], *(name for name, default in later if default is msgspec.NODEFAULT))
    missing = dataclasses.MISSING
    given = (field for field in dataclasses.fields(cls) if field.init)
    return tuple(field.name for field in given if field.default is missing and field.default_factory is missing)


def paths_in(kind: Any, plain: Any, key: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield the paths of files among plain values (see `FilePath`), each behind the keys that lead to it.

    Args:
        kind: the class of the settings.
        plain: the values.
        key: the keys that lead to them.
    """
    if get_origin(kind) is Annotated:
        if isinstance(plain, str) and _PATH in [getattr(meta, "extra_json_schema", None) for meta in get_args(kind)]:
            yield key, plain
        yield from paths_in(get_args(kind)[0], plain, key)
    elif get_origin(kind) in (Union, types.UnionType):
        yield from dict.fromkeys(found for arm in get_args(kind) for found in paths_in(arm, plain, key))
    elif isinstance(plain, Mapping):
        for name, value in plain.items():
            yield from paths_in(_kind_at(kind, name), value, (*key, str(name)))
    elif isinstance(plain, (list, tuple)):
        for index, value in enumerate(plain):
            yield from paths_in(_item_kind(get_origin(kind), get_args(kind), index), value, (*key, index))


def _kind_at(kind: Any, name: Any) -> Any:
    """Return the type of what a table has under a name."""
    if isinstance(kind, type) and has_fields(kind):
        return _hints(kind).get(name, Any)
    origin, arguments = get_origin(kind), get_args(kind)
    is_mapping = isinstance(origin, type) and issubclass(origin, Mapping) and len(arguments) == 2
    return arguments[1] if is_mapping else Any


def plain_settings(settings: Any) -> dict[str, Any]:
    """Return settings, or the state of a task, as plain values.

    Every field is there. msgspec alone leaves out what was never assigned in a dataclass and so has its default from
    the class, and in a structure what it was told to leave out; and another version may have other defaults.
    """
    plain: dict[str, Any] = _plain(settings)
    return plain


def plain_value(value: Any) -> Any:
    """Return the value of one field of settings as a plain value."""
    return _plain(value)


def _plain(value: Any) -> Any:
    cls = value.__class__
    if cls in _LEAVES:
        return value
    names = _fields_of(cls)
    if names is not None:
        return {name: _plain(getattr(value, name)) for name in names}
    if cls is dict:
        return {_plain_key(key): _plain(item) for key, item in value.items()}
    if cls is list or cls is tuple:
        return cls(value if _LEAVES.issuperset(map(type, value)) else map(_plain, value))
    if is_array(value):
        check_items(value)
        copied = value.copy()  # its owner goes on with its own
        copied.flags.writeable = False
        return copied
    return msgspec.to_builtins(value, str_keys=True, enc_hook=_plain_number)


@cache
def _fields_of(cls: type) -> tuple[str, ...] | None:
    return field_names(cls) if has_fields(cls) else None


def _plain_key(key: Any) -> str:
    return key if type(key) is str else next(iter(msgspec.to_builtins({key: None}, str_keys=True)))


def _plain_number(value: Any) -> Any:
    if is_number(value):
        return value.item()
    raise TypeError(f"it contains a value of the class {type(value).__name__}, which cannot be saved")


def _with_paths_at_home(cls: type, plain: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return plain values in which each path of a file (see `FilePath`) that begins with `~` is a whole one.

    Raises:
        NoPathError: nothing says where that is, or it is no path.
    """
    for key, path in list(paths_in(cls, plain)):
        whole = at_home(path)
        if whole != path:
            plain = _with(plain, key, whole)
    return plain


def _with(plain: Any, key: tuple[str | int, ...], value: str) -> Any:
    """Return plain values with another one at a key; those that were given stay as they are."""
    if not key:
        return value
    if isinstance(plain, Mapping):
        return {**plain, key[0]: _with(plain[key[0]], key[1:], value)}
    return type(plain)(_with(it, key[1:], value) if number == key[0] else it for number, it in enumerate(plain))


def _convert(value: Any, kind: Any) -> Any:
    return _at_home(codecs.convert(value, kind, array_of))


def _at_home(settings: _T) -> _T:
    """Return settings in which each path is a whole one, also one that the class has as its default."""
    cls: Any = type(settings)
    if not _may_name_files(cls):
        return settings
    plain = plain_settings(settings)
    whole = _with_paths_at_home(cls, plain)
    if whole is plain:
        return settings
    made: _T = codecs.convert(whole, cls, array_of)
    return made


@cache
def _may_name_files(kind: Any) -> bool:
    """Return whether there may be a path among the fields of a type."""
    return _names_files(kind, ())


def _names_files(kind: Any, within: tuple[Any, ...]) -> bool:
    if get_origin(kind) is Annotated:
        metas = [getattr(meta, "extra_json_schema", None) for meta in get_args(kind)]
        return _PATH in metas or _names_files(get_args(kind)[0], within)
    if isinstance(kind, type) and has_fields(kind):
        try:
            return kind not in within and any(_names_files(it, (*within, kind)) for it in _hints(kind).values())
        except (NameError, TypeError):  # an annotation that cannot be resolved
            return False
    return any(_names_files(it, within) for it in get_args(kind))


def _no_paths(cls: type, settings: Any) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """The paths that are none, have a variable in them, or begin at a home of which nothing says where it is."""
    for path, text in paths_in(cls, settings) if _may_name_files(cls) else ():
        try:
            at_home(text)
        except NoPathError as error:
            yield path, str(error)


def _owner(cls: type) -> str:
    """`ScanTarget.Settings` belongs to ScanTarget, and that is the name which a person knows."""
    return cls.__qualname__.rpartition("<locals>.")[2].removesuffix(".Settings")


@cache
def fault_of_class(cls: type) -> str:
    """Say why a class cannot be settings or state whatever its fields are; empty: it can."""
    name = cls.__qualname__.rpartition("<locals>.")[2]
    if not has_fields(cls):
        if issubclass(cls, msgspec.Struct):
            return f"{name} is no table: make it a Struct without array_like, tag and rename"
        return f"{name} is no dataclass: decorate it with @dataclass"
    declared = inspect.get_annotations(cls)
    if declared and dataclasses.is_dataclass(cls) and "__dataclass_fields__" not in cls.__dict__:
        return f"{name} adds keys to inherited ones without @dataclass: decorate it with that"
    return ""


def _odd_in(value: Any, path: tuple[str | int, ...], allow_nan: bool) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """The paths of what in plain values no type forbids, and is no good all the same.

    NaN and infinity: no robot can drive a circle of that size. And what msgpack cannot write.
    """
    if isinstance(value, float):
        if not (allow_nan or math.isfinite(value)):
            yield path, "is not a number (nan)" if math.isnan(value) else f"is not finite ({value})"
    elif isinstance(value, int):
        if not LEAST_INT <= value <= MOST_INT:
            yield path, f"lies beyond what can be saved ({LEAST_INT} to {MOST_INT})"
    elif isinstance(value, str):
        if not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
            yield path, "has a surrogate in it, which is half a letter, and cannot be saved"
    elif is_array(value):
        import numpy

        if not allow_nan and value.dtype.kind in "fc" and not numpy.isfinite(value).all():
            yield path, "has a number in it that is nan or not finite"
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _odd_in(item, (*path, str(key)), allow_nan)
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _odd_in(item, (*path, index), allow_nan)


def _walk(kind: Any, value: Any, path: tuple[str | int, ...]) -> Iterator[Problem]:
    """Check the parts of a value one by one, and the whole if all parts are sound."""
    parts = list(_parts(kind, value, path))
    yield from parts
    if parts:
        return
    choices = _choices(kind)
    if choices and value is not None and value not in choices:
        near = suggestion(value, [c for c in choices if isinstance(c, str)]) if isinstance(value, str) else ""
        yield Problem(path, f"expected one of {', '.join(_shown(c) for c in choices)}, not {_shown(value)}", near)
        return
    try:
        codecs.convert(value, kind, array_of)
    except msgspec.ValidationError as error:
        text = _phrase(str(error), value)
        if isinstance(value, str) and path and text.startswith(("expected a number", "expected an integer")):
            line = written_for(str(path[-1]), value)
            text += f": write {line}" if line else ""
        yield Problem(path, text)
    except (TypeError, NameError, RecursionError):
        raise
    except (Exception, SystemExit) as error:  # what its author wrote in __post_init__ may raise anything
        yield Problem(path, describe(error, kind if isinstance(kind, type) else None))


def _parts(kind: Any, value: Any, path: tuple[str | int, ...]) -> Iterator[Problem]:
    """Check what is inside a table or list; whatever has no inside has no parts."""
    kind = _container(kind, value)
    if is_array_type(kind):
        return
    origin, arguments = get_origin(kind), get_args(kind)
    if isinstance(value, Mapping):
        if isinstance(kind, type) and has_fields(kind):
            yield from _fields(kind, value, path)
        elif origin is not None and isinstance(origin, type) and issubclass(origin, Mapping) and len(arguments) == 2:
            for key, item in value.items():
                yield from _walk(arguments[1], item, (*path, str(key)))
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _walk(_item_kind(origin, arguments, index), item, (*path, index))


def _fields(cls: type, value: Mapping[Any, Any], path: tuple[str | int, ...]) -> Iterator[Problem]:
    hints = _hints(cls)
    known = known_keys(cls)
    for key, item in value.items():
        if key in known:
            yield from _walk(hints[key], item, (*path, key))
        else:
            free = [name for name in known if name not in value]
            near = key_for(str(key), item, free) if isinstance(item, str) else ""
            yield Problem((*path, str(key)), UNKNOWN_KEY, near or suggestion(str(key), free))
    for key in required_keys(cls):
        if key not in value:
            yield Problem((*path, key), "is missing")


@cache
def _hints(cls: type) -> Mapping[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _container(kind: Any, value: Any) -> Any:
    """Strip `Annotated`, and pick from a union the arm that a table or list must be meant for."""
    while get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, types.UnionType):
        arms = [_container(arm, value) for arm in get_args(kind) if arm is not type(None)]
        if len(arms) == 1:
            return arms[0]
        return Any  # several arms: msgspec alone can say which of them fits
    return kind


def _item_kind(origin: Any, arguments: tuple[Any, ...], index: int) -> Any:
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        return arguments[index] if index < len(arguments) else Any
    if isinstance(origin, type) and issubclass(origin, (Sequence, set, frozenset)) and arguments:
        return arguments[0]
    return Any


def _choices(kind: Any) -> tuple[Any, ...]:
    """Return the words that a type is made of, also one of several lists of them; none if other values do as well."""
    while get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return get_args(kind)
    if get_origin(kind) not in (Union, types.UnionType):
        return ()
    arms = [_choices(arm) for arm in get_args(kind) if arm is not type(None)]
    return tuple(dict.fromkeys(it for arm in arms for it in arm)) if all(arms) else ()


def _phrase(message: str, value: Any) -> str:
    """Turn an error of msgspec into words for a user who writes TOML."""
    message = re.sub(r" - at (`[^`]*`|.*)$", "", message)
    message = re.sub(r"`([^`]*)`", lambda found: " or ".join(_word(part) for part in found[1].split(" | ")), message)
    message = message.removesuffix(".")
    message = re.sub(r"(-?\d+)\.0\b", r"\1", message)
    if message.startswith("Expected "):
        message = "e" + message[1:]
        if ", got" not in message and isinstance(value, (str, int, float)):
            message += f", not {_shown(value)}"
    return message


def _word(kind: str) -> str:
    return _WORDS.get(kind, kind)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
