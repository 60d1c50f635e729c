"""TLS 1.3 with certificates on both sides, as a layer over any connection. Imports OpenSSL: import it lazily.

No bytes reach the handler before the other side has proved its identity. OpenSSL works in memory,
and another class carries the bytes: a socket, or a link through routers, which then see only ciphertext. A caller
that sends encrypts in its own thread, under the lock that the loop's thread takes to decrypt, because OpenSSL allows
one call at a time for each connection. `sentence_of` turns OpenSSL's errors into sentences for people.
"""

from __future__ import annotations

import contextlib
import ssl
from collections.abc import Callable
from typing import Any, Final

from pancakes.mesh.stream import KeptConnection, StreamConnection
from pancakes.mesh.transport import UNSAID, Scheduled
from pancakes.security.keys import Keys, certificate_shown

_REASONS: Final = {
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "it showed no certificate",
    "WRONG_VERSION_NUMBER": "it does not encrypt: perhaps it has no keys",
    "HTTP_REQUEST": "it speaks HTTP",
    "HTTPS_PROXY_REQUEST": "it speaks HTTP",
    "UNSUPPORTED_PROTOCOL": "it speaks no TLS 1.3",
    "NO_PROTOCOLS_AVAILABLE": "it speaks no TLS 1.3",
    "TLSV1_ALERT_PROTOCOL_VERSION": "it speaks no TLS 1.3",
    "TLSV1_ALERT_UNKNOWN_CA": "it does not know the authority that signed our certificate: it is of another fleet",
    "TLSV13_ALERT_CERTIFICATE_REQUIRED": "it asks for a certificate, and we have none",
    "SSLV3_ALERT_BAD_CERTIFICATE": "it does not believe our certificate",
    "SSLV3_ALERT_CERTIFICATE_EXPIRED": "it says that our certificate has ended",
    "SSLV3_ALERT_CERTIFICATE_REVOKED": "it says that our certificate was revoked",
    "SSLV3_ALERT_UNSUPPORTED_CERTIFICATE": "our certificate is not for this use",
    "TLSV1_ALERT_DECRYPT_ERROR": "what it was sent was changed on its way",
    "SSLV3_ALERT_BAD_RECORD_MAC": "what it was sent was changed on its way",
    "RECORD_LAYER_FAILURE": "what came was changed on its way",
    "DECRYPTION_FAILED_OR_BAD_RECORD_MAC": "what came was changed on its way",
}
_VERIFY: Final = {
    7: "its certificate bears a false signature",
    18: "its certificate was signed by itself",
    19: "its certificate is of another fleet",
    20: "its certificate is of another fleet",
    26: "its certificate is not for this use",
}
"""By the numbers of OpenSSL's X509_V_ERR_..."""


def sentence_of(error: ssl.SSLError) -> str:
    """Return why a connection failed, as a clause."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return _VERIFY.get(error.verify_code, f"its certificate is not believed: {error.verify_message}")
    return _REASONS.get(error.reason or "", f"TLS failed: {(error.reason or str(error)).replace('_', ' ').lower()}")


HANDSHAKE_S: Final = 5.0
RECORD_BYTES: Final = 16 * 1024
"""How many bytes are encrypted or decrypted at a time: OpenSSL never frees its buffers."""
MOST_BYTES: Final = 2**38
"""A connection ends after this many bytes, and is dialled again: Python cannot renew AES-GCM keys (RFC 8446, 5.5)."""


class TlsLayer(KeptConnection):
    """One encrypted connection; `certified` is known when the handler's `opened` is called.

    It comes before the class that carries the bytes in the bases of a connection.

    Args:
        carried: the arguments of the class that carries the bytes.
        keys: its own certificate, and the authorities that it trusts.
        dialled: whether it was dialled.
        shaken: called when the handshake is over, also if it failed.
    """

    def __init__(self, *carried: Any, keys: Keys, dialled: bool, shaken: Callable[[TlsLayer], None]) -> None:
        super().__init__(*carried)
        self._keys = keys
        self._shaken = shaken
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        context = keys.dialling if dialled else keys.listening
        self._tls = context.wrap_bio(self._in, self._out, server_side=not dialled)
        self._late: Scheduled | None = None
        self._bytes = 0

    def begin(self) -> None:
        self._start()
        late = f"no handshake within {HANDSHAKE_S:g} s"
        self._late = self._owner.loop.call_later(HANDSHAKE_S, lambda: self.dispose(late))
        self._shake()

    def send(self, data: bytes) -> int:
        with self._lock:
            if self._closing or not data:
                return self._unsent
            try:
                return self._put(self._seal(data))
            except ssl.SSLError as error:
                self._break_off(sentence_of(error))
                return 0

    def dispose(self, reason: str) -> None:
        self._end_handshake()
        super().dispose(reason)

    def _end_handshake(self) -> None:
        self._shaken(self)
        if self._late is not None:
            self._late.cancel()

    def _seal(self, data: bytes) -> bytes:
        """Encrypt bytes. Under the lock."""
        self._count(len(data))
        if len(data) <= RECORD_BYTES:
            self._tls.write(data)
            return self._out.read()
        sealed: list[bytes] = []
        view = memoryview(data)
        for first in range(0, len(data), RECORD_BYTES):
            self._tls.write(view[first : first + RECORD_BYTES])
            sealed.append(self._out.read())
        return b"".join(sealed)

    def _count(self, size: int) -> None:
        self._bytes += size
        if self._bytes > MOST_BYTES:
            self._break_off(f"it has carried {MOST_BYTES} bytes, and begins again with new keys")

    def _flush(self) -> None:
        """Send OpenSSL's own messages. Under the lock."""
        if self._out.pending:
            self._put(self._out.read())

    def _shake(self) -> None:
        with self._lock:
            try:
                self._tls.do_handshake()
                fault = self._look()
                if fault and (words := self._handler.last_words(fault)):
                    self._put(self._seal(words))
            except ssl.SSLWantReadError:
                self._flush()
                return
            except ssl.SSLError as error:
                fault = sentence_of(error)
            self._flush()  # an alert too, so that the other side can say why
        self._end_handshake()
        if fault:
            # Closed in order, so that the other side sees the alert before the end.
            self.close(fault)
        else:
            self._handler.opened(self)

    def _look(self) -> str:
        """Read the certificate of the other end; return why it is not trusted, as a clause."""
        try:
            found = certificate_shown(self._tls)
        except ValueError as error:
            return str(error)
        fault = self._keys.fault_of(found)
        if not fault:
            self.certified = found
        return fault

    def _take(self, data: memoryview) -> None:
        if self.certified is None:
            if self._closing:
                return
            self._in.write(data)
            self._shake()
            if self.certified is None or not self._in.pending:
                return
            data = memoryview(b"")
        plain, ended = self._opened_bytes(data)
        if plain and not self._closing:
            self._handler.received(plain)
        if ended:
            self.dispose(ended)

    def _opened_bytes(self, sealed: memoryview) -> tuple[bytes, str]:
        """Decrypt bytes; return them, and why the connection has ended; empty: it has not."""
        parts: list[bytes] = []
        ended = ""
        with self._lock:
            try:
                for first in range(0, max(len(sealed), 1), RECORD_BYTES):
                    self._in.write(sealed[first : first + RECORD_BYTES])
                    with contextlib.suppress(ssl.SSLWantReadError):
                        while self._in.pending or self._tls.pending():
                            part = self._tls.read(RECORD_BYTES)
                            if not part:
                                raise ssl.SSLZeroReturnError
                            parts.append(part)
            except ssl.SSLZeroReturnError:
                ended = "the other side closed the connection"
            except ssl.SSLError as error:
                ended = f"the connection to {self.remote} broke: {sentence_of(error)}"
            self._flush()
            self._count(sum(map(len, parts)))
        return b"".join(parts), ended

    def _end(self) -> str:
        if self.certified is None:
            return UNSAID
        return f"the connection to {self.remote} broke: its end was cut off"

    def _half_close(self) -> None:
        with self._lock:
            if self._waiting:
                return
            with contextlib.suppress(ssl.SSLError, OSError):
                self._tls.unwrap()
            self._flush()
            if not self._waiting:
                self._shut()


class TlsConnection(TlsLayer, StreamConnection):
    """One encrypted connection over a socket; see `TlsLayer` for the arguments."""
