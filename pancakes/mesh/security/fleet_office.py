"""What an operator does for a fleet: who belongs to it, who does no more, and what is signed of that."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric import ec
from msgspec.structs import replace

from pancakes.errors import PancakesError
from pancakes.mesh.security.authority import Authority, new_key, pem_of_key
from pancakes.mesh.security.certified import CertifiedRole
from pancakes.mesh.security.key_files import FLEET, ROSTER, KeyFiles, write_private
from pancakes.mesh.security.register import Entry, Register, read_register, write_register
from pancakes.mesh.security.roster import LATEST_S, Revoked, Roster
from pancakes.mesh.security.rules import AccessRule
from pancakes.mesh.security.rules_file import add_rule, begin_rules, read_rules
from pancakes.runtime.clock import wall_ns
from pancakes.runtime.foundation.plain_file import read_plain


class FleetOffice:
    """The authority of a fleet and its register, in the operator's folder.

    Args:
        folder: the folder.
        authority: its authority.
    """

    def __init__(self, folder: Path, authority: Authority) -> None:
        self.folder = folder
        self.fleet = authority.fleet
        self._authority = authority
        self._register = read_register(folder)

    @classmethod
    def founded(cls, fleet: str, folder: Path, password: bytes | None = None) -> FleetOffice:
        """Founds a fleet.

        Raises:
            PancakesError: there is one in that folder already.
        """
        office = cls(folder, Authority.founded(fleet, folder, password))
        begin_rules(folder)
        office.sign()
        return office

    @classmethod
    def opened(cls, folder: Path, password: bytes | None = None) -> FleetOffice:
        """Opens the folder of a fleet.

        Raises:
            PancakesError: there is none, or the password does not fit.
        """
        return cls(folder, Authority(folder, password))

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All certificates that were given out, the oldest first."""
        return self._register.entries

    def check_new(self, name: str) -> None:
        """Checks that a name is free.

        Raises:
            PancakesError: it is borne already.
        """
        self._register.check_new(name, self.fleet)

    def enrol(
        self,
        key: ec.EllipticCurvePublicKey,
        role: CertifiedRole,
        name: str,
        groups: Sequence[str] = (),
        came_from: str = "",
        days: float | None = None,
    ) -> KeyFiles:
        """Certifies a key, and enters that; returns the contents of its folder, without the private key."""
        given = self._authority.certify(key, role, name, groups, days)
        entry = Entry(name, role, tuple(groups), given.serial, wall_ns() / 1e9, given.ends_s, came_from)
        self._keep(replace(self._register, entries=(*self._register.entries, entry)))
        authority, roster = read_plain(self.folder / FLEET), read_plain(self.folder / ROSTER)
        return KeyFiles(self.fleet, role, name, given.pem, authority, roster)

    def enrol_with_key(
        self, role: CertifiedRole, name: str, groups: Sequence[str] = (), days: float | None = None
    ) -> KeyFiles:
        """Makes a key and certifies it; returns the contents of its folder."""
        key = new_key()
        return self.enrol(key.public_key(), role, name, groups, days=days)._replace(key=pem_of_key(key))

    def latest(self, who: str) -> Entry:
        """Returns the newest certificate of a bearer that is believed; `who` is `NAME` or `ROLE/NAME`.

        Raises:
            PancakesError: there is none.
        """
        return self._register.latest(who, self.fleet)

    def revoke(self, who: str, why: str, force: bool = False) -> list[Entry]:
        """Revokes all certificates of a bearer, and signs that.

        Raises:
            PancakesError: there is none, or the roster cannot be signed.
        """
        self.latest(who)
        gone = self._register.of(who)
        kept = tuple(replace(it, revoked=why) if it in gone else it for it in self._register.entries)
        self.sign(force, replace(self._register, entries=kept))
        return gone

    def allow(self, rule: AccessRule, force: bool = False) -> Roster:
        """Adds a rule, and signs that.

        Raises:
            PancakesError: the rules are not sound, or the roster cannot be signed.
        """
        add_rule(self.folder, rule)
        return self.sign(force)

    def sign(self, force: bool = False, register: Register | None = None) -> Roster:
        """Signs a new roster.

        Args:
            force: whether it is to be believed whatever its date.
            register: the register that it is made of; None: as it stands.

        Raises:
            PancakesError: the clock of this machine, or that of the last signing, is not believed; or it is too large.
        """
        now = register or self._register
        now_s = wall_ns() / 1e9
        if now.number and abs(now_s - now.signed_s) > LATEST_S and not force:
            last, here = (datetime.datetime.fromtimestamp(it).strftime("%d %B %Y") for it in (now.signed_s, now_s))
            raise PancakesError(
                f"the last roster was signed on {last}, and by the clock of this machine it is {here}. Set that clock,"
                " or, where it is right, say --any-date"
            )
        revoked = tuple(Revoked(it.serial, it.who, it.revoked) for it in now.entries if it.revoked)
        roster = Roster(self.fleet, now.number + 1, now_s, revoked, read_rules(self.folder), force)
        text = self._authority.signed(roster)
        self._keep(replace(now, number=roster.number, signed_s=now_s))
        write_private(self.folder / ROSTER, text)
        if (self.folder / "me").is_dir():
            write_private(self.folder / "me" / ROSTER, text)
        return roster

    def _keep(self, register: Register) -> None:
        write_register(self.folder, register)
        self._register = register
