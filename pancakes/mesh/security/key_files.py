"""What lies in a folder with keys."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final, NamedTuple

from pancakes.errors import PancakesError
from pancakes.mesh.security.roster import read_signed
from pancakes.runtime.foundation.plain_file import read_plain

KEY: Final = "key.pem"
"""The certificate of the bearer, and the private key."""
FLEET: Final = "fleet.pem"
"""The certificate of the fleet's authority, or of two while the fleet changes from one to another."""
ROSTER: Final = "roster.json"
"""The last roster of the fleet that is known."""


class KeyFiles(NamedTuple):
    """The contents of a folder with keys.

    Attributes:
        fleet: the fleet.
        role: what the bearer is.
        name: the bearer's name.
        certificate: the bearer's certificate, as PEM.
        authority: the certificate of the fleet's authority, as PEM.
        roster: the last roster.
        key: the private key, as PEM; empty where another machine has it.
    """

    fleet: str
    role: str
    name: str
    certificate: bytes
    authority: bytes
    roster: bytes
    key: bytes = b""

    def write(self, folder: Path) -> None:
        """Writes a folder with keys; the key last, so that it never stands beside an older fleet's certificate.

        A later roster that is there stays: what it revokes is not to be believed again.

        Raises:
            PancakesError: it cannot be written.
        """
        try:
            if number_of(folder / ROSTER) < _number(self.roster):
                write_private(folder / ROSTER, self.roster)
            write_private(folder / FLEET, self.authority)
            write_private(folder / KEY, self.certificate + self.key)
        except OSError as error:
            why = (error.strerror or str(error)).lower()
            raise PancakesError(f"the keys cannot be written to {folder}: {why}") from None

    def as_text(self) -> dict[str, str]:
        """Returns what travels to the machine that has the key."""
        return {
            name: value.decode() if isinstance(value, bytes) else value
            for name, value in self._asdict().items()
            if name != "key"
        }

    @classmethod
    def of_text(cls, text: dict[str, Any], key: bytes) -> KeyFiles:
        """Returns what has travelled, with the key that has not.

        Raises:
            KeyError, AttributeError: a part is missing, or is no text.
        """
        certificate, authority, roster = (text[name].encode() for name in ("certificate", "authority", "roster"))
        return cls(str(text["fleet"]), str(text["role"]), str(text["name"]), certificate, authority, roster, key)


def number_of(path: Path) -> int:
    """Returns the number of the roster in a file; 0 where there is none that can be read."""
    try:
        return _number(read_plain(path))
    except OSError:
        return 0


def _number(text: bytes) -> int:
    try:
        return read_signed(text)[1].number
    except ValueError:
        return 0


def write_private(path: Path, data: bytes) -> None:
    """Writes a file that its user alone can read, in a directory that is that user's alone: all of it or nothing.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    handle = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(handle, "wb") as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(aside, path)
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
