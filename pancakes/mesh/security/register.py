"""The register of a fleet: which certificates its authority has given out, in the operator's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.security.certified import CertifiedRole
from pancakes.mesh.security.key_files import write_private
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.malformed import MALFORMED
from pancakes.runtime.foundation.plain_file import read_plain

REGISTER: Final = "register.json"


class Entry(msgspec.Struct, frozen=True):
    """A certificate that was given out.

    Attributes:
        name: its bearer's name.
        role: what its bearer is.
        groups: its bearer's groups.
        serial: its number.
        given_s: when it was given out, in seconds since 1970.
        ends_s: when it ends, likewise; None: it has no end.
        came_from: where the machine joined from; empty: it was given a folder.
        revoked: why it is believed no more; empty: it is believed.
    """

    name: str
    role: CertifiedRole
    groups: tuple[str, ...]
    serial: str
    given_s: float
    ends_s: float | None = None
    came_from: str = ""
    revoked: str = ""

    @property
    def who(self) -> str:
        """Whose it is: `ROLE/NAME`."""
        return f"{self.role}/{self.name}"


class Register(msgspec.Struct, frozen=True):
    """All certificates of a fleet.

    Attributes:
        entries: the certificates, the oldest first.
        number: of the last roster that was signed.
        signed_s: when that was, in seconds since 1970.
    """

    entries: tuple[Entry, ...] = ()
    number: int = 0
    signed_s: float = 0.0

    def of(self, who: str) -> list[Entry]:
        """Returns the certificates of a bearer that are believed; `who` is `NAME` or `ROLE/NAME`."""
        return [it for it in self.entries if not it.revoked and who in (it.name, it.who)]

    def check_new(self, name: str, fleet: str) -> None:
        """Checks that a name is free in a fleet.

        Raises:
            PancakesError: it is borne already.
        """
        for it in self.of(name):
            raise PancakesError(
                f"{it.who} belongs to the fleet {fleet} already: renew it with pancakes fleet renew {name}, or revoke"
                " it first"
            )

    def latest(self, who: str, fleet: str) -> Entry:
        """Returns the newest certificate of a bearer that is believed; `who` is `NAME` or `ROLE/NAME`.

        Raises:
            PancakesError: there is none.
        """
        found = self.of(who)
        if not found:
            raise PancakesError(f"the register of the fleet {fleet} has no {who}: see pancakes fleet list")
        return found[-1]


_ENCODE: Final = codecs.json_encoder()
_DECODE: Final = codecs.json_decoder(Register)


def read_register(folder: Path) -> Register:
    """Reads the register of a fleet; empty where there is none.

    Raises:
        PancakesError: it cannot be read.
    """
    path = folder / REGISTER
    try:
        return _DECODE(read_plain(path))
    except FileNotFoundError:
        return Register()
    except OSError as error:
        raise PancakesError(f"the register {path} cannot be read: {error.strerror or error}") from None
    except MALFORMED as error:
        raise PancakesError(f"the register {path} is damaged: {error}. Put back a copy of it") from None


def write_register(folder: Path, register: Register) -> None:
    """Writes the register of a fleet."""
    write_private(folder / REGISTER, msgspec.json.format(_ENCODE(register)))
