"""Enrol a machine in a fleet with a code: the machine makes its own key, which never travels. Needs `cryptography`.

The code has the address of the operator's machine, 120 bits of the hash of a certificate made for this one wait, and
a secret of 80 bits. The newcomer compares the hash before it sends the secret, so a machine in between learns
nothing. `Desk` waits at the operator's machine; `join` runs on the newcomer.
"""

from __future__ import annotations

import base64
import contextlib
import datetime
import hashlib
import hmac
import json
import secrets
import socket
import ssl
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from pancakes.errors import PancakesError
from pancakes.mesh.sockets import connect
from pancakes.security.authority import new_key, pem_of_key
from pancakes.security.key_store import KeyFiles, write_private
from pancakes.util.clock import MonotonicClock, wall_ns
from pancakes.util.codecs import plain_of
from pancakes.util.text import printable_line

OPEN_S: Final = 600.0
TRIES: Final = 5
PATIENCE_S: Final = 5.0
LOOK_S: Final = 0.2
MOST_BYTES: Final = 256 * 1024
_HASH_BYTES: Final = 15
_NO_REQUEST: Final = (OSError, ValueError, KeyError, TypeError, AttributeError, UnsupportedAlgorithm)
"""The errors of reading a stranger's request. They end the connection, and are not shown to the operator."""
_SECRET_BYTES: Final = 10
_PEM: Final = serialization.Encoding.PEM
_NO_CODE: Final = "is not a join code: copy all of it from the operator's terminal"

Certify = Callable[[ec.EllipticCurvePublicKey, str], KeyFiles]
"""Takes the newcomer's public key and address; returns the contents of its key folder, without the private key."""


class JoinCode(NamedTuple):
    """The join code, which is typed on the newcomer.

    Attributes:
        host: the operator's machine.
        port: the port at which it waits.
        pin: the beginning of the hash of its certificate.
        secret: the secret of the newcomer.
    """

    host: str
    port: int
    pin: bytes
    secret: bytes

    def __str__(self) -> str:
        text = base64.b32encode(self.pin + self.secret).decode().rstrip("=")
        return f"{self.host}:{self.port}/" + "-".join(text[at : at + 4] for at in range(0, len(text), 4))

    @classmethod
    def parse(cls, text: str) -> JoinCode:
        """Read a code.

        Raises:
            PancakesError: it is not a join code.
        """
        place, _, rest = text.strip().rpartition("/")
        host, _, port = place.rpartition(":")
        letters = rest.replace("-", "").upper()
        try:
            raw = base64.b32decode(letters + "=" * (-len(letters) % 8))
            number = int(port)
        except ValueError:
            raise PancakesError(f"{text!r} {_NO_CODE}") from None
        if len(raw) != _HASH_BYTES + _SECRET_BYTES or not host or not 0 < number < 65536:
            raise PancakesError(f"{text!r} {_NO_CODE}")
        return cls(host, number, raw[:_HASH_BYTES], raw[_HASH_BYTES:])


class Desk:
    """Wait for one newcomer, on the operator's machine.

    Args:
        host: the address at which the newcomer reaches this machine.
        port: the port to wait at; 0: a free port.
        open_s: how long to wait.

    Attributes:
        code: the join code.

    Raises:
        PancakesError: it cannot wait at this port.
    """

    def __init__(self, host: str, port: int, open_s: float) -> None:
        self._now = MonotonicClock().now
        self._until_s = self._now() + open_s
        key = new_key()
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "pancakes keys enrol")])
        now = datetime.datetime.fromtimestamp(wall_ns() / 1e9, datetime.UTC)
        shown = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .sign(key, hashes.SHA256())
        )
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.minimum_version = ssl.TLSVersion.TLSv1_3
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "key.pem"
            write_private(path, shown.public_bytes(_PEM) + pem_of_key(key))
            self._context.load_cert_chain(path)
        try:
            self._sock = socket.create_server(("", port))
        except OSError as error:
            raise PancakesError(f"cannot wait at port {port}: {(error.strerror or str(error)).lower()}") from None
        pin = hashlib.sha256(shown.public_bytes(serialization.Encoding.DER)).digest()[:_HASH_BYTES]
        self._lock = threading.Lock()
        self._tries = 0
        self._came_from = ""
        self._told = threading.Event()
        self._fault: PancakesError | None = None
        self.code = JoinCode(host, self._sock.getsockname()[1], pin, secrets.token_bytes(_SECRET_BYTES))

    def serve(self, certify: Certify) -> str:
        """Wait for the newcomer, then close.

        Args:
            certify: see `Certify`.

        Returns:
            The newcomer's address.

        Raises:
            PancakesError: no machine came in time, or there were too many wrong codes.
        """
        with self._sock:
            while (left_s := self._until_s - self._now()) > 0 and self._tries < TRIES and not self._told.is_set():
                self._sock.settimeout(min(left_s, LOOK_S))
                with contextlib.suppress(OSError):
                    link, place = self._sock.accept()
                    # Each in a thread of its own, so that a silent stranger does not block the newcomer.
                    threading.Thread(target=self._meet, args=(link, place[0], certify), daemon=True).start()
        if self._fault is not None:
            raise self._fault
        if self._told.is_set():
            return self._came_from
        if self._tries >= TRIES:
            raise PancakesError(f"{TRIES} attempts had a wrong code, so it is no longer valid: enrol the machine again")
        raise PancakesError("no machine has joined in time: enrol it again")

    def _meet(self, link: socket.socket, place: str, certify: Certify) -> None:
        link.settimeout(PATIENCE_S)
        with contextlib.suppress(*_NO_REQUEST), link:
            with self._context.wrap_socket(link, server_side=True) as tls:
                asked = plain_of(tls.makefile("rb").readline(MOST_BYTES))
                request = x509.load_pem_x509_csr(asked["request"].encode())
                answer = self._answer(bytes.fromhex(asked["secret"]), request, place, certify)
                _say(tls, answer)
                if self._came_from and "error" not in answer:
                    self._told.set()

    def _answer(
        self, secret: bytes, request: x509.CertificateSigningRequest, place: str, certify: Certify
    ) -> dict[str, str]:
        """Return the answer to a newcomer. One at a time, because the code is valid only once."""
        with self._lock:
            if self._came_from or self._tries >= TRIES or not hmac.compare_digest(secret, self.code.secret):
                self._tries += 1
                return {"error": "the code is not valid, or no longer valid"}
            key = request.public_key()
            if not request.is_signature_valid or not isinstance(key, ec.EllipticCurvePublicKey):
                return {"error": "the request is not signed by its key"}
            self._came_from = place
            try:
                return certify(key, place).as_text()
            except PancakesError as error:
                self._fault = error
                return {"error": "the operator's machine could not issue a certificate"}


def join(text: str) -> KeyFiles:
    """Join a fleet, on the newcomer's machine.

    Args:
        text: the code.

    Returns:
        The contents of its key folder.

    Raises:
        PancakesError: it is not a join code, the operator's machine cannot be reached, is another machine, or refuses.
    """
    code = JoinCode.parse(text)
    place = f"{code.host}:{code.port}"
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # the hash in the code identifies the certificate
    key = new_key()
    request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    asked = {"secret": code.secret.hex(), "request": request.public_bytes(_PEM).decode()}
    try:
        with connect(code.host, code.port, PATIENCE_S) as raw, context.wrap_socket(raw) as tls:
            shown = tls.getpeercert(binary_form=True) or b""
            if not hmac.compare_digest(hashlib.sha256(shown).digest()[:_HASH_BYTES], code.pin):
                raise PancakesError(
                    f"at {place} is not the machine that made this code: another one is in between, or the code is old"
                )
            _say(tls, asked)
            answer = plain_of(tls.makefile("rb").readline(MOST_BYTES) or b"{}")
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise PancakesError(f"{place} cannot be reached: {why}. Is pancakes keys enrol still waiting there?") from None
    except ValueError:
        raise PancakesError(f"the answer of {place} cannot be read") from None
    if isinstance(answer, dict) and "error" in answer:
        raise PancakesError(f"{place} says: {printable_line(str(answer['error']))}")
    try:
        return KeyFiles.of_text(answer, pem_of_key(key))
    except (KeyError, TypeError, AttributeError):
        raise PancakesError(f"{place} has not answered") from None


def own_address() -> str:
    """Return the address at which other machines probably reach this one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it asks the kernel for the route
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"


def _say(tls: ssl.SSLSocket, what: dict[str, Any]) -> None:
    tls.sendall(json.dumps(what).encode() + b"\n")
