"""Values of any type that a packet's field may have: some usual, some at the ends of what the type allows."""

from __future__ import annotations

import enum
import math
import random
import types
import typing
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

FLOATS = (0.0, 0.1, 1.0, 5.0, -1.0, 1e-9, 1e308, 5e-324, math.nan, math.inf, -math.inf)
INTEGERS = (0, 0, 1, 1, 2, 3, 50, 10**6, -1, 2**63 - 1, -(2**63))
TEXTS = ("", "*", "x" * 300, "\n", "\x00", "../x", "ü", "a/b/c/d", "task:a/Count", "-x")
DEEPEST = 4


class OddValues:
    """Draws values.

    Args:
        seed: draws them.
        texts: texts that mean something to the receiver, which come most often.
        raw: the same of bytes.
    """

    def __init__(self, seed: int, texts: Sequence[str], raw: Sequence[bytes]) -> None:
        self.draw = random.Random(seed)
        self._texts = texts
        self._raw = (*raw, b"", b"\x81", bytes(1000))

    def of_class(self, cls: type[msgspec.Struct], depth: int = 0) -> Any:
        """Returns an instance of a class; a field that has a default has that now and then."""
        hints = get_type_hints(cls, include_extras=True)
        fields = [it for it in msgspec.structs.fields(cls) if it.required or self.draw.random() < 0.7]
        return cls(**{it.name: self.of(hints[it.name], depth) for it in fields})

    def of(self, kind: Any, depth: int = 0) -> Any:
        """Returns a value of a type."""
        draw, origin, arguments = self.draw, get_origin(kind), get_args(kind)
        if origin is Annotated:
            return self.of(arguments[0], depth)
        if origin in (Union, types.UnionType):
            return self.of(draw.choice(arguments), depth)
        if origin is Literal:
            return draw.choice(arguments)
        if kind in _LEAVES or depth > DEEPEST:
            return self._leaf(kind)
        if isinstance(kind, type) and issubclass(kind, enum.Enum):
            return draw.choice(list(kind))
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            return self.of_class(kind, depth + 1)
        if isinstance(kind, type) and issubclass(kind, tuple):  # a named one
            hints = get_type_hints(kind, include_extras=True)
            return kind(*(self.of(hint, depth + 1) for hint in hints.values()))
        if origin is tuple and arguments[-1] is not Ellipsis:
            return tuple(self.of(it, depth + 1) for it in arguments)
        if origin in (list, tuple, set, frozenset):
            return origin([self.of(arguments[0], depth + 1) for _ in range(draw.choice((0, 1, 1, 2, 5)))])
        # A mapping: a plain `dict` as well as one that says what is in it.
        of_key, of_value = arguments or (str, Any)
        return {self.of(of_key, depth + 1): self.of(of_value, depth + 1) for _ in range(draw.choice((0, 1, 2)))}

    def _leaf(self, kind: Any) -> Any:
        draw = self.draw
        if kind is str:
            return draw.choice(self._texts if draw.random() < 0.85 else TEXTS)
        if kind is bool:
            return draw.random() < 0.5
        if kind is int:
            return draw.choice(INTEGERS)
        if kind is float:
            return draw.choice(FLOATS)
        if kind is bytes:
            return draw.choice(self._raw)
        return None if kind is type(None) else draw.choice((None, 1, -1.5, "x", [], {}, True))


_LEAVES: typing.Final = (str, bool, int, float, bytes, type(None), Any)
