"""What a certificate says of the agent or the person that shows it. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Final, Literal

import msgspec

from pancakes.runtime.foundation.names import NAME

CertifiedRole = Literal["agent", "environment", "operator", "observer"]
"""`agent` and `environment` listen and dial; `operator` and `observer` are people, who only dial."""
PEOPLE: Final = ("operator", "observer")
SLACK_S: Final = 300.0
"""So much later than a certificate's end the clocks of two machines may say that it has passed."""
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
        name: its bearer's name on the mesh; a person's terminals bear it with a dot and more.
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
    """Reads a certificate whose signature has been checked.

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
    """Returns in what an agent or a person is not as its certificate says, as a sentence; empty: in nothing.

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
    """Returns whether a certificate has ended by a time, as a clause; empty: it has not."""
    late_s = time_s - it.ends_s
    if late_s <= SLACK_S:
        return ""
    ago = f"{late_s / 86_400:.0f} days" if late_s > 2 * 86_400 else f"{late_s / 3600:.1f} hours"
    return f"its certificate ended {ago} ago"
