"""A fleet's own authority: it makes and signs certificates. Commands import it, a running agent never does."""

from __future__ import annotations

import datetime
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from pancakes.errors import PancakesError
from pancakes.mesh.security.certified import PEOPLE, CertifiedRole
from pancakes.mesh.security.key_folders import FLEET, KEY

AUTHORITY_KEY: Final = "authority.key"
PERSON_DAYS: Final = 90
"""So long a person's certificate is good; that of an agent has no end: one whose key ended would be lost."""

_FOREVER: Final = datetime.datetime(9999, 12, 31, 23, 59, 59, tzinfo=datetime.UTC)  # RFC 5280, 4.1.2.5
_BEGINNING: Final = datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC)
_PEM: Final = serialization.Encoding.PEM


class Authority:
    """The key and the certificate that sign for a fleet, in a directory of the operator's.

    Args:
        directory: where they are.
        password: what the key is locked with; None: nothing.

    Raises:
        PancakesError: they are not there, or the password does not fit.
    """

    def __init__(self, directory: Path, password: bytes | None = None) -> None:
        try:
            key = serialization.load_pem_private_key((directory / AUTHORITY_KEY).read_bytes(), password)
            certificate = x509.load_pem_x509_certificate((directory / FLEET).read_bytes())
        except OSError as error:
            raise PancakesError(f"the authority in {directory} cannot be used: {error.strerror or error}") from None
        except (TypeError, ValueError):
            raise PancakesError(f"the authority in {directory} cannot be used: that is not its password") from None
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        self.directory = directory
        self._key = key
        self._certificate = certificate
        (name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        self.fleet = str(name.value)

    @classmethod
    def founded(cls, fleet: str, directory: Path, password: bytes | None = None) -> Authority:
        """Makes the authority of a new fleet.

        Raises:
            PancakesError: there is one in that directory already.
        """
        if (directory / AUTHORITY_KEY).exists():
            raise PancakesError(f"the fleet {fleet} has its authority in {directory} already")
        key = ec.generate_private_key(ec.SECP256R1())
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
        write_private(directory / AUTHORITY_KEY, _pem(key, password))
        write_private(directory / FLEET, certificate.public_bytes(_PEM))
        return cls(directory, password)

    def certify(
        self,
        public_key: ec.EllipticCurvePublicKey,
        role: CertifiedRole,
        name: str,
        groups: Sequence[str] = (),
        days: float | None = None,
    ) -> bytes:
        """Returns a certificate of a key, as PEM.

        Args:
            public_key: the key.
            role: what its bearer is.
            name: its bearer's name.
            groups: by which rules may name its bearer.
            days: how long it is good; None: as long as is usual for the role.
        """
        if days is None and role in PEOPLE:
            days = PERSON_DAYS
        now = datetime.datetime.now(datetime.UTC)
        end = _FOREVER if days is None else now + datetime.timedelta(days=days)
        uris = [
            f"pancakes://{self.fleet}/{role}/{name}",
            *(f"pancakes://{self.fleet}/group/{group}" for group in groups),
        ]
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role not in PEOPLE:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        built = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
            .issuer_name(self._certificate.subject)
            .public_key(public_key)
            .serial_number(x509.random_serial_number())
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
        return built.sign(self._key, hashes.SHA256()).public_bytes(_PEM)

    def enrol(
        self, directory: Path, role: CertifiedRole, name: str, groups: Sequence[str] = (), days: float | None = None
    ) -> Path:
        """Makes a key and its certificate, as one folder that may be copied; returns the folder."""
        key = ec.generate_private_key(ec.SECP256R1())
        write_private(directory / KEY, self.certify(key.public_key(), role, name, groups, days) + _pem(key, None))
        write_private(directory / FLEET, self._certificate.public_bytes(_PEM))
        return directory


def write_private(path: Path, data: bytes) -> None:
    """Writes a file that its user alone can read, in a directory that is that user's alone."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(handle, "wb") as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(data)


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


def _pem(key: ec.EllipticCurvePrivateKey, password: bytes | None) -> bytes:
    lock = serialization.BestAvailableEncryption(password) if password else serialization.NoEncryption()
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, lock)
