"""How a page is served beyond the loopback interface: its address, names, password and certificate."""

from __future__ import annotations

import ipaddress
import os
import socket
import ssl
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError
from pancakes.tools.web.sign_in import fault_of_password

LARGEST_FILE: Final = 4096
WILDCARDS: Final = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Exposure:
    """How a page is served beyond the loopback interface.

    Attributes:
        host: the address or name at which to listen.
        password: the password of the page.
        names: further host names under which browsers may open the page.
        certificate: the file of a certificate, with its chain; None: without TLS.
        key: the file of its private key; None: it is in the same file.
    """

    host: str
    password: str
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    def all_names(self) -> frozenset[str]:
        """Return the host names under which browsers may open the page, in lower case."""
        own = socket.gethostname()
        return frozenset(
            name.lower().rstrip(".") for name in (own, f"{own}.local", "localhost", self.host, *self.names)
        )

    def shown_name(self) -> str:
        """Return the name in the address for people: of the machine, if the page listens at all its addresses."""
        name = socket.gethostname() if self.host in WILDCARDS else self.host
        return f"[{name}]" if ":" in name else name

    def tls(self) -> ssl.SSLContext | None:
        """Return what TLS needs; None: without TLS.

        Raises:
            PancakesError: the certificate or key cannot be used.
        """
        if self.certificate is None:
            return None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            # No prompt: a key with a pass phrase is an error.
            context.load_cert_chain(self.certificate, self.key, password=lambda: b"")
        except (OSError, ValueError) as error:
            files = f"{self.certificate}" + (f" and {self.key}" if self.key is not None else "")
            why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise PancakesError(f"the page cannot use the certificate in {files}: {why}") from None
        return context


def is_loopback(host: str) -> bool:
    """Return whether an address or name is of the loopback interface only."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def password_in(path: Path) -> str:
    """Return the password in a file: its first line.

    Raises:
        PancakesError: the file cannot be read, other users can read it, or no page can have such a password.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            data = file.read(LARGEST_FILE)
    except OSError as error:
        raise PancakesError(f"the password cannot be read from {path}: {error.strerror}") from None
    if stat.S_ISREG(mode) and mode & 0o077:
        raise PancakesError(f"other users can read the password in {path}: chmod 600 {path}")
    try:
        password = next(iter(data.decode().splitlines()), "")
    except UnicodeDecodeError:
        raise PancakesError(f"the password in {path} is not text in UTF-8") from None
    return checked_password(password)


def checked_password(password: str) -> str:
    """Return a password.

    Raises:
        PancakesError: no page can have such a password.
    """
    fault = fault_of_password(password)
    if fault:
        raise PancakesError(fault)
    return password


def checked_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return host names.

    Raises:
        PancakesError: one is not a host name, such as an address with a scheme or port.
    """
    kept = tuple(names)
    for name in kept:
        if not name or not all(letter.isalnum() or letter in ".-_" for letter in name) or not name.isascii():
            raise PancakesError(f"{name!r} is not a host name: write it without scheme and port, such as robot1.lab")
    return kept
