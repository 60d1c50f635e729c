"""SHA-256 without OpenSSL.

`hashlib` loads OpenSSL's libcrypto, which takes 3.5 MiB of an agent's 26 and 4 ms of its start, for the few hundred
bytes of an entry of the journal. Python has a SHA-256 of its own, under a private name that `hashlib` falls back on,
just as `random` takes its SHA-512. OpenSSL's is several times faster: so that is taken for what is long.
"""

from __future__ import annotations

from typing import Final

LONG_BYTES: Final = 262_144
"""From this length on, the time that OpenSSL saves is worth its memory: it hashes 4 MiB in 2 ms instead of 16."""


def sha256(data: bytes) -> bytes:
    """Returns the digest, 32 bytes."""
    if len(data) < LONG_BYTES:
        try:
            from _sha256 import sha256 as own  # type: ignore[import-not-found] # as it is called in Python 3.11
        except ImportError:
            try:
                from _sha2 import sha256 as own  # type: ignore[import-not-found] # and from 3.12 on
            except ImportError:
                from hashlib import sha256 as own
    else:
        from hashlib import sha256 as own
    digest: bytes = own(data).digest()
    return digest
