"""Why a broker cannot be used, as sentences that say what to do. Pure."""

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
    0x86: "the user or the password is wrong: check user and password_file",
    0x04: "the user or the password is wrong: check user and password_file",
    0x87: "it does not let this user in: check user and password_file, and the broker's rules",
    0x05: "it does not let this user in: check user and password_file, and the broker's rules",
    0x8E: "another connection has the same client_id: rename one of the agents, or give one a client_id",
    0x93: "it was sent too much at a time",
    0x95: "a message was too large for it",
    0x97: "its quota is used up",
    0x9A: "it keeps no messages (retain)",
    0x9B: "it does not take this QoS",
}
"""The meaning for an agent of those reason codes of MQTT 5.0 (2.4) and return codes of 3.1.1 (3.2.2.3) that people can
act on."""
TAKEN_OVER: Final = 0x8E


def why_refused(code: int, name: str) -> str:
    """Return why a broker has refused or ended a connection, as a clause.

    Args:
        code: the reason code.
        name: its name in the standard.
    """
    return REFUSED.get(code, name.lower())


def why_unreachable(error: OSError, encrypted: bool) -> str:
    """Return why connecting failed, as a clause.

    Args:
        error: the error of connecting.
        encrypted: whether the connection should be encrypted.
    """
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({error.verify_message}): check ca, and the host in broker"
    if isinstance(error, ssl.SSLError):
        if error.reason in ("WRONG_VERSION_NUMBER", "UNEXPECTED_EOF_WHILE_READING", "RECORD_LAYER_FAILURE"):
            return "it does not speak TLS at this port: write mqtt://, or its encrypted port"
        return f"TLS failed ({error.reason or error})"
    if isinstance(error, socket.gaierror):
        return "its host is not known"
    if isinstance(error, TimeoutError):
        return "it does not answer"
    if isinstance(error, ConnectionResetError) and encrypted:
        return "it ended the connection: perhaps it does not speak TLS at this port, or needs a certificate"
    return os.strerror(error.errno).lower() if error.errno else str(error)
