"""The operator's side of a fleet: issue and revoke certificates, and sign rosters. Needs `cryptography`.

`Authority` is the operator's folder of a fleet: the key that signs, the register of certificates, and the rules.
Commands import this module; a running agent never does.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from msgspec.structs import replace

from pancakes.errors import PancakesError
from pancakes.security.key_store import (
    FLEET,
    ROSTER,
    Entry,
    KeyFiles,
    Register,
    add_rule,
    begin_rules,
    read_register,
    read_rules,
    write_private,
    write_register,
)
from pancakes.security.roster import (
    LATEST_S,
    MOST_BYTES,
    PEOPLE,
    AccessRule,
    CertifiedRole,
    Revoked,
    Roster,
    SignedRoster,
    signed_bytes,
)
from pancakes.util import codecs
from pancakes.util.clock import wall_ns
from pancakes.util.files import read_plain

AUTHORITY: Final = "authority.key"
"""In the operator's folder: the authority's private key."""
PERSON_DAYS: Final = 90
"""How long a person's certificate is valid. An agent's has no end: an agent whose key ended would be lost."""

_FOREVER: Final = datetime.datetime(9999, 12, 31, 23, 59, 59, tzinfo=datetime.UTC)  # RFC 5280, 4.1.2.5
_BEGINNING: Final = datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC)
_PEM: Final = serialization.Encoding.PEM
_JSON: Final = codecs.json_encoder()
_LOCKED: Final = b"ENCRYPTED PRIVATE KEY"


class Issued(NamedTuple):
    """A certificate that was issued.

    Attributes:
        pem: the certificate.
        serial: its number, as a peer reads it.
        ends_s: when it ends, in seconds since 1970; None: never.
    """

    pem: bytes
    serial: str
    ends_s: float | None


class Authority:
    """The authority of a fleet, in the operator's folder: the key that signs, the register and the rules.

    Args:
        folder: the folder.
        password: the password of the key; None: the key is not locked.

    Raises:
        PancakesError: the folder has no authority, or the password is wrong.
    """

    def __init__(self, folder: Path, password: bytes | None = None) -> None:
        try:
            key = serialization.load_pem_private_key(read_plain(folder / AUTHORITY), password)
            certificate = x509.load_pem_x509_certificate(read_plain(folder / FLEET))
        except OSError as error:
            raise PancakesError(f"the authority in {folder} cannot be used: {error.strerror or error}") from None
        except (TypeError, ValueError):
            raise PancakesError(f"the authority in {folder} cannot be used: the password is wrong") from None
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        self.folder = folder
        self._key = key
        self._certificate = certificate
        self._register = read_register(folder)
        (name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        self.fleet = str(name.value)

    @classmethod
    def founded(cls, fleet: str, folder: Path, password: bytes | None = None) -> Authority:
        """Found a fleet: make its key, its first rules and its first roster.

        Raises:
            PancakesError: the folder has an authority already.
        """
        if (folder / AUTHORITY).exists():
            raise PancakesError(f"the fleet {fleet} has its authority in {folder} already")
        key = new_key()
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, fleet)])
        built = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(_BEGINNING)
            .not_valid_after(_FOREVER)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        )
        certificate = built.sign(key, hashes.SHA256())
        write_private(folder / AUTHORITY, pem_of_key(key, password))
        write_private(folder / FLEET, certificate.public_bytes(_PEM))
        authority = cls(folder, password)
        begin_rules(folder)
        authority.sign()
        return authority

    @property
    def entries(self) -> tuple[Entry, ...]:
        """All issued certificates, the oldest first."""
        return self._register.entries

    def check_new(self, name: str) -> None:
        """Check that a name is free.

        Raises:
            PancakesError: the name is taken.
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
        """Certify a key and register it; return the contents of its folder, without the private key."""
        given = self.certify(key, role, name, groups, days)
        entry = Entry(name, role, tuple(groups), given.serial, wall_ns() / 1e9, given.ends_s, came_from)
        self._keep(replace(self._register, entries=(*self._register.entries, entry)))
        authority, roster = read_plain(self.folder / FLEET), read_plain(self.folder / ROSTER)
        return KeyFiles(self.fleet, role, name, given.pem, authority, roster)

    def enrol_with_key(
        self, role: CertifiedRole, name: str, groups: Sequence[str] = (), days: float | None = None
    ) -> KeyFiles:
        """Make a key and certify it; return the contents of its folder."""
        key = new_key()
        return self.enrol(key.public_key(), role, name, groups, days=days)._replace(key=pem_of_key(key))

    def latest(self, who: str) -> Entry:
        """Return the newest valid certificate of a bearer; `who` is `NAME` or `ROLE/NAME`.

        Raises:
            PancakesError: the bearer has none.
        """
        return self._register.latest(who, self.fleet)

    def revoke(self, who: str, why: str, force: bool = False) -> list[Entry]:
        """Revoke all certificates of a bearer, and sign a new roster.

        Raises:
            PancakesError: the bearer has none, there is no reason, or the roster cannot be signed.
        """
        if not why.strip():
            raise PancakesError("a revocation needs a reason, for those who read the register later")
        self.latest(who)
        gone = self._register.of(who)
        kept = tuple(replace(it, revoked=why) if it in gone else it for it in self._register.entries)
        self.sign(force, replace(self._register, entries=kept))
        return gone

    def allow(self, rule: AccessRule, force: bool = False) -> Roster:
        """Add a rule, and sign a new roster.

        Raises:
            PancakesError: the rules are not valid, or the roster cannot be signed.
        """
        add_rule(self.folder, rule)
        return self.sign(force)

    def sign(self, force: bool = False, register: Register | None = None) -> Roster:
        """Sign a new roster.

        Args:
            force: whether agents must accept it whatever its date.
            register: the register for it; None: the present one.

        Raises:
            PancakesError: the clock of this machine, or that of the last signing, seems wrong; or the roster is too
                large.
        """
        now = register or self._register
        now_s = wall_ns() / 1e9
        if now.number and abs(now_s - now.signed_s) > LATEST_S and not force:
            last, here = (datetime.datetime.fromtimestamp(it).strftime("%d %B %Y") for it in (now.signed_s, now_s))
            raise PancakesError(
                f"the last roster was signed on {last}, and by the clock of this machine it is {here}. Set that clock,"
                " or pass --any-date if it is right"
            )
        revoked = tuple(Revoked(it.serial, it.who, it.revoked) for it in now.entries if it.revoked)
        roster = Roster(self.fleet, now.number + 1, now_s, revoked, read_rules(self.folder), force)
        text = self.signed(roster)
        self._keep(replace(now, number=roster.number, signed_s=now_s))
        write_private(self.folder / ROSTER, text)
        if (self.folder / "me").is_dir():
            write_private(self.folder / "me" / ROSTER, text)
        return roster

    def _keep(self, register: Register) -> None:
        write_register(self.folder, register)
        self._register = register

    def certify(
        self,
        public_key: ec.EllipticCurvePublicKey,
        role: CertifiedRole,
        name: str,
        groups: Sequence[str] = (),
        days: float | None = None,
    ) -> Issued:
        """Return a certificate for a key.

        Args:
            public_key: the key.
            role: its bearer's role.
            name: its bearer's name.
            groups: the groups by which rules may name its bearer.
            days: how long it is valid; None: the usual time for the role.
        """
        if days is None and role in PEOPLE:
            days = PERSON_DAYS
        now = datetime.datetime.fromtimestamp(wall_ns() / 1e9, datetime.UTC)
        end = _FOREVER if days is None else now + datetime.timedelta(days=days)
        uris = [
            f"pancakes://{self.fleet}/{role}/{name}",
            *(f"pancakes://{self.fleet}/group/{group}" for group in groups),
        ]
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role not in PEOPLE:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        serial = x509.random_serial_number()
        built = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
            .issuer_name(self._certificate.subject)
            .public_key(public_key)
            .serial_number(serial)
            .not_valid_before(_BEGINNING)
            .not_valid_after(end)
            .add_extension(
                x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri) for uri in uris]), critical=True
            )
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        )
        pem = built.sign(self._key, hashes.SHA256()).public_bytes(_PEM)
        digits = 2 * ((serial.bit_length() + 7) // 8)  # as `ssl` prints it: an even number of hexadecimal digits
        return Issued(pem, f"{serial:0{digits}X}", None if days is None else end.timestamp())

    def signed(self, roster: Roster) -> bytes:
        """Return a signed roster.

        Raises:
            PancakesError: it is too large.
        """
        payload = _JSON(roster).decode()
        signature = self._key.sign(signed_bytes(payload), ec.ECDSA(hashes.SHA256()))
        text = _JSON(SignedRoster(payload, signature.hex()))
        if len(text) > MOST_BYTES:
            raise PancakesError(
                f"the roster of the fleet {self.fleet} would have {len(text)} bytes, and at most {MOST_BYTES} may be:"
                " too many certificates are revoked, so it is time for a new authority"
            )
        return text


def is_locked(directory: Path) -> bool:
    """Return whether the key of the authority in a directory needs a password.

    Raises:
        PancakesError: it has no authority.
    """
    try:
        return _LOCKED in read_plain(directory / AUTHORITY)
    except OSError as error:
        raise PancakesError(f"the authority in {directory} cannot be used: {error.strerror or error}") from None


def signed_by(authorities: Path, signed: SignedRoster) -> bool:
    """Return whether a roster was signed by the authority of a fleet, or by one of its two.

    Args:
        authorities: the file with their certificates.
        signed: the roster.

    Raises:
        PancakesError: the file cannot be read.
    """
    try:
        certificates = x509.load_pem_x509_certificates(read_plain(authorities))
        signature = bytes.fromhex(signed.signature)
    except OSError as error:
        raise PancakesError(f"{authorities} cannot be read: {error.strerror or error}") from None
    except ValueError:
        return False
    for certificate in certificates:
        key = certificate.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey)
        try:
            key.verify(signature, signed_bytes(signed.payload), ec.ECDSA(hashes.SHA256()))
        except InvalidSignature:
            continue
        return True
    return False


def new_key() -> ec.EllipticCurvePrivateKey:
    """Make a private key: P-256, which secure elements and TPMs have too."""
    return ec.generate_private_key(ec.SECP256R1())


def pem_of_key(key: ec.EllipticCurvePrivateKey, password: bytes | None = None) -> bytes:
    """Return a private key as PEM, locked with a password if there is one."""
    lock = serialization.BestAvailableEncryption(password) if password else serialization.NoEncryption()
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, lock)


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
