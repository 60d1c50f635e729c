"""SHA-256 without OpenSSL, which `hashlib` loads: megabytes of memory and some of the start of each agent.

Python has a SHA-256 of its own, under a private name, on which `hashlib` falls back. OpenSSL's is several times faster,
so it computes the digests of long data.
"""

from __future__ import annotations

from typing import Final

try:
    from _sha256 import sha256 as _own_sha256  # type: ignore[import-not-found] # Python 3.11
except ImportError:
    try:
        from _sha2 import sha256 as _own_sha256  # type: ignore[import-not-found] # from Python 3.12 on
    except ImportError:
        from hashlib import sha256 as _own_sha256

LONG_BYTES: Final = 256 * 1024
"""From this length on OpenSSL computes the digest."""


def sha256(data: bytes) -> bytes:
    """Returns the digest, 32 bytes."""
    if len(data) < LONG_BYTES:
        digest: bytes = _own_sha256(data).digest()
        return digest
    import hashlib

    return hashlib.sha256(data).digest()
