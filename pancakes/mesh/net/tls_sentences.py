"""What OpenSSL says of a failure, for people. Pure."""

from __future__ import annotations

import ssl
from typing import Final

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
    """Returns why a connection cannot be, as a clause."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return _VERIFY.get(error.verify_code, f"its certificate is not believed: {error.verify_message}")
    return _REASONS.get(error.reason or "", f"TLS failed: {(error.reason or str(error)).replace('_', ' ').lower()}")
