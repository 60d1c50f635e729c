"""Check the classes that users write (tasks, services, drivers, costs) when each class is defined.

A class is refused with a `ClassError`, which has the file, the line and what to write instead, if one of its methods
cannot be called as Pancakes calls it, if `@on` or `@every` is where it does nothing, if it replaces a name of
Pancakes, or if Pancakes cannot make an instance of it. So a mistake shows at import, and not hours later when the
method is called. Only what the user wrote is checked: the class itself and its mix-ins (`parts_of`). Which settings
and state can be saved is checked in `pancakes.supervision.serializable_types`; log levels are checked in
`pancakes.events`.
"""

from __future__ import annotations

import ast
import dis
import inspect
import linecache
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache, cached_property, partial, partialmethod, singledispatchmethod
from types import CodeType, FunctionType
from typing import Any, Final, NamedTuple

from pancakes.errors import ClassError


def place_of_function(function: Callable[..., Any]) -> str:
    """Return the file and line of a function's `def`; its module if it has none, such as a built-in function."""
    code = getattr(function, "__code__", None)
    if code is None:
        return str(getattr(function, "__module__", None) or "a module")
    first: int = code.co_firstlineno  # of its first decorator, if it has one
    words = (f"def {code.co_name}", f"async def {code.co_name}")
    for number, line in enumerate(linecache.getlines(code.co_filename)[first - 1 :]):
        if line.strip().startswith(words):
            return f"{code.co_filename}:{first + number}"
    return f"{code.co_filename}:{first}"


def place_of_field(cls: type, field: str = "") -> str:
    """Return the file and line of a field of a class, or of the class; its module if the source is missing."""
    for owner in cls.__mro__ if field else (cls,):
        if field and field not in inspect.get_annotations(owner):
            continue
        try:
            lines, first = inspect.getsourcelines(owner)
        except (OSError, TypeError):
            return _module_of(owner)
        return f"{inspect.getsourcefile(owner)}:{first + _line_of(field, lines)}"
    return _module_of(cls)


def _line_of(field: str, lines: list[str]) -> int:
    """Return the line, from 0, of a class's source that declares a field; 0 if none is found."""
    try:
        (defined,) = ast.parse(textwrap.dedent("".join(lines))).body
    except (SyntaxError, ValueError):
        return 0
    for part in getattr(defined, "body", ()):
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name) and part.target.id == field:
            return part.lineno - 1
    return 0 if field else max(0, getattr(defined, "lineno", 1) - 1)


def _module_of(cls: type) -> str:
    module = sys.modules.get(cls.__module__)
    return str(getattr(module, "__file__", None) or cls.__module__)


_OWN: Final = "pancakes."
MADE_AS: Final = "_made_as"
"""The attribute of each base that users derive from; a class with it was checked when it was defined."""


def is_own(cls: type) -> bool:
    """Return whether a class is Pancakes' own."""
    return f"{cls.__module__}.".startswith(_OWN)


def parts_of(cls: type) -> list[type]:
    """Return a class, and those of its mix-ins that were not checked when they were defined."""
    own = [it for it in cls.__mro__ if is_own(it)]
    mixed_in = [it for it in cls.__mro__[1:] if not hasattr(it, MADE_AS)]
    return [cls, *(it for it in mixed_in if not any(issubclass(mine, it) for mine in own))]


def owner_of(cls: type, name: str) -> type | None:
    """Return the class that a class has an attribute from; None: no such attribute."""
    return next((it for it in cls.__mro__ if name in vars(it)), None)


def is_judged(cls: type) -> bool:
    """Return whether a class needs no check: the tests check Pancakes' own, as it would slow each start."""
    return is_own(cls)


def given_in(cls: type) -> Iterator[tuple[type, str, Any]]:
    """Yield the attributes that the author of a class defines: the class it is in, its name, and its value.

    For a class of Pancakes' own it yields nothing; see `is_judged`.
    """
    if is_judged(cls):
        return
    for part in parts_of(cls):
        for name, value in vars(part).items():
            if part is cls or owner_of(cls, name) is part:
                yield part, name, value


_STARRED: Final = inspect.CO_VARARGS | inspect.CO_VARKEYWORDS


def check_called(function: Any, given: Sequence[str], caller: str, write: str, *, may_await: bool = False) -> None:
    """Refuse a function that cannot be called as Pancakes will call it.

    Args:
        function: a function or another callable.
        given: the names of its arguments, in order, including `self`.
        caller: what calls it, and with what arguments, as a clause: `@every calls it with a Tick`.
        write: what to write instead: `def blink(self, tick: Tick) -> None`.
        may_await: whether it may be `async def`; whether its class may have such a method, `check_awaits` says.

    Raises:
        ClassError: it is not a function, is `async def`, has a `yield`, or takes other arguments. The sentence names
            its file and line.
    """
    if isinstance(function, (staticmethod, classmethod)):
        raise ClassError(
            f"{_head(function.__func__)} is a {type(function).__name__}, and {caller} and the task: write `{write}`"
        )
    if not callable(function):
        raise ClassError(f"{function!r} is not a method, and {caller}: write `{write}`")
    if not (may_await and is_async(function)):
        check_runs(function, write)
    if not takes(function, len(given)):
        raise ClassError(f"{_head(function)} takes {_parameters(function)}, and {caller}: write `{write}`")


def is_async(function: Any) -> bool:
    """Return whether a function is `async def` and has no `yield`, so that a call of it makes something to await."""
    return inspect.iscoroutinefunction(function)


def check_awaits(cls: type, what: str) -> None:
    """Refuse a class of which no method may be `async def`, if one with `@on` or `@every` is.

    Args:
        cls: the class.
        what: what it is: `a service`.

    Raises:
        ClassError: names the file, the line and the method.
    """
    for part, name, value in given_in(cls):
        if marks_of(value) and is_async(value):
            raise ClassError(
                f"{place_of_function(value)}: {part.__qualname__}.{name} is `async def`, and {what} awaits nothing,"
                " as others wait for it: let a task do that"
            )
        if hasattr(value, ANSWERS):
            raise ClassError(
                f"{place_of_function(value)}: {part.__qualname__}.{name} is decorated with @answers, and {what}"
                " answers no requests: let a task do that"
            )


def check_runs(function: Any, write: str) -> None:
    """Refuse a function that does nothing when it is called, because the caller would have to await or iterate it.

    Args:
        function: what is called.
        write: what to write instead; empty: only `def`.

    Raises:
        ClassError: it is `async def`, or has a `yield`.
    """
    if inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function):
        raise ClassError(
            f"{_head(function)} is `async def`, and nothing awaits it: write `{write or 'def'}`. A task awaits its"
            " methods with @on and @every, on_start and on_stop"
        )
    if inspect.isgeneratorfunction(function):
        raise ClassError(
            f"{_head(function)} has a `yield`, so a call does nothing: write `{write or 'def'}` without it"
        )


def check_overrides(cls: type, awaited: Collection[str] = ()) -> None:
    """Refuse methods of a class that override a method of Pancakes but cannot be called like it.

    Its mix-ins are checked too.

    Args:
        cls: the class.
        awaited: the names of those that may be `async def`.

    Raises:
        ClassError: one is not a function, is `async def`, does nothing when it is called, or takes other arguments.
    """
    for part, name, value in given_in(cls):
        if name.startswith("_"):
            continue
        behind = cls.__mro__[cls.__mro__.index(part) + 1 :]
        original = next((vars(base)[name] for base in behind if is_own(base) and name in vars(base)), None)
        if isinstance(original, (FunctionType, classmethod, staticmethod)):
            _check_override(part, name, value, original, name in awaited)


def definition_of(original: Any, name: str = "") -> str:
    """Return the `def` line of a method, as a user would write it."""
    function = getattr(original, "__func__", original)
    parameters = ", ".join(map(str, _bare(function))) if callable(function) else "self"
    mark = f"@{type(original).__name__} " if isinstance(original, (classmethod, staticmethod)) else ""
    return f"{mark}def {name or function.__name__}({parameters})"


def _check_override(part: type, name: str, value: Any, original: Any, may_await: bool) -> None:
    write, meant = definition_of(original, name), getattr(original, "__func__", original)
    function = getattr(value, "__func__", value)
    if type(value) is not type(original) or not isinstance(function, FunctionType):
        raise ClassError(
            f"{_place(part, function)}: {part.__qualname__}.{name} is {_kind(value)}, and overrides"
            f" {meant.__qualname__}{_parameters(meant)}, which Pancakes calls: write `{write}`"
        )
    if not inspect.iscoroutinefunction(meant) and is_async(function) and not may_await:
        check_runs(function, write)
    if meant.__annotations__.get("return") in (None, "None") or may_await:
        if not (may_await and is_async(function)):
            check_runs(function, write)
    count = _plain_count(function)
    if count is not None and count == _plain_count(meant):
        return
    parameters = inspect.signature(meant).parameters.values()
    positional = [it for it in parameters if it.kind in (it.POSITIONAL_ONLY, it.POSITIONAL_OR_KEYWORD)]
    named = [it.name for it in parameters if it.kind is it.KEYWORD_ONLY]
    if not takes(function, len(positional), named):
        raise ClassError(
            f"{_head(function)} takes {_parameters(function)}, and overrides"
            f" {meant.__qualname__}{_parameters(meant)}, which Pancakes calls: write `{write}`"
        )


def _place(part: type, function: Any) -> str:
    function = getattr(function, "fget", None) or function
    return place_of_function(function) if isinstance(function, FunctionType) else place_of_field(part)


def _kind(value: Any) -> str:
    """Return what a class has in place of a method, as a phrase."""
    if isinstance(value, (FunctionType, classmethod, staticmethod, property, type)) or callable(value):
        return f"a {type(value).__name__}"
    return repr(value)


def _plain_count(function: Any) -> int | None:
    """Return how many parameters a function has; None if they are not all plain ones."""
    code = getattr(function, "__code__", None)
    if code is None or code.co_kwonlyargcount or code.co_posonlyargcount or code.co_flags & _STARRED:
        return None
    return int(code.co_argcount)


def takes(function: Callable[..., Any], count: int, named: Collection[str] = ()) -> bool:
    """Return whether a function can be called with `count` arguments and these names."""
    if not named and _plain_count(function) == count:
        return True  # nearly always; a signature takes 10 µs
    try:
        signature = inspect.signature(function, follow_wrapped=False)
    except (TypeError, ValueError):
        return True  # built-in functions may have no signature
    try:
        signature.bind(*range(count), **dict.fromkeys(named))
    except TypeError:
        return False
    return True


def takes_pending(method: Any) -> bool:
    """Return whether a method with `@answers` takes the pending request besides the request."""
    return callable(method) and not takes(method, 2) and takes(method, 3)


def _head(function: Any) -> str:
    name = str(getattr(function, "__qualname__", "") or repr(function)).rpartition("<locals>.")[2]
    return f"{place_of_function(function)}: {name}"


def _parameters(function: Callable[..., Any]) -> str:
    return f"({', '.join(it.name for it in inspect.signature(function, follow_wrapped=False).parameters.values())})"


def _bare(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters as a user would write them, without types."""
    return [it.replace(annotation=it.empty) for it in inspect.signature(function).parameters.values()]


SUBSCRIPTIONS: Final = "__subscriptions__"
"""The attribute of a method that `@on` leaves."""
PERIOD: Final = "__period__"
"""The attribute of a method that `@every` leaves."""
GIVEN: Final = "__given__"
"""The attribute of a method that `@on` leaves besides: what it is called with."""
ANSWERS: Final = "__answers__"
"""The attribute of a method that `@answers` leaves: the class of requests that it answers."""


def marks_of(function: Any) -> str:
    """Return which of these decorates a function, as a user would write it; empty: none."""
    if hasattr(function, PERIOD):
        return "@every"
    if hasattr(function, ANSWERS):
        return "@answers"
    return "@on" if hasattr(function, SUBSCRIPTIONS) else ""


def check_marks(cls: type, reacts: str = "") -> None:
    """Refuse a class with `@on` or `@every` where it would do nothing, or would call a hook a second time.

    Args:
        cls: the class.
        reacts: what the class is, if it does not react to packets or time: `a driver`; empty: it reacts.

    Raises:
        ClassError: names the file, the line and the method.
    """
    for part, name, value in given_in(cls):
        function = _inner(value)
        mark = marks_of(function)
        if not mark:
            continue
        head = f"{place_of_function(function)}: {part.__qualname__}.{name}"
        if reacts:
            raise ClassError(
                f"{head} is decorated with {mark}, and {reacts} is called by what uses it: only the methods of tasks"
                f" and services react to packets and time. Leave {mark} out"
            )
        if function is not value:
            raise ClassError(
                f"{head} is decorated with {mark}, and is a {type(value).__name__}, which nothing would call: leave"
                f" @{type(value).__name__} out"
            )
        if hasattr(function, ANSWERS) and (hasattr(function, SUBSCRIPTIONS) or hasattr(function, PERIOD)):
            raise ClassError(
                f"{head} is decorated with @answers and with @on or @every, which call it with something else: write"
                " two methods, which may call a third"
            )
        behind = cls.__mro__[cls.__mro__.index(part) + 1 :]
        hook = next((vars(it)[name] for it in behind if is_own(it) and name in vars(it)), None)
        if hook is not None and not marks_of(hook):
            raise ClassError(
                f"{head} is decorated with {mark}, and Pancakes calls {name} itself: write another method for"
                f" {mark}, which {name} may call too"
            )


def _inner(value: Any) -> Any:
    if isinstance(value, (staticmethod, classmethod)):
        return value.__func__
    if isinstance(value, property):
        return value.fget
    return value.func if isinstance(value, cached_property) else value


_VERBS: Final = {"STORE_ATTR": "sets", "DELETE_ATTR": "deletes"}
_HOLD_FUNCTIONS: Final = (
    *(FunctionType, property, classmethod, staticmethod, type(cache(len))),
    *(cached_property, partial, partialmethod, singledispatchmethod),
)


def check_own_names(cls: type, base: type, hooks: Collection[str], kept: Collection[str] = ()) -> None:
    """Refuse a class that redefines a name of Pancakes.

    Args:
        cls: the new class.
        base: the base that users derive from; its names are Pancakes'. Classes between the two are the user's.
        hooks: the names that a class may redefine.
        kept: the attributes that its methods may set.

    Raises:
        ClassError: names the file, the line and the name, and the hooks.
    """
    if is_own(cls):
        return
    own = _names_of(base) - set(hooks)
    for part in parts_of(cls):
        _check(part, base, own, hooks, kept)


def _check(cls: type, base: type, own: frozenset[str], hooks: Collection[str], kept: Collection[str]) -> None:
    what = f"Pancakes' own in a {base.__name__}: give it another name"
    for name, value in vars(cls).items():
        if name in own:
            function = next(iter(_functions(value)), None)
            place = place_of_function(inspect.unwrap(function)) if function else place_of_field(cls)
            open_to = ", ".join(sorted(it for it in hooks if it.startswith("on_")))
            also = f" (its hooks are {open_to})" if open_to and callable(value) else ""
            raise ClassError(f"{place}: {cls.__qualname__}.{name} would replace a name that is {what}{also}")
        for function in () if isinstance(value, staticmethod) else _functions(value):
            if own.isdisjoint(_names_in(function.__code__)):
                continue
            for stored, line, verb in _stores(function):
                if stored in own and not (stored in kept and verb == "sets"):
                    place = f"{function.__code__.co_filename}:{line}"
                    raise ClassError(f"{place}: {cls.__qualname__}.{name} {verb} self.{stored}, which is {what}")


def _functions(value: Any) -> Iterator[FunctionType]:
    """Yield the functions in a value of a class: those of a property, and one that a decorator wraps."""
    if isinstance(value, FunctionType):
        yield value
    for name in ("fget", "fset", "fdel", "func", "__func__", "__wrapped__"):
        inner = getattr(value, name, None)
        if isinstance(value, _HOLD_FUNCTIONS) and inner is not None:
            yield from _functions(inner)


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names_in(inner)


@cache
def _names_of(base: type) -> frozenset[str]:
    """Return all names that a class of Pancakes defines or declares, without those of `object`."""
    names = {name for one in base.__mro__[:-1] for name in (*vars(one), *inspect.get_annotations(one))}
    return frozenset(name for name in names if not (name.startswith("__") and name.endswith("__")))


def _stores(function: FunctionType) -> Iterator[tuple[str, int, str]]:
    """Yield the attributes of its first argument that a method sets or deletes: name, line, and which of both."""
    code = function.__code__
    if code.co_argcount:
        yield from _stores_in(code, code.co_varnames[0])


def _stores_in(code: CodeType, first: str) -> Iterator[tuple[str, int, str]]:
    line = code.co_firstlineno
    before: dis.Instruction | None = None
    copied: dis.Instruction | None = None
    augments_self = False
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("CACHE", "EXTENDED_ARG"):
            continue
        line = _line(instruction) or line
        verb = _VERBS.get(instruction.opname)
        if before is None:
            pass
        elif verb is not None:
            if _loads(before, first) or (before.opname == "SWAP" and augments_self):
                yield instruction.argval, line, verb
        elif instruction.opname == "LOAD_ATTR" and before.opname == "COPY" and before.argval == 1:
            # `self.x += 1` keeps a copy of self on the stack below the computed value, and swaps them at the end.
            augments_self = copied is not None and _loads(copied, first)
        before, copied = instruction, before
    for inner in code.co_consts:
        if isinstance(inner, CodeType) and first in inner.co_freevars:
            yield from _stores_in(inner, first)


def _loads(instruction: dis.Instruction, name: str) -> bool:
    """Return whether an instruction loads a variable last; newer Pythons can load two at once."""
    loaded: Any = instruction.argval
    if isinstance(loaded, tuple):
        loaded = loaded[-1]
    opname = instruction.opname
    return "LOAD" in opname and ("FAST" in opname or "DEREF" in opname) and loaded == name


def _line(instruction: dis.Instruction) -> int | None:
    return instruction.positions.lineno if instruction.positions is not None else None


_MAKERS: Final = ("__new__", "__init__")


class Made(NamedTuple):
    """How Pancakes makes an instance of a class.

    Attributes:
        given: the names of the arguments.
        what: what it is, as in `a task`.
        instead: where the author's code belongs instead.
        gives: an attribute that the `__init__` of Pancakes sets, and without which nothing works; empty: `__init__`
            need not be called.
        awaited: the hooks that may be `async def`; empty: none of its methods may.
    """

    given: tuple[str, ...]
    what: str
    instead: str
    gives: str = ""
    awaited: tuple[str, ...] = ()


def check_made(cls: type) -> None:
    """Refuse a class whose instances cannot be made as Pancakes makes them.

    Raises:
        ClassError: has the file and line.
    """
    made: Made = getattr(cls, MADE_AS)
    for name in _MAKERS:
        owner = owner_of(cls, name)
        if owner is None or is_own(owner):
            continue
        function = getattr(vars(owner)[name], "__func__", vars(owner)[name])
        if not isinstance(function, FunctionType):
            continue
        fits = takes(function, 1, made.given)
        if fits and (not made.gives or _calls_on(function, name)):
            continue
        _check_dataclass(owner, made)
        head = f"{place_of_function(function)}: {owner.__qualname__}.{name}"
        if not fits:
            raise ClassError(
                f"{head} takes {inspect.signature(function, follow_wrapped=False)}, but Pancakes makes"
                f" {made.what}: leave it out, and write {made.instead}"
            )
        raise ClassError(_silent(head, name, made))


def check_loaded(cls: Any) -> None:
    """Refuse a class that a decorator made unusable after its definition, or that lacks methods.

    Args:
        cls: the loaded object; anything but a user's class that Pancakes makes is ignored.

    Raises:
        ClassError: it is a dataclass, lacks methods, or cannot be called as Pancakes calls it.
    """
    if not isinstance(cls, type) or is_own(cls) or not hasattr(cls, MADE_AS):
        return
    check_made(cls)
    made: Made = getattr(cls, MADE_AS)
    compared = owner_of(cls, "__hash__")
    if made.gives and compared is not None:
        _check_dataclass(compared, made)  # it removes the hash, which identifies actors
    lacking = sorted(getattr(cls, "__abstractmethods__", ()))
    if lacking:
        wanted = ", ".join(f"`{definition_of(getattr(cls, name), name)}`" for name in lacking)
        raise ClassError(f"{place_of_field(cls)}: {cls.__qualname__} lacks {', '.join(lacking)}: write {wanted}")


def check_instance(cls: Any, instance: object) -> None:
    """Refuse an instance whose `__init__` did not call that of Pancakes.

    Args:
        cls: the class; any but one that Pancakes makes is ignored.
        instance: the result of the call.

    Raises:
        ClassError: it is not an instance, or lacks the attribute.
    """
    made: Made | None = getattr(cls, MADE_AS, None)
    if made is None or made.gives in getattr(instance, "__dict__", ()):
        return
    name = "__init__" if isinstance(instance, cls) else "__new__"
    raise ClassError(_silent(f"{place_of_field(cls)}: {cls.__qualname__}.{name}", name, made))


def _silent(head: str, name: str, made: Made) -> str:
    given = "cls" if name == "__new__" else "*args, **others"
    return (
        f"{head} does not call `super().{name}({given})`, and {made.what} could not work: leave it out, and write"
        f" {made.instead}"
    )


def _check_dataclass(cls: type, made: Made) -> None:
    if "__dataclass_fields__" in vars(cls):
        has_settings = made.gives or "settings" in made.given
        instead = f"declare what may be set in `@dataclass class Settings`, and write {made.instead}"
        raise ClassError(
            f"{place_of_field(cls)}: {cls.__qualname__} is decorated with @dataclass, but Pancakes makes"
            f" {made.what}: leave that out, {instead if has_settings else 'or give its fields defaults'}"
        )


def _calls_on(function: FunctionType, name: str) -> bool:
    """Return whether a method may call that of the next class; a decorated one may."""
    code = inspect.unwrap(function).__code__
    return name in _made_class_names_in(code) or any(it != "__class__" for it in code.co_freevars)


def _made_class_names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _made_class_names_in(inner)
