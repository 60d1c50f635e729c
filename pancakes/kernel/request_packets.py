"""What travels when a task asks another one (`pancakes.request`): the request, feedback, the answer, a cancellation.

The source and the number of the packet with an `Ask` name the request in all that follows. Few agents ever have to do
with requests, so this is imported when the first of them comes: a packet may have come before its type was known here.
"""

from __future__ import annotations

from typing import Any, Final, cast, get_args

import msgspec

from pancakes.errors import RefusalCode, RemoteProtocolError
from pancakes.kernel.mailbox import ASK_TYPE
from pancakes.packet import SYSTEM, Packet, body_class, packet_type, type_name
from pancakes.request import RequestError
from pancakes.util import codecs

REQUESTS: Final = SYSTEM
"""The channel on which all of this travels."""
CODES: Final[frozenset[str]] = frozenset(get_args(RefusalCode))


@packet_type(ASK_TYPE)
class Ask(msgspec.Struct, frozen=True):
    """Asks a task for something; its source and number name the request from now on.

    Attributes:
        type: the packet type of the request.
        body: the request, as plain values.
        timeout_s: after how long no answer is wanted any more, in mission seconds.
        reply_to: `task:BIRTHPLACE/NAME` of the task that asks, wherever it will be; empty: it stays where it is.
    """

    type: str
    body: Any
    timeout_s: float
    reply_to: str = ""


@packet_type("request.feedback")
class Feedback(msgspec.Struct, frozen=True):
    """Tells how far a request is.

    Attributes:
        source, seq: the request.
        number: counts the feedback on it, from 1.
        body: what is told, as plain values.
    """

    source: str
    seq: int
    number: int
    body: Any


@packet_type("request.answer")
class Answered(msgspec.Struct, frozen=True):
    """Answers a request.

    Attributes:
        source, seq: the request.
        body: the answer, as plain values.
        code: why there is none, for programs; empty: there is one.
        text: why there is none, for people.
    """

    source: str
    seq: int
    body: Any = None
    code: str = ""
    text: str = ""


@packet_type("request.cancel")
class Cancel(msgspec.Struct, frozen=True):
    """Calls a request off.

    Attributes:
        source, seq: the request.
    """

    source: str
    seq: int


ASK: Final = type_name(Ask)
ANSWERED: Final = type_name(Answered)
FEEDBACK: Final = type_name(Feedback)
CANCEL: Final = type_name(Cancel)


def read(packet: Packet) -> Ask | Feedback | Answered | Cancel:
    """Return the body of a packet of requests, which may have come before this module was imported.

    Raises:
        RemoteProtocolError: it is none.
    """
    cls: Any = body_class(packet.type)
    if isinstance(packet.body, cls):
        return cast(Any, packet.body)
    try:
        return cast(Any, codecs.convert(packet.body, cls))
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"{packet.type!r} of {packet.source} cannot be read: {error}") from None


def error_of(answered: Answered) -> RequestError | None:
    """Return why a request has no result; None: it has one."""
    if not answered.code:
        return None
    code = cast(RefusalCode, answered.code if answered.code in CODES else "failed")
    return RequestError(answered.text or "it was refused without a reason", code)


def not_there(packet: Packet, code: RefusalCode, reason: str) -> tuple[str, Answered] | None:
    """Return what is said, and to which destination, if nothing can take a request; None: the packet is none.

    Args:
        packet: what could not be delivered.
        code: why, for programs.
        reason: why, for people.
    """
    try:
        asked = read(packet)
    except RemoteProtocolError:
        return None
    if not isinstance(asked, Ask):
        return None
    return asked.reply_to or packet.source, Answered(packet.source, packet.seq, None, code, reason)
