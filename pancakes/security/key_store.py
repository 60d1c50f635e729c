"""Read and write key folders: their paths and files, and the operator's register and access rules.

The folder of an agent or a person has its certificate and private key, the certificate of the authority, and the last
roster. No configuration names a key: the fleet and the name of an agent determine its folder. The operator's folder
of a fleet also has the register of issued certificates and the rules that the operator edits. Files are written
atomically, for their user only. Needs neither OpenSSL nor `cryptography`.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from pancakes.errors import PancakesError
from pancakes.security.roster import DEFAULT, EVERY, AccessRule, CertifiedRole, read_signed
from pancakes.settings import check_settings
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED
from pancakes.util.files import NoHome, read_plain, user_folder
from pancakes.util.toml import toml_values

KEY: Final = "key.pem"
"""The certificate of the bearer, and the private key."""
FLEET: Final = "fleet.pem"
"""The certificate of the fleet's authority, or of two while the fleet changes from one to another."""
ROSTER: Final = "roster.json"
"""The last known roster of the fleet."""


class KeyFiles(NamedTuple):
    """The contents of a key folder.

    Attributes:
        fleet: the fleet.
        role: the bearer's role.
        name: the bearer's name.
        certificate: the bearer's certificate, as PEM.
        authority: the certificate of the fleet's authority, as PEM.
        roster: the last roster.
        key: the private key, as PEM; empty if another machine has it.
    """

    fleet: str
    role: str
    name: str
    certificate: bytes
    authority: bytes
    roster: bytes
    key: bytes = b""

    def write(self, folder: Path) -> None:
        """Write a key folder; the key last, so that it is never beside an older fleet's certificate.

        A later roster in the folder stays, so that what it revokes stays revoked.

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
        """Return what is sent to the machine that has the private key."""
        return {
            name: value.decode() if isinstance(value, bytes) else value
            for name, value in self._asdict().items()
            if name != "key"
        }

    @classmethod
    def of_text(cls, text: dict[str, Any], key: bytes) -> KeyFiles:
        """Return the received contents together with the private key.

        Raises:
            KeyError, AttributeError: a part is missing or is not text.
        """
        certificate, authority, roster = (text[name].encode() for name in ("certificate", "authority", "roster"))
        return cls(str(text["fleet"]), str(text["role"]), str(text["name"]), certificate, authority, roster, key)


def number_of(path: Path) -> int:
    """Return the number of the roster in a file; 0 if it is missing or cannot be read."""
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
    """Write a file that only its user can read, in a directory of only that user, completely or not at all.

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


_OF_SERVICES: Final = Path("/etc/pancakes/keys")


def folder_of_agent(fleet: str, name: str) -> Path:
    """Return the key folder of an agent, for this user.

    Raises:
        NoHome: it is not known where.
    """
    base = user_folder("XDG_DATA_HOME", ".local/share", f"the key of {name}")
    return base / "pancakes" / "keys" / fleet / name


def keys_of_agent(fleet: str, name: str) -> Path | None:
    """Return the key folder of an agent, of this user or else of the machine; None if it has no keys."""
    places = [_OF_SERVICES / fleet / name]
    with suppress(NoHome):  # then this user has no keys
        places.insert(0, folder_of_agent(fleet, name))
    return next((it for it in places if os.path.lexists(it / KEY)), None)


def fleets() -> Path:
    """Return the directory of this person's fleets: their keys, and the authorities of fleets founded here.

    Raises:
        NoHome: it is not known where.
    """
    return user_folder("XDG_CONFIG_HOME", ".config", "the fleets of this person") / "pancakes" / "fleets"


def folder_of_person(fleet: str) -> Path:
    """Return this person's key folder for a fleet.

    Raises:
        NoHome: it is not known where.
    """
    return fleets() / fleet / "me"


def keys_of_person(fleet: str) -> Path | None:
    """Return this person's key folder for a fleet; None if this person has no keys for it."""
    try:
        own = folder_of_person(fleet)
    except NoHome:
        return None
    return own if os.path.lexists(own / KEY) else None


def fleets_of_person() -> list[str]:
    """Return the fleets for which this person has keys, by name."""
    try:
        return sorted(it.name for it in fleets().iterdir() if keys_of_person(it.name))
    except (OSError, NoHome):
        return []


def rosters_here() -> dict[str, int]:
    """Return the number of the last roster of each fleet in this person's folders."""
    try:
        folders = sorted(it for it in fleets().iterdir() if it.is_dir())
    except (OSError, NoHome):
        return {}
    return {it.name: max(number_of(it / ROSTER), number_of(it / "me" / ROSTER)) for it in folders}


REGISTER: Final = "register.json"


class Entry(msgspec.Struct, frozen=True):
    """A certificate that was issued.

    Attributes:
        name: its bearer's name.
        role: its bearer's role.
        groups: its bearer's groups.
        serial: its number.
        given_s: when it was issued, in seconds since 1970.
        ends_s: when it ends, in seconds since 1970; None: never.
        came_from: the address from which the machine joined; empty: its folder was copied.
        revoked: why it was revoked; empty: it is valid.
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
        """Its bearer: `ROLE/NAME`."""
        return f"{self.role}/{self.name}"


class Register(msgspec.Struct, frozen=True):
    """All certificates of a fleet.

    Attributes:
        entries: the certificates, the oldest first.
        number: the number of the last signed roster.
        signed_s: when that roster was signed, in seconds since 1970.
    """

    entries: tuple[Entry, ...] = ()
    number: int = 0
    signed_s: float = 0.0

    def of(self, who: str) -> list[Entry]:
        """Return the valid certificates of a bearer; `who` is `NAME` or `ROLE/NAME`."""
        return [it for it in self.entries if not it.revoked and who in (it.name, it.who)]

    def check_new(self, name: str, fleet: str) -> None:
        """Check that a name is free in a fleet.

        Raises:
            PancakesError: it is taken.
        """
        for it in self.of(name):
            raise PancakesError(
                f"{it.who} belongs to the fleet {fleet} already: renew it with pancakes keys renew {name}, or revoke"
                " it first"
            )

    def latest(self, who: str, fleet: str) -> Entry:
        """Return the newest valid certificate of a bearer; `who` is `NAME` or `ROLE/NAME`.

        Raises:
            PancakesError: the bearer has none.
        """
        found = self.of(who)
        if not found:
            raise PancakesError(f"the register of the fleet {fleet} has no {who}: see pancakes keys list")
        return found[-1]


_ENCODE: Final = codecs.json_encoder()
_DECODE: Final = codecs.json_decoder(Register)


def read_register(folder: Path) -> Register:
    """Read the register of a fleet; a missing one is empty.

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
        raise PancakesError(f"the register {path} is damaged: {error}. Restore a copy of it") from None


def write_register(folder: Path, register: Register) -> None:
    """Write the register of a fleet."""
    write_private(folder / REGISTER, msgspec.json.format(_ENCODE(register)))


RULES: Final = "rules.toml"
_HEAD: Final = """\
# What the members of this fleet may do. What no rule allows is refused; the order does not matter.
# After a change: pancakes keys sign. The rights, and what they are for, are in docs/security.md.
"""


class _Access(msgspec.Struct, forbid_unknown_fields=True):
    allow: tuple[AccessRule, ...] = ()


class _File(msgspec.Struct, forbid_unknown_fields=True):
    access: _Access


def read_rules(folder: Path) -> tuple[AccessRule, ...]:
    """Read the rules of a fleet.

    Raises:
        PancakesError: the file cannot be read, or is not valid.
    """
    path = folder / RULES
    try:
        values = toml_values(read_plain(path).decode())
        faults = check_settings(_File, values)
        if not faults:
            return codecs.convert(values, _File).access.allow
    except OSError as error:
        raise PancakesError(f"the rules {path} cannot be read: {error.strerror or error}") from None
    except (*MALFORMED, ValueError) as error:
        raise PancakesError(f"the rules {path} are not valid: {error}") from None
    raise PancakesError(f"the rules {path} are not valid: {'; '.join(map(str, faults))}")


def begin_rules(folder: Path) -> None:
    """Write the rules of a new fleet."""
    write_private(folder / RULES, (_HEAD + "".join(map(_text, DEFAULT))).encode())


def add_rule(folder: Path, rule: AccessRule) -> None:
    """Add a rule at the end of the file; its other text is kept.

    Raises:
        PancakesError: the file cannot be read, or is not valid.
    """
    read_rules(folder)
    path = folder / RULES
    write_private(path, read_plain(path).rstrip(b"\n") + b"\n" + _text(rule).encode())


def _text(rule: AccessRule) -> str:
    lines = ["", "[[access.allow]]"]
    for key in ("who", "may", "on", "at"):
        values = getattr(rule, key)
        if key in ("who", "may") or values != (EVERY,):
            lines.append(f"{key} = {_LIST(list(values)).decode()}")
    return "\n".join(lines) + "\n"


_LIST: Final = codecs.json_encoder()
