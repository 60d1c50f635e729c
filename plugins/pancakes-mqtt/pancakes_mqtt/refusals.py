"""Why a broker cannot be spoken to, as sentences that say what to do. Pure."""

from __future__ import annotations

import os
import socket
import ssl
from typing import Final

REFUSED: Final = {
    0x84: 'it speaks another version of MQTT: set protocol = "3.1.1"',
    0x01: 'it speaks another version of MQTT: set protocol = "3.1.1"',
    0x85: "it does not take this client_id: set another",
    0x02: "it does not take this client_id: set another",
    0x86: "the user or the password is wrong: look at user and password_file",
    0x04: "the user or the password is wrong: look at user and password_file",
    0x87: "it lets no such user in: look at user and password_file, and at the broker's rules",
    0x05: "it lets no such user in: look at user and password_file, and at the broker's rules",
    0x8E: "another connection has the same client_id: two agents have one name, or give one of them a client_id",
    0x93: "it was sent more at a time than it takes",
    0x95: "a message was larger than it takes",
    0x97: "its quota is used up",
    0x9A: "it keeps no messages (retain)",
    0x9B: "it does not take this QoS",
}
"""What the reason codes of MQTT 5.0 (2.4) and the return codes of 3.1.1 (3.2.2.3) that people can do something about
mean for an agent."""
TAKEN_OVER: Final = 0x8E


def why_refused(code: int, name: str) -> str:
    """Return why a broker has refused or ended a connection, as a clause.

    Args:
        code: the reason code.
        name: what the standard calls it.
    """
    return REFUSED.get(code, name.lower())


def why_unreachable(error: OSError, encrypted: bool) -> str:
    """Return why no connection came to be, as a clause.

    Args:
        error: what connecting has raised.
        encrypted: whether it was to be encrypted.
    """
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not believed ({error.verify_message}): look at ca, and at the host in broker"
    if isinstance(error, ssl.SSLError):
        if error.reason in ("WRONG_VERSION_NUMBER", "UNEXPECTED_EOF_WHILE_READING", "RECORD_LAYER_FAILURE"):
            return "it does not speak TLS at this port: write mqtt://, or its encrypted port"
        return f"TLS failed ({error.reason or error})"
    if isinstance(error, socket.gaierror):
        return "its host is not known"
    if isinstance(error, TimeoutError):
        return "it does not answer"
    if isinstance(error, ConnectionResetError) and encrypted:
        return "it ended the connection: it may speak no TLS at this port, or want a certificate"
    return os.strerror(error.errno).lower() if error.errno else str(error)
