"""Find all containers that an object holds, so that a container that grows without bound is found by its name."""

from __future__ import annotations

import gc
import sys
import types
import weakref
from collections import deque
from collections.abc import Iterator
from typing import Any, Final

import msgspec

CONTAINERS: Final = (dict, list, set, deque)
_LEFT_OUT: Final = (type, types.ModuleType, types.CodeType, types.FrameType, weakref.ref)
_SHARED: Final = (types.BuiltinFunctionType, types.MethodWrapperType)


class Found(msgspec.Struct, frozen=True):
    """One container.

    Attributes:
        name: where it was found, such as `Mesh._sessions`.
        length: how many items it has.
        it: the container itself, so that no other object gets its id.
    """

    name: str
    length: int
    it: Any


class Holding(msgspec.Struct, frozen=True):
    """Everything that an object holds at one time.

    Attributes:
        containers: its dictionaries, lists, sets and deques, by their id.
        size_bytes: the size of all objects together.
    """

    containers: dict[int, Found]
    size_bytes: int

    def grown_since(self, before: Holding, by: int) -> list[str]:
        """Return a sentence for each container that has at least `by` items more than before."""
        return sorted(
            f"{now.name} grew from {was.length} to {now.length}"
            for key, now in self.containers.items()
            if (was := before.containers.get(key)) is not None and now.length >= was.length + by
        )


def held_by(root: Any, *left_out: Any) -> Holding:
    """Search everything that an object holds. Nothing may run meanwhile.

    Args:
        root: the object.
        left_out: objects to skip, with everything that only they hold.
    """
    gc.collect()
    seen = {id(it) for it in left_out}
    containers: dict[int, Found] = {}
    size_bytes = 0
    waiting = deque([(type(root).__name__, root)])
    while waiting:
        name, it = waiting.popleft()
        if id(it) in seen or isinstance(it, _LEFT_OUT):
            continue
        seen.add(id(it))
        size_bytes += _size_of(it)
        if isinstance(it, CONTAINERS):
            containers[id(it)] = Found(name, len(it), it)
        waiting.extend(_parts(name, it))
    return Holding(containers, size_bytes)


def _size_of(it: Any) -> int:
    # msgspec's Raw answers `__sizeof__` with an address.
    return memoryview(it).nbytes if isinstance(it, msgspec.Raw) else sys.getsizeof(it)


def _parts(name: str, it: Any) -> Iterator[tuple[str, Any]]:
    """Yield the parts of an object, each with a name for people."""
    if isinstance(it, types.FunctionType):  # skip its globals, which are the whole module
        yield from ((f"{it.__qualname__}()", cell) for cell in it.__closure__ or ())
        yield f"{it.__qualname__}()", it.__defaults__
    elif isinstance(it, _SHARED):
        yield name, it.__self__
    elif isinstance(it, (*CONTAINERS, tuple, types.CellType, types.MethodType)):
        yield from ((name, part) for part in gc.get_referents(it))
        if isinstance(it, dict):  # the collector does not track a dict of only numbers and strings
            yield from ((name, part) for part in it.values())
    else:
        for attribute, part in _attributes(it):
            yield f"{type(it).__name__}.{attribute}", part
        own = getattr(it, "__dict__", None)
        yield from ((name, part) for part in gc.get_referents(it) if part is not own)


def _attributes(it: Any) -> Iterator[tuple[str, Any]]:
    slots = [slot for cls in type(it).__mro__ for slot in getattr(cls, "__slots__", ())]
    for attribute in {**getattr(it, "__dict__", {}), **dict.fromkeys(slots)}:
        try:
            yield attribute, getattr(it, attribute)
        except AttributeError:  # an empty slot, or one that is private to a base class
            continue
