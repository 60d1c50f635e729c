"""TLS towards a broker."""

from __future__ import annotations

import socket
import ssl
from typing import Any

from pancakes import PancakesError
from pancakes_mqtt.broker_settings import BrokerSettings


class PromptContext(ssl.SSLContext):
    """Make the handshake at once, with its own time-out, and close the socket if it fails: paho leaves it open."""

    handshake_s = 3.0

    def wrap_socket(self, sock: socket.socket, *args: Any, **others: Any) -> ssl.SSLSocket:
        """Return the encrypted socket, with its handshake done. Raises OSError."""
        sock.settimeout(self.handshake_s)
        try:
            wrapped = super().wrap_socket(sock, *args, **others)
        except BaseException:
            sock.close()
            raise
        try:
            wrapped.do_handshake()
        except BaseException:
            wrapped.close()
            raise
        return wrapped


def tls_context(settings: BrokerSettings) -> PromptContext:
    """Return the TLS context: the trusted authorities and the own certificate.

    Raises:
        PancakesError: a file cannot be used.
    """
    context = PromptContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        if settings.ca:
            context.load_verify_locations(settings.ca)
        else:
            context.load_default_certs()
    except OSError as error:
        raise PancakesError(f"ca: {settings.ca} has no certificates: {error.strerror or error}") from None
    try:
        if settings.certificate:
            context.load_cert_chain(settings.certificate, settings.key)
    except OSError as error:
        named = f"{settings.certificate} and {settings.key}"
        raise PancakesError(f"certificate, key: {named} do not belong together: {error.strerror or error}") from None
    return context
