"""Load an agent's own key and certificate, and decide which certificates to trust. Imports OpenSSL."""

from __future__ import annotations

import os
import ssl
import stat
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError
from pancakes.security.key_store import FLEET, KEY, ROSTER
from pancakes.security.roster import Certified, Roster, certified, fault_of_certified, fault_of_news, read_signed
from pancakes.util.clock import wall_ns
from pancakes.util.files import check_plain, read_plain

_NO_CHECK_TIME: Final = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME, for which Python has no name: a robot without a clock starts in 1970."""


class Keys:
    """The TLS contexts of a key folder, for dialled and incoming connections.

    Args:
        folder: the key folder.

    Attributes:
        folder: the same.
        dialling: for connections that are dialled.
        listening: for incoming connections.
        own: the contents of the own certificate.
        roster: the last known roster; None: none.
        roster_text: the same roster with its signature.

    Raises:
        PancakesError: a file is missing, cannot be used, or others can read the key; the message names it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stamp = self._look()
        self.dialling = _context(ssl.PROTOCOL_TLS_CLIENT, folder)
        self.listening = _context(ssl.PROTOCOL_TLS_SERVER, folder)
        try:
            self.own = certificate_shown(_shown_to_itself(self.listening, folder))
        except (ssl.SSLError, ValueError):
            raise PancakesError(
                f"the key {folder / KEY} cannot be used in the fleet of {folder / FLEET}: the authority of that fleet"
                " has not signed its certificate"
            ) from None

        self.roster, self.roster_text = _kept(folder / ROSTER)

    def _look(self) -> tuple[int, ...]:
        """Return a mark that changes when the files are replaced.

        Raises:
            PancakesError: the key is missing, or others can read it.
        """
        check_private(self.folder / KEY)
        found = [(self.folder / file).stat() for file in (KEY, FLEET) if (self.folder / file).exists()]
        return tuple(number for it in found for number in (it.st_ino, it.st_mtime_ns))

    def reload(self, dry_run: bool = False) -> bool:
        """Take the key that is in the folder now; return whether it is a new one.

        Args:
            dry_run: only check whether there is a new one.

        Raises:
            PancakesError: it cannot be used, or belongs to another. The old one stays in use; the next call does not
                report it again.
        """
        stamp = self._look()
        if stamp == self._stamp:
            return False
        if not dry_run:
            self._stamp = stamp
        new = Keys(self.folder)
        if (new.own.fleet, new.own.role, new.own.name) != (self.own.fleet, self.own.role, self.own.name):
            raise PancakesError(
                f"the new key in {self.folder} is of {new.own.name} ({new.own.role}) in the fleet {new.own.fleet}: the"
                f" old one, of {self.own.name}, stays in use"
            )
        is_new = new.own != self.own  # the fleet's certificate is written before the key, and is seen first
        if not dry_run:
            self.dialling, self.listening, self.own = new.dialling, new.listening, new.own
        return is_new

    def fault_of(self, shown: Certified) -> str:
        """Return why a certificate of the authority is not trusted, as a clause; empty: it is."""
        return fault_of_certified(shown, self.own.fleet, self.roster, wall_ns() / 1e9)

    def fault_of_roster(self, new: Roster) -> str:
        """Return why a roster must not be taken, as a sentence; empty: it may, if it was signed."""
        return fault_of_news(new, self.roster, self.own.fleet, wall_ns() / 1e9)

    def learn(self, roster: Roster, text: bytes) -> bool:
        """Take a roster whose signature has been checked; return whether it is newer."""
        if self.fault_of_roster(roster):
            return False
        self.roster, self.roster_text = roster, text
        return True


def _kept(path: Path) -> tuple[Roster | None, bytes]:
    """Return the roster in the key folder. It was checked when it was put there, and is trusted like the keys."""
    try:
        text = read_plain(path)
        return read_signed(text)[1], text
    except FileNotFoundError:
        return None, b""
    except OSError as error:
        raise PancakesError(f"the roster {path} cannot be used: {error.strerror or error}") from None
    except ValueError as error:
        raise PancakesError(f"the roster {path} cannot be used: {error}: remove it") from None


def certificate_shown(side: ssl.SSLObject) -> Certified:
    """Return the contents of the certificate that the other side has shown.

    Raises:
        ValueError: it is not a certificate of a fleet; the message says why, as a clause.
    """
    shown = side.getpeercert() or {}
    try:
        return certified(shown, float(ssl.cert_time_to_seconds(str(shown["notAfter"]))))
    except KeyError as error:
        raise ValueError(f"its certificate lacks {error}") from None


def _context(protocol: int, folder: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the name is in the certificate's URI, and the hello is compared with it
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(int(context.verify_flags) | _NO_CHECK_TIME)
    for file, load in ((FLEET, context.load_verify_locations), (KEY, context.load_cert_chain)):
        path = folder / file
        try:
            check_plain(path)
            load(path)
        except ssl.SSLError as error:
            raise PancakesError(f"the key file {path} cannot be used: {(error.reason or str(error)).lower()}") from None
        except OSError as error:
            raise PancakesError(f"the key file {path} cannot be used: {error.strerror or error}") from None
    if protocol == ssl.PROTOCOL_TLS_SERVER:
        context.num_tickets = 0  # a peer that reconnects shows its certificate again
    return context


def _shown_to_itself(listening: ssl.SSLContext, folder: Path) -> ssl.SSLObject:
    """Return the listening side of a handshake with itself: Python reads only certificates that were shown.

    Raises:
        ssl.SSLError: the key would not be accepted.
    """
    dialling = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    dialling.check_hostname = False
    dialling.verify_mode = ssl.CERT_NONE  # a person's certificate is only for dialling
    dialling.load_cert_chain(folder / KEY)
    to_listener, to_dialler = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = (
        dialling.wrap_bio(to_dialler, to_listener),
        listening.wrap_bio(to_listener, to_dialler, server_side=True),
    )
    for side in (*sides, *sides):
        try:
            side.do_handshake()
        except ssl.SSLWantReadError:
            continue
    return sides[1]


def check_private(path: Path) -> None:
    """Check that no other user can read a private key.

    Raises:
        PancakesError: another user can, or it is missing; the message says what to do.
    """
    try:
        found = path.lstat()
    except OSError as error:
        raise PancakesError(f"the key {path} cannot be used: {(error.strerror or str(error)).lower()}") from None
    if not stat.S_ISREG(found.st_mode):
        raise PancakesError(f"the key {path} is not a file")
    folder = path.parent.stat()
    if folder.st_mode & 0o022 or folder.st_uid not in (0, os.getuid()):
        raise PancakesError(f"others can put files into the key folder {path.parent}: chmod 700 it")
    if found.st_uid != os.getuid():
        raise PancakesError(f"the key {path} belongs to another user (uid {found.st_uid})")
    if found.st_mode & 0o077:
        raise PancakesError(
            f"the key {path} can be read by others (mode {stat.S_IMODE(found.st_mode):o}): chmod 600 it"
        )
