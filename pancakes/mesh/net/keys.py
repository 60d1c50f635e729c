"""An agent's own key and the certificate of its fleet: what it shows at each connection, and whom it believes."""

from __future__ import annotations

import os
import ssl
import stat
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError

KEY: Final = "key.pem"
"""The agent's certificate and its private key."""
FLEET: Final = "fleet.pem"
"""The certificate of the fleet's authority."""
_NO_CHECK_TIME: Final = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME, which Python does not name: a robot without a clock wakes up in 1970."""


class Keys:
    """What TLS needs of an agent's keys, for connections that are dialled and those that come in.

    Args:
        directory: where `key.pem` and `fleet.pem` are.

    Attributes:
        dialling: for connections that are dialled.
        listening: for connections that come in.

    Raises:
        PancakesError: a file is missing, is of no use, or others can read the key; the sentence names it.
    """

    def __init__(self, directory: Path) -> None:
        check_private(directory / KEY)
        self.dialling = _context(ssl.PROTOCOL_TLS_CLIENT, directory)
        self.listening = _context(ssl.PROTOCOL_TLS_SERVER, directory)


def _context(protocol: int, directory: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the name stands in the certificate's URI, and the hello is held against it
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(int(context.verify_flags) | _NO_CHECK_TIME)
    for file, load in ((FLEET, context.load_verify_locations), (KEY, context.load_cert_chain)):
        path = directory / file
        try:
            load(path)
        except ssl.SSLError as error:
            raise PancakesError(f"the key file {path} cannot be used: {error.reason or error}") from None
        except OSError as error:
            raise PancakesError(f"the key file {path} cannot be used: {error.strerror or error}") from None
    if protocol == ssl.PROTOCOL_TLS_SERVER:
        context.num_tickets = 0  # a peer that comes again shows its certificate again
    return context


def check_private(path: Path) -> None:
    """Checks that no other user can read a private key.

    Raises:
        PancakesError: another user can, or it is not there; the sentence says what to do.
    """
    try:
        found = path.lstat()
    except OSError as error:
        raise PancakesError(f"the key {path} cannot be used: {(error.strerror or str(error)).lower()}") from None
    if not stat.S_ISREG(found.st_mode):
        raise PancakesError(f"the key {path} is no file")
    if found.st_uid != os.getuid():
        raise PancakesError(f"the key {path} belongs to another user (uid {found.st_uid})")
    if found.st_mode & 0o077:
        raise PancakesError(
            f"the key {path} can be read by others (mode {stat.S_IMODE(found.st_mode):o}): chmod 600 it"
        )
