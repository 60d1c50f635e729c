"""Joining with a code, over real sockets: who gets in, who does not, and what each side says."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import socket
import ssl
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ed25519
from cryptography.x509.oid import NameOID

from pancakes.errors import PancakesError
from pancakes.security.authority import Authority, new_key, pem_of_key
from pancakes.security.enrolment import MOST_BYTES, TRIES, Desk, JoinCode, join
from pancakes.security.keys import Keys

PATIENCE_S = 20.0


class Waiting:
    """A desk that waits in a thread of its own."""

    def __init__(self, authority: Authority, open_s: float = PATIENCE_S) -> None:
        self.desk = Desk("127.0.0.1", 0, open_s)
        self.code = str(self.desk.code)
        self.result: Any = None
        self._thread = threading.Thread(target=self._serve, args=(authority,), daemon=True)
        self._thread.start()

    def _serve(self, authority: Authority) -> None:
        try:
            self.result = self.desk.serve(lambda key, place: authority.enrol(key, "agent", "r1", ("field",), place))
        except PancakesError as error:
            self.result = str(error)

    def ended(self) -> Any:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        return self.result


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority.founded("garage", tmp_path / "authority")


@pytest.fixture
def waiting(authority: Authority) -> Callable[..., Waiting]:
    return lambda *arguments: Waiting(authority, *arguments)


def test_the_newcomer_gets_the_name_that_the_operator_chose(authority, waiting, tmp_path):
    there = waiting()
    files = join(there.code)
    assert there.ended() == "127.0.0.1"
    files.write(tmp_path / "keys")
    own = Keys(tmp_path / "keys").own
    assert (own.fleet, own.role, own.name, own.groups) == ("garage", "agent", "r1", ("field",))
    (entry,) = authority.entries
    assert (entry.who, entry.serial, entry.came_from) == ("agent/r1", own.serial, "127.0.0.1")


def test_a_code_is_good_once(waiting):
    there = waiting()
    join(there.code)
    there.ended()
    with pytest.raises(PancakesError, match=r"cannot be reached: connection refused\. Is pancakes keys enrol still"):
        join(there.code)


def test_of_two_that_come_at_once_with_one_code_one_joins(authority):
    desk = Desk("127.0.0.1", 0, PATIENCE_S)
    first_came, second_came = threading.Event(), threading.Event()

    def certify(key: Any, place: str) -> Any:
        first_came.set()
        assert second_came.wait(PATIENCE_S)
        return authority.enrol(key, "agent", "r1", (), place)

    joined: list[str] = []
    serving = threading.Thread(target=desk.serve, args=(certify,), daemon=True)
    first = threading.Thread(target=lambda: joined.append(join(str(desk.code)).name), daemon=True)
    serving.start()
    first.start()
    assert first_came.wait(PATIENCE_S)
    with link_to(desk.code) as second:
        said = {"secret": desk.code.secret.hex(), "request": request_of(new_key())}
        second.sendall(json.dumps(said).encode() + b"\n")
        second_came.set()
        answer = json.loads(second.makefile("rb").readline())
    first.join(PATIENCE_S)
    serving.join(PATIENCE_S)
    assert answer == {"error": "the code is not valid, or no longer valid"}
    assert joined == ["r1"] and len(authority.entries) == 1


def test_joining_many_at_once_with_one_code_one_joins():
    """test_joining_full.py has more rounds."""
    check_one_joins(3)


def check_one_joins(rounds):
    """Each is interrupted wherever it could be, so that two are given something where they may answer at one time."""
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for _ in range(rounds):
            assert given_to_many(16) == 1
    finally:
        sys.setswitchinterval(usual_s)


def given_to_many(crowd: int) -> int:
    """Return how many certificates a desk gives out to so many that come at once."""
    desk, ready, given = Desk("127.0.0.1", 0, PATIENCE_S), threading.Barrier(crowd), []

    def certify(key: Any, place: str) -> Any:
        given.append(place)
        raise PancakesError("the authority is closed")

    def come(link: ssl.SSLSocket, request: str) -> None:
        ready.wait()
        link.sendall(json.dumps({"secret": desk.code.secret.hex(), "request": request}).encode() + b"\n")
        link.makefile("rb").readline()

    def serve() -> None:
        with contextlib.suppress(PancakesError):
            desk.serve(certify)

    serving, request = threading.Thread(target=serve, daemon=True), request_of(new_key())
    serving.start()
    with contextlib.ExitStack() as links:
        threads = [
            threading.Thread(target=come, args=(links.enter_context(link_to(desk.code)), request), daemon=True)
            for _ in range(crowd)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_S)
    serving.join(PATIENCE_S)
    return len(given)


def test_a_request_is_no_longer_than_it_may_be(authority, waiting):
    """Although it would be one, were all of it read."""
    there = waiting()
    said = {" " * MOST_BYTES: "", "secret": there.desk.code.secret.hex(), "request": request_of(new_key())}
    with pytest.raises((ValueError, OSError)):
        asked(there.desk.code, said)
    assert authority.entries == ()
    assert join(there.code).name == "r1"


def test_a_newcomer_speaks_no_older_tls_and_says_no_secret_in_it(waiting):
    there = waiting()
    context, pin = shown_by_another()
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    heard: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as older:
        code = there.desk.code._replace(port=older.getsockname()[1], pin=pin)
        taker = threading.Thread(target=lambda: heard.append(_first_words(older, context)), daemon=True)
        taker.start()
        with pytest.raises(PancakesError, match="cannot be reached"):
            join(str(code))
        taker.join(PATIENCE_S)
    assert heard == [b""]


def test_a_request_that_its_key_has_not_signed_is_given_nothing(authority, waiting):
    """Nor one of another kind of key."""
    there = waiting()
    good = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([]))
    der = bytearray(good.sign(new_key(), hashes.SHA256()).public_bytes(serialization.Encoding.DER))
    der[-1] ^= 1
    changed = x509.load_der_x509_csr(bytes(der))
    other = good.sign(ed25519.Ed25519PrivateKey.generate(), None)
    for request in (changed, other):
        pem = request.public_bytes(serialization.Encoding.PEM).decode()
        said = asked(there.desk.code, {"secret": there.desk.code.secret.hex(), "request": pem})
        assert said == {"error": "the request is not signed by its key"}
    assert authority.entries == ()
    assert join(there.code).name == "r1", "the code is good still"


@pytest.mark.parametrize(
    "said",
    [b"[" * 100_000, b"9" * 100_000, b"[]", b'"text"', b'{"secret": 5, "request": 5}'],
    ids=["deep", "long", "list", "text", "numbers"],
)
def test_a_request_that_is_none_says_nothing_at_the_desk(waiting, said, capfd):
    there = waiting()
    with link_to(there.desk.code) as tls:
        tls.sendall(said + b"\n")
        with contextlib.suppress(OSError):
            assert tls.makefile("rb").readline() == b""
    assert join(there.code).name == "r1"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (b"[" * 100_000, "cannot be read"),
        (b'{"a": ' + b"9" * 100_000 + b"}", "cannot be read"),
        (b'["error"]', "has not answered"),
        (b'"error"', "has not answered"),
        (b'{"error": "\\u001b[2J"}', r"says: \x1b[2J"),
        (b"{}", "has not answered"),
    ],
    ids=["deep", "long", "list", "text", "terminal", "empty"],
)
def test_what_the_operators_machine_answers_is_no_traceback(waiting, answer, sentence):
    context, pin = shown_by_another()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            link, _ = listener.accept()
            with context.wrap_socket(link, server_side=True) as tls:
                tls.makefile("rb").readline()
                tls.sendall(answer + b"\n")

        serving = threading.Thread(target=serve, daemon=True)
        serving.start()
        with pytest.raises(PancakesError) as error:
            join(str(waiting().desk.code._replace(port=listener.getsockname()[1], pin=pin)))
        serving.join(PATIENCE_S)
    assert sentence in str(error.value)


def asked(code: JoinCode, request: dict[str, str]) -> Any:
    """Return what a desk answers to a request."""
    with link_to(code) as tls:
        tls.sendall(json.dumps(request).encode() + b"\n")
        return json.loads(tls.makefile("rb").readline())


def link_to(code: JoinCode) -> ssl.SSLSocket:
    """Return a link over which nothing has been said."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context.wrap_socket(socket.create_connection((code.host, code.port), PATIENCE_S))


def request_of(key: Any) -> str:
    """Return what a newcomer with this key asks to be signed."""
    request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    return request.public_bytes(serialization.Encoding.PEM).decode()


def shown_by_another() -> tuple[ssl.SSLContext, bytes]:
    """Return the context of a machine that is no desk, and the pin of the certificate that it shows."""
    key, name = new_key(), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "another")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .sign(key, hashes.SHA256())
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with tempfile.NamedTemporaryFile() as file:
        file.write(made.public_bytes(serialization.Encoding.PEM) + pem_of_key(key))
        file.flush()
        context.load_cert_chain(file.name)
    return context, hashlib.sha256(made.public_bytes(serialization.Encoding.DER)).digest()[:15]


def test_a_guessed_code_lets_in_nothing_and_ends_the_waiting(authority, waiting):
    there = waiting(30 * PATIENCE_S)
    guess = str(there.desk.code._replace(secret=b"0123456789"))
    for _ in range(TRIES):
        with pytest.raises(PancakesError, match="the code is not valid, or no longer valid"):
            join(guess)
    assert there.ended() == "5 attempts had a wrong code, so it is no longer valid: enrol the machine again"
    assert authority.entries == ()


def test_the_right_code_is_good_no_more_after_so_many_guesses_whenever_it_came(authority, waiting):
    there = waiting()
    code = there.desk.code
    said = {"secret": code.secret.hex(), "request": request_of(new_key())}
    with link_to(code) as came_before:
        for _ in range(TRIES):
            assert "error" in asked(code, {**said, "secret": "00"})
        came_before.sendall(json.dumps(said).encode() + b"\n")
        answer = json.loads(came_before.makefile("rb").readline())
    assert answer == {"error": "the code is not valid, or no longer valid"} and authority.entries == ()


def test_to_a_machine_in_between_the_secret_is_not_said(waiting):
    there = waiting()
    heard: list[bytes] = []
    context, _ = shown_by_another()
    with socket.create_server(("127.0.0.1", 0)) as between:
        relayed = str(there.desk.code._replace(port=between.getsockname()[1]))
        taker = threading.Thread(target=lambda: heard.append(_first_words(between, context)), daemon=True)
        taker.start()
        with pytest.raises(PancakesError, match="another one is in between, or the code is old"):
            join(relayed)
        taker.join(PATIENCE_S)
    assert heard == [b""]


def _first_words(waiting: socket.socket, context: ssl.SSLContext) -> bytes:
    """Return what a newcomer says to a machine that only listens."""
    link, _ = waiting.accept()
    link.settimeout(PATIENCE_S)
    try:
        with link, context.wrap_socket(link, server_side=True) as tls:
            return tls.recv(65536)
    except (OSError, ssl.SSLError):
        return b""


def test_an_older_tls_hears_nothing_of_a_code(waiting):
    there = waiting()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with socket.create_connection((there.desk.code.host, there.desk.code.port), PATIENCE_S) as link:
        with pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"):
            context.wrap_socket(link)


def test_strangers_that_say_nothing_keep_no_newcomer_out(waiting):
    there = waiting()
    code = there.desk.code
    crowd = [socket.create_connection((code.host, code.port), PATIENCE_S) for _ in range(20)]
    try:
        for link in crowd:
            link.sendall(b"\x16")
        assert join(there.code).name == "r1"
    finally:
        for link in crowd:
            link.close()


def test_after_its_time_the_code_is_not_good(waiting):
    there = waiting(0.1)
    assert there.ended() == "no machine has joined in time: enrol it again"


@pytest.mark.parametrize(
    "text", ["", "x", "127.0.0.1:7490", "127.0.0.1:7490/ABCD", "host/" + "A" * 40, "h:0/" + "A" * 40]
)
def test_what_is_no_code_is_said(text):
    with pytest.raises(PancakesError, match="is not a join code: copy all of it"):
        JoinCode.parse(text)


def test_a_code_is_read_as_it_is_written():
    code = JoinCode("192.168.1.10", 7490, bytes(range(15)), bytes(range(10)))
    assert JoinCode.parse(str(code)) == code == JoinCode.parse(f" {str(code).lower()}\n")


def test_an_older_folder_brings_no_older_roster(authority, tmp_path):
    files = authority.enrol_with_key("agent", "r2")
    older = files.roster
    newer = authority.sign()
    files._replace(roster=(authority.folder / "roster.json").read_bytes()).write(tmp_path / "keys")
    files.write(tmp_path / "keys")
    keys = Keys(tmp_path / "keys")
    assert keys.roster == newer and keys.roster_text != older
