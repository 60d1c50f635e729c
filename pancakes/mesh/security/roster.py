"""The roster of a fleet: who was revoked, and who may do what; signed, with a number that only rises. Pure."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from pancakes.mesh.security.certified import SLACK_S, Certified, fault_of_end
from pancakes.mesh.security.rules import AccessRule
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED

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
        forced: whether it is to be believed whatever its date.
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
    """Returns what is signed of a roster."""
    return _BEFORE + payload.encode()


def read_signed(text: bytes) -> tuple[SignedRoster, Roster]:
    """Reads a roster. Its signature is not checked.

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
    """Returns why a roster is not taken in the place of the last one, as a sentence; empty: it is.

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
    """Returns why the bearer of a certificate of the authority is not believed, as a clause; empty: it is.

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
