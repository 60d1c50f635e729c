"""Who may do what in a fleet: rules that allow, and what no rule allows is refused. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Annotated, Final, Literal, NamedTuple

import msgspec

Right = Literal[
    "look", "change", "move", "adopt", "end", "host", "guard", "command", "write", "publish", "replay"
]  # docs/security.md has a line for each
RIGHTS: Final[tuple[Right, ...]] = (
    "look",
    "change",
    "move",
    "adopt",
    "end",
    "host",
    "guard",
    "command",
    "write",
    "publish",
    "replay",
)
EVERY: Final = "*"
"""In a rule: every right."""

Pattern = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
Patterns = Annotated[tuple[Pattern, ...], msgspec.Meta(min_length=1, max_length=64)]


class Bearer(NamedTuple):
    """To whom rules apply.

    Attributes:
        name: the name: that in the certificate, which a person's terminals bear with a dot and more.
        role: `agent`, `environment`, `operator` or `observer`.
        groups: the groups.
    """

    name: str
    role: str
    groups: tuple[str, ...] = ()


class AccessRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Allows something. The order of rules never matters.

    Attributes:
        who: `role:ROLE`, `group:GROUP`, or a pattern of names (`*` for any letters, `?` for one).
        may: the rights; `*`: every right.
        on: patterns of what the rights are for; see docs/security.md.
        at: patterns of the agents at which this holds.
    """

    who: Patterns
    may: Annotated[tuple[Right | Literal["*"], ...], msgspec.Meta(min_length=1)]
    on: Patterns = (EVERY,)
    at: Patterns = (EVERY,)


DEFAULT: Final = (
    AccessRule(("role:operator",), (EVERY,)),
    AccessRule(("role:observer",), ("look",)),
    AccessRule(("role:agent",), ("publish", "look", "host", "guard", "write")),
    AccessRule(("role:environment",), ("publish",)),
)
"""The rules of a new fleet."""


def allows(rules: Iterable[AccessRule], who: Bearer, right: Right, on: Iterable[str], at: str) -> bool:
    """Returns whether a rule lets a bearer do something.

    Args:
        rules: the rules.
        who: the bearer.
        right: the right.
        on: what it is for; where that has several names, one of them is enough.
        at: the agent at which it would be done.
    """
    return any(
        (right in rule.may or EVERY in rule.may)
        and _is_one_of((at,), rule.at)
        and _is_one_of(on, rule.on)
        and any(_means(pattern, who) for pattern in rule.who)
        for rule in rules
    )


def _means(pattern: str, who: Bearer) -> bool:
    kind, _, rest = pattern.rpartition(":")
    if kind == "role":
        return rest == who.role
    if kind == "group":
        return rest in who.groups
    return fnmatchcase(who.name, pattern)


def _is_one_of(names: Iterable[str], patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for name in names for pattern in patterns)
