"""Certificates, access rules and the signed roster of a fleet: who belongs to it, and who may do what. Pure.

`Certified` is what a certificate says of an agent or a person. `AccessRule` allows something; what no rule allows is
refused. The roster lists revoked certificates and the rules. The fleet's authority signs it, and its number only
rises. Signatures are checked elsewhere (`pancakes.security.authority`), so this module does not need `cryptography`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Annotated, Any, Final, Literal, NamedTuple, get_args

import msgspec

from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED
from pancakes.util.text import NAME

CertifiedRole = Literal["agent", "environment", "operator", "observer"]
"""`agent` and `environment` listen and dial; `operator` and `observer` are people, who only dial."""
PEOPLE: Final = ("operator", "observer")
SLACK_S: Final = 300.0
"""How much later than a certificate's end the clocks of two machines may say that it has passed."""
NEVER_S: Final = 253_402_300_799.0
"""9999-12-31 23:59:59, which says that a certificate has no end (RFC 5280, 4.1.2.5)."""

_NAMED: Final = re.compile(
    rf"pancakes://(?P<fleet>{NAME})/(?P<role>agent|environment|operator|observer)/(?P<name>{NAME})"
)
_GROUPED: Final = re.compile(rf"pancakes://(?P<fleet>{NAME})/group/(?P<group>{NAME})")
_TIME: Final = re.compile(r"(?P<month>[A-Z][a-z]{2}) +(?P<day>\d+) (?P<time>\d\d:\d\d:\d\d) (?P<year>\d{4}) GMT")


class Certified(msgspec.Struct, frozen=True):
    """What a certificate says, which the fleet's authority has signed.

    Attributes:
        fleet: the fleet.
        role: what its bearer is.
        name: its bearer's name on the mesh; a person's terminals have it with a dot and more.
        groups: by which rules may name its bearer.
        serial: its number, by which it is revoked.
        ends_s: when it ends, in seconds since 1970; infinite: it does not.
    """

    fleet: str
    role: CertifiedRole
    name: str
    groups: tuple[str, ...] = ()
    serial: str = ""
    ends_s: float = math.inf

    @property
    def is_person(self) -> bool:
        """Whether its bearer is a person."""
        return self.role in PEOPLE


def certified(certificate: Mapping[str, Any], ends_s: float) -> Certified:
    """Read a certificate whose signature has been checked.

    Args:
        certificate: what `ssl` says of it (`SSLObject.getpeercert`).
        ends_s: its end, in seconds since 1970.

    Raises:
        ValueError: it is none of ours; the message says why, as a clause.
    """
    uris = [text for kind, text in certificate.get("subjectAltName", ()) if kind == "URI"]
    named = [found for uri in uris if (found := _NAMED.fullmatch(uri))]
    if len(named) != 1:
        raise ValueError(f"its certificate names {len(named)} agents or people, and not one")
    fleet, name = named[0]["fleet"], named[0]["name"]
    role: Any = named[0]["role"]
    groups = [found["group"] for uri in uris if (found := _GROUPED.fullmatch(uri)) and found["fleet"] == fleet]
    return Certified(
        fleet, role, name, tuple(groups), str(certificate["serialNumber"]), ends_s if ends_s < NEVER_S else math.inf
    )


def fault_of_bearer(it: Certified, name: str, role: str, fleet: str) -> str:
    """Return in what an agent or a person is not as its certificate says, as a sentence; empty: in nothing.

    Args:
        it: what the certificate says.
        name: the name on the mesh; that of a person's terminal is the person's, a dot and more.
        role: the role on the mesh; that of a person is `client`.
        fleet: the fleet.
    """
    if not (name.startswith(f"{it.name}.") if it.is_person else name == it.name):
        return f"it calls itself {name}, and its certificate is {it.name}'s ({it.role})"
    if role != ("client" if it.is_person else it.role):
        return f"{name} comes as {role}, and its certificate is for the role {it.role}"
    if fleet != it.fleet:
        return f"{name} says that it is of the fleet {fleet}, and its certificate says {it.fleet}"
    return ""


def fault_of_end(it: Certified, time_s: float) -> str:
    """Return whether a certificate has ended by a time, as a clause; empty: it has not."""
    late_s = time_s - it.ends_s
    if late_s <= SLACK_S:
        return ""
    ago = f"{late_s / 86_400:.0f} days" if late_s > 2 * 86_400 else f"{late_s / 3600:.1f} hours"
    return f"its certificate ended {ago} ago"


Right = Literal[
    "look", "change", "move", "adopt", "end", "host", "guard", "command", "write", "publish", "replay"
]  # docs/security.md has a line for each
RIGHTS: Final[tuple[Right, ...]] = get_args(Right)
EVERY: Final = "*"
"""In a rule: every right."""

Pattern = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
Patterns = Annotated[tuple[Pattern, ...], msgspec.Meta(min_length=1, max_length=64)]


class Bearer(NamedTuple):
    """To whom rules apply.

    Attributes:
        name: the name: that in the certificate, which a person's terminals have with a dot and more.
        role: `agent`, `environment`, `operator` or `observer`.
        groups: the groups.
    """

    name: str
    role: str
    groups: tuple[str, ...] = ()


class AccessRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Allow something. The order of rules never matters.

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
    """Return whether a rule lets a bearer do something.

    Args:
        rules: the rules.
        who: the bearer.
        right: the right.
        on: what it is for; if that has several names, one of them is enough.
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


MOST_BYTES: Final = 128 * 1024
"""A roster is no larger: it travels as one message, and each agent keeps it."""
FALSE: Final = 3
"""The exit code of the process that checks a roster, if the authority has not signed it."""
UNKEPT: Final = 4
"""Its exit code if the authority has signed the roster, and the roster cannot be written beside the keys."""
LATEST_S: Final = 30 * 86_400.0
"""A roster that is dated so much later than the last one, and than the own clock, is not believed: a signer whose clock
is wrong would end each person's certificate for good.
"""
_BEFORE: Final = b"pancakes roster\n"
"""Stands before what is signed, so that no other signature of the authority can be taken for one of a roster."""

Text = Annotated[str, msgspec.Meta(max_length=300)]


class Revoked(msgspec.Struct, frozen=True):
    """A certificate that is believed no more.

    Attributes:
        serial: its number.
        who: whose it is: `ROLE/NAME`.
        why: the reason, for people.
    """

    serial: Text
    who: Text
    why: Text


class Roster(msgspec.Struct, frozen=True):
    """What the authority says to all agents of its fleet.

    Attributes:
        fleet: the fleet.
        number: it only rises.
        signed_s: when it was signed, in seconds since 1970.
        revoked: the certificates that are believed no more.
        allow: what its members may do.
        forced: whether agents must believe it whatever its date.
    """

    fleet: Text
    number: Annotated[int, msgspec.Meta(ge=1, le=2**53)]
    signed_s: float
    revoked: tuple[Revoked, ...] = ()
    allow: tuple[AccessRule, ...] = ()
    forced: bool = False


class SignedRoster(msgspec.Struct, frozen=True):
    """A roster as it travels and is kept.

    Attributes:
        payload: the roster, as JSON.
        signature: the authority's, over what `signed_bytes` makes of that; hexadecimal.
    """

    payload: str
    signature: str


_SIGNED: Final = codecs.json_decoder(SignedRoster)
_ROSTER: Final = codecs.json_decoder(Roster)


def signed_bytes(payload: str) -> bytes:
    """Return what is signed of a roster."""
    return _BEFORE + payload.encode()


def read_signed(text: bytes) -> tuple[SignedRoster, Roster]:
    """Read a roster. Its signature is not checked.

    Raises:
        ValueError: it is none; the message says why, as a phrase.
    """
    if len(text) > MOST_BYTES:
        raise ValueError(f"it has {len(text)} bytes, and {MOST_BYTES} are the most")
    try:
        signed = _SIGNED(text)
        return signed, _ROSTER(signed.payload.encode())
    except MALFORMED as error:
        raise ValueError(f"it is no roster: {error}") from None


def fault_of_news(new: Roster, last: Roster | None, fleet: str, now_s: float) -> str:
    """Return why a roster is not taken in the place of the last one, as a sentence; empty: it is.

    Args:
        new: the roster; its signature has been checked, or will be.
        last: the last one; None: there is none.
        fleet: the fleet.
        now_s: the own clock, in seconds since 1970.
    """
    if new.fleet != fleet:
        return f"the roster {new.number} is of the fleet {new.fleet}, and this is {fleet}"
    if last is not None and new.number <= last.number:
        return f"the roster {new.number} is older than the roster {last.number}, which is known"
    latest_s = max(now_s, last.signed_s if last is not None else 0.0) + LATEST_S
    if new.signed_s > latest_s and not new.forced:
        days = (new.signed_s - latest_s + LATEST_S) / 86_400
        return (
            f"the roster {new.number} is dated {days:.0f} days after the last one and the own clock: set that clock, or"
            " that of the machine that signs; or sign it with pancakes fleet sign --any-date"
        )
    return ""


def fault_of_certified(it: Certified, fleet: str, roster: Roster | None, now_s: float) -> str:
    """Return why the bearer of a certificate of the authority is not believed, as a clause; empty: it is.

    A clock may be late, but never later than the last roster was signed.

    Args:
        it: what the certificate says.
        fleet: the own fleet.
        roster: the roster that is known; None: none is.
        now_s: the own clock, in seconds since 1970.
    """
    if it.fleet != fleet:
        return f"its certificate is of the fleet {it.fleet}, and ours of {fleet}"
    if roster is None:
        return fault_of_end(it, now_s)
    for revoked in roster.revoked:
        if revoked.serial == it.serial:
            return f"its certificate was revoked (roster {roster.number}): {revoked.who}: {revoked.why}"
    return fault_of_end(it, max(now_s, roster.signed_s - SLACK_S))
