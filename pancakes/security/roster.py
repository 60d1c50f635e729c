"""Certificates, access rules and the signed roster of a fleet: who belongs to it, and who may do what. Pure.

`Certified` has the contents of a certificate of an agent or a person. `AccessRule` allows something; what no rule
allows is refused. The roster lists revoked certificates and the rules. The fleet's authority signs it, and its number
only rises. Signatures are checked elsewhere (`pancakes.security.authority`), so this module does not need
`cryptography`.
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
"""The tolerance for a certificate's end, because the clocks of two machines differ."""
NEVER_S: Final = 253_402_300_799.0
"""9999-12-31 23:59:59, which means that a certificate has no end (RFC 5280, 4.1.2.5)."""

_NAMED: Final = re.compile(
    rf"pancakes://(?P<fleet>{NAME})/(?P<role>agent|environment|operator|observer)/(?P<name>{NAME})"
)
_GROUPED: Final = re.compile(rf"pancakes://(?P<fleet>{NAME})/group/(?P<group>{NAME})")
_TIME: Final = re.compile(r"(?P<month>[A-Z][a-z]{2}) +(?P<day>\d+) (?P<time>\d\d:\d\d:\d\d) (?P<year>\d{4}) GMT")


class Certified(msgspec.Struct, frozen=True):
    """The contents of a certificate that the fleet's authority signed.

    Attributes:
        fleet: the fleet.
        role: its bearer's role.
        name: its bearer's name on the mesh; a person's terminals add a dot and more.
        groups: the groups by which rules may name its bearer.
        serial: its number, by which it is revoked.
        ends_s: when it ends, in seconds since 1970; infinite: never.
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
        certificate: its contents from `ssl` (`SSLObject.getpeercert`).
        ends_s: its end, in seconds since 1970.

    Raises:
        ValueError: it is not a certificate of a fleet; the message says why, as a clause.
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
    """Return how an agent or a person differs from its certificate, as a sentence; empty: not at all.

    Args:
        it: the contents of the certificate.
        name: the name on the mesh; a person's terminal has the person's name, a dot and more.
        role: the role on the mesh; that of a person is `client`.
        fleet: the fleet.
    """
    if not (name.startswith(f"{it.name}.") if it.is_person else name == it.name):
        return f"it calls itself {name}, but its certificate is {it.name}'s ({it.role})"
    if role != ("client" if it.is_person else it.role):
        return f"{name} comes as {role}, but its certificate is for the role {it.role}"
    if fleet != it.fleet:
        return f"{name} says that it is of the fleet {fleet}, but its certificate says {it.fleet}"
    return ""


def fault_of_end(it: Certified, time_s: float) -> str:
    """Return that a certificate has ended by a time, as a clause; empty: it has not."""
    late_s = time_s - it.ends_s
    if late_s <= SLACK_S:
        return ""
    ago = f"{late_s / 86_400:.0f} days" if late_s > 2 * 86_400 else f"{late_s / 3600:.1f} hours"
    return f"its certificate ended {ago} ago"


Right = Literal[
    "look", "change", "move", "adopt", "end", "halt", "drive", "host", "guard", "command", "write", "publish", "replay"
]  # docs/security.md has a line for each
RIGHTS: Final[tuple[Right, ...]] = get_args(Right)
EVERY: Final = "*"
"""In a rule: every right."""

Pattern = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
Patterns = Annotated[tuple[Pattern, ...], msgspec.Meta(min_length=1, max_length=64)]


class Bearer(NamedTuple):
    """The agent or person to whom rules apply.

    Attributes:
        name: the name in the certificate; a person's terminals add a dot and more.
        role: `agent`, `environment`, `operator` or `observer`.
        groups: the groups.
    """

    name: str
    role: str
    groups: tuple[str, ...] = ()


class AccessRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rule that allows something. The order of rules does not matter.

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
    AccessRule(("role:agent",), ("publish", "look", "host", "guard", "write", "halt")),
    AccessRule(("role:environment",), ("publish",)),
)
"""The rules of a new fleet."""


def allows(rules: Iterable[AccessRule], who: Bearer, right: Right, on: Iterable[str], at: str) -> bool:
    """Return whether a rule lets a bearer do something.

    Args:
        rules: the rules.
        who: the bearer.
        right: the right.
        on: the target of the right; if it has several names, one of them is enough.
        at: the agent at which the bearer would do it.
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
"""The largest roster: it is sent as one message, and each agent keeps it."""
FALSE: Final = 3
"""The exit code of the process that checks a roster, if the authority has not signed it."""
UNKEPT: Final = 4
"""Its exit code if the authority has signed the roster, but it cannot be written to the key folder."""
LATEST_S: Final = 30 * 86_400.0
"""A roster that is dated this much later than the last one and than the own clock is refused: a signer whose clock is
wrong would end each person's certificate for good.
"""
_BEFORE: Final = b"pancakes roster\n"
"""The prefix of signed bytes, so that no other signature of the authority is taken for that of a roster."""

Text = Annotated[str, msgspec.Meta(max_length=300)]


class Revoked(msgspec.Struct, frozen=True):
    """A revoked certificate.

    Attributes:
        serial: its number.
        who: its bearer: `ROLE/NAME`.
        why: the reason, for people.
    """

    serial: Text
    who: Text
    why: Text


class Roster(msgspec.Struct, frozen=True):
    """The rules and revocations of a fleet, from its authority to all agents.

    Attributes:
        fleet: the fleet.
        number: its number, which only rises.
        signed_s: when it was signed, in seconds since 1970.
        revoked: the revoked certificates.
        allow: what its members may do.
        forced: whether agents must accept it whatever its date.
    """

    fleet: Text
    number: Annotated[int, msgspec.Meta(ge=1, le=2**53)]
    signed_s: float
    revoked: tuple[Revoked, ...] = ()
    allow: tuple[AccessRule, ...] = ()
    forced: bool = False


class SignedRoster(msgspec.Struct, frozen=True):
    """A roster as it is sent and stored.

    Attributes:
        payload: the roster, as JSON.
        signature: the authority's signature of `signed_bytes(payload)`, hexadecimal.
    """

    payload: str
    signature: str


_SIGNED: Final = codecs.json_decoder(SignedRoster)
_ROSTER: Final = codecs.json_decoder(Roster)


def signed_bytes(payload: str) -> bytes:
    """Return the bytes of a roster that are signed."""
    return _BEFORE + payload.encode()


def read_signed(text: bytes) -> tuple[SignedRoster, Roster]:
    """Read a roster. Its signature is not checked.

    Raises:
        ValueError: it is not a roster; the message says why, as a phrase.
    """
    if len(text) > MOST_BYTES:
        raise ValueError(f"it has {len(text)} bytes, but at most {MOST_BYTES} are allowed")
    try:
        signed = _SIGNED(text)
        return signed, _ROSTER(signed.payload.encode())
    except MALFORMED as error:
        raise ValueError(f"it is not a roster: {error}") from None


def fault_of_news(new: Roster, last: Roster | None, fleet: str, now_s: float) -> str:
    """Return why a roster must not replace the last one, as a sentence; empty: it may.

    Args:
        new: the roster; its signature has been checked, or will be.
        last: the last one; None: none.
        fleet: the fleet.
        now_s: the own clock, in seconds since 1970.
    """
    if new.fleet != fleet:
        return f"the roster {new.number} is of the fleet {new.fleet}, but this is {fleet}"
    if last is not None and new.number <= last.number:
        return f"the roster {new.number} is older than the roster {last.number}, which is in use"
    latest_s = max(now_s, last.signed_s if last is not None else 0.0) + LATEST_S
    if new.signed_s > latest_s and not new.forced:
        days = (new.signed_s - latest_s + LATEST_S) / 86_400
        return (
            f"the roster {new.number} is dated {days:.0f} days after the last one and the own clock: set that clock, or"
            " that of the machine that signs; or sign it with pancakes keys sign --any-date"
        )
    return ""


def fault_of_certified(it: Certified, fleet: str, roster: Roster | None, now_s: float) -> str:
    """Return why a certificate of the authority is not trusted, as a clause; empty: it is.

    A clock may be slow, but the time is never before the signing of the last roster.

    Args:
        it: the contents of the certificate.
        fleet: the own fleet.
        roster: the known roster; None: none.
        now_s: the own clock, in seconds since 1970.
    """
    if it.fleet != fleet:
        return f"its certificate is of the fleet {it.fleet}, but ours of {fleet}"
    if roster is None:
        return fault_of_end(it, now_s)
    for revoked in roster.revoked:
        if revoked.serial == it.serial:
            return f"its certificate was revoked (roster {roster.number}): {revoked.who}: {revoked.why}"
    return fault_of_end(it, max(now_s, roster.signed_s - SLACK_S))
