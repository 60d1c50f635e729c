"""Who is at the other end of an encrypted connection, and who is turned away."""

from __future__ import annotations

import datetime
import shutil
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from net.conftest import Ear, TlsRig

from pancakes.errors import PancakesError
from pancakes.mesh.admission import AT_ONCE, MOST_UNFINISHED, Handshakes
from pancakes.mesh.transport import SocketTransport
from pancakes.security.authority import Authority, new_key, pem_of_key
from pancakes.security.key_store import KEY, write_private
from pancakes.sim.hardware_bus import BusServer, Drive, Requested, encode
from pancakes.util.plugins import Plugins


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[TlsRig]:
    made = TlsRig(tmp_path)
    yield made
    made.close()


@pytest.fixture
def listening(rig: TlsRig) -> tuple[Ear, str]:
    """An ear, and the address at which it is reached."""
    there = rig.ear()
    return there, rig.transport("b").listen(rig.listen_at, lambda: there)


def dialled(rig: TlsRig, folder: Path | None, address: str) -> Ear:
    here = rig.ear()
    rig.with_keys(folder).dial(address, here)
    return here


def keys_of_a_stranger(rig: TlsRig) -> Path:
    folder = rig.directory / "x"
    Authority.founded("default", rig.directory / "elsewhere").enrol_with_key("agent", "a").write(folder)
    return folder


def keys_of_none_but_itself(rig: TlsRig) -> Path:
    """Returns keys whose certificate is signed with its own key, and not by an authority."""
    folder, key = rig.enrol("a"), new_key()
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "garage")])
    now = datetime.datetime.now(datetime.UTC)
    own = (
        x509.CertificateBuilder(name, name, key.public_key(), 1, now, now + datetime.timedelta(days=9))
        .add_extension(
            x509.SubjectAlternativeName([x509.UniformResourceIdentifier("pancakes://default/agent/a")]), False
        )
        .sign(key, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
    )
    write_private(folder / KEY, own + pem_of_key(key))
    return folder


def both_closed(rig: TlsRig, here: Ear, there: Ear) -> tuple[str, str]:
    rig.until(lambda: here.closed_for and there.closed_for)
    assert there.connection is None, "nothing of it reaches the handler"
    return here.closed_for[0], there.closed_for[0]


def test_both_know_who_is_there(rig, listening):
    there, address = listening
    here = dialled(rig, rig.enrol("alice", "operator", groups=("staff",)), address)
    rig.until(lambda: here.connection and there.connection)
    assert here.connection and there.connection
    answered, told = here.connection.certified, there.connection.certified
    assert answered and told
    assert (told.fleet, told.role, told.name, told.groups) == ("default", "operator", "alice", ("staff",))
    assert (answered.role, answered.name) == ("agent", "b") and told.ends_s < answered.ends_s


def test_a_certificate_of_another_authority_is_refused_on_both_sides(rig, listening):
    there, address = listening
    folder = keys_of_a_stranger(rig)
    here = dialled(rig, folder, address)
    assert both_closed(rig, here, there)[0] == "its certificate is of another fleet"
    there.closed_for.clear()
    with raw(address) as link, bare_context(rig, folder).wrap_socket(link) as tls:  # it believes ours, shows its own
        with pytest.raises(ssl.SSLError, match="UNKNOWN_CA"):
            tls.recv(1)
    rig.until(lambda: there.closed_for)
    assert there.closed_for[0].endswith("its certificate is of another fleet")


def test_a_certificate_that_vouches_for_itself_is_refused(rig, listening):
    there, address = listening
    with raw(address) as link, bare_context(rig, keys_of_none_but_itself(rig)).wrap_socket(link) as tls:
        with pytest.raises(ssl.SSLError, match="UNKNOWN_CA"):
            tls.recv(1)
    rig.until(lambda: there.closed_for)
    assert there.closed_for == ["its certificate was signed by itself"] and there.connection is None


def test_the_bus_of_a_simulated_world_is_for_the_fleet_alone(rig):
    asked: list[Requested] = []
    world = rig.transport("world", "environment")
    server = BusServer(world, lambda do: do(), asked.append, lambda *said: None)
    address = server.listen(rig.listen_at)
    drive = Drive("agent1", "motors", 1.0, 1.0, 1.0, "x/y/z")
    with raw(address) as stranger:
        stranger.sendall(encode(drive))
        while stranger.recv(4096):
            pass
    shown = dialled(rig, keys_of_a_stranger(rig), address)
    rig.until(lambda: shown.closed_for)
    member = dialled(rig, rig.enrol("agent1"), address)
    rig.until(lambda: member.connection)
    assert member.connection
    member.connection.send(encode(drive))
    rig.until(lambda: asked)
    assert asked == [drive] and len(server.clients) == 1


def test_keys_of_two_fleets_in_one_folder_are_refused(rig):
    folder = keys_of_a_stranger(rig)
    shutil.copy(rig.directory / "authority" / "fleet.pem", folder / "fleet.pem")
    with pytest.raises(PancakesError, match="the authority of that fleet has not signed its certificate"):
        rig.with_keys(folder).listen(rig.listen_at, rig.ear)


def test_a_person_does_not_listen(rig):
    there = rig.ear()
    address = rig.with_keys(rig.enrol("alice", "operator")).listen(rig.listen_at, lambda: there)
    here = dialled(rig, rig.enrol("a"), address)
    assert both_closed(rig, here, there) == (
        "its certificate is not for this use",
        "our certificate is not for this use",
    )


def test_one_without_keys_and_one_with_them_say_so(rig, listening):
    there, address = listening
    here = dialled(rig, None, address)
    rig.until(lambda: here.connection)
    assert here.connection
    here.connection.send(b"\0\0\0\x05hello")
    rig.until(lambda: there.closed_for)
    assert there.closed_for[0].endswith("it does not encrypt: perhaps it has no keys") and there.connection is None

    plain = rig.ear()
    bare = rig.with_keys(None).listen(rig.listen_at, lambda: plain)
    plain.received = lambda data: plain.connection.send(b"\0\0\0\x05hello")
    here = dialled(rig, rig.enrol("a"), bare)
    rig.until(lambda: here.closed_for)
    assert here.closed_for[0].endswith("it does not encrypt: perhaps it has no keys") and here.connection is None


def raw(address: str) -> socket.socket:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    return socket.create_connection((host, int(port)), 5.0)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "it speaks HTTP"),
        (b"\x16\x03\x01\x00\x04\x63\x00\x00\x00", "TLS failed: unexpected message"),  # no message of TLS has this type
        (b"", "the other side closed the connection, and did not say who it is"),
    ],
)
def test_what_is_no_tls_is_named(rig, listening, said, why):
    there, address = listening
    with raw(address) as link:
        link.sendall(said)
        link.shutdown(socket.SHUT_WR)
        rig.until(lambda: there.closed_for)
    assert why in there.closed_for[0] and there.connection is None


def bare_context(rig: TlsRig, folder: Path | None) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.load_verify_locations(rig.directory / "authority" / "fleet.pem")
    if folder is not None:
        context.load_cert_chain(folder / "key.pem")
    return context


def test_no_certificate_is_no_entrance(rig, listening):
    there, address = listening
    with raw(address) as link, bare_context(rig, None).wrap_socket(link) as tls:
        with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
            tls.recv(1)
    rig.until(lambda: there.closed_for)
    assert there.closed_for[0].endswith("it showed no certificate") and there.connection is None


def test_what_comes_after_a_certificate_was_refused_is_not_looked_at(rig):
    there, words = rig.ear(), []

    def last_words(fault: str) -> bytes:
        words.append(fault)
        return b"no"

    there.last_words = last_words
    address = rig.transport("a").listen(rig.listen_at, lambda: there)
    folder = rig.enrol("alice", "operator", days=-1)
    with raw(address) as link, bare_context(rig, folder).wrap_socket(link) as tls:
        assert tls.recv(2) == b"no"
        rig.until(lambda: there.closed_for)
        tls.sendall(b"all the same")
        tls.shutdown(socket.SHUT_WR)
        while tls.recv(4096):
            pass
    assert len(words) == 1 and there.connection is None and not there.data


def test_no_ticket_is_given_out_with_which_one_could_come_again(rig, listening):
    there, address = listening
    with raw(address) as link, bare_context(rig, rig.enrol("a")).wrap_socket(link) as tls:
        rig.until(lambda: there.connection)
        there.connection.send(b"hello")
        assert tls.recv(5) == b"hello"
        assert tls.session is not None and not tls.session.has_ticket


def test_what_a_member_has_signed_is_believed_by_none(rig, listening):
    """A robot's key makes no operators: its certificate says so twice, and the authority's that none is below it."""
    there, address = listening
    robot, key = rig.enrol("a"), new_key()
    own = (robot / KEY).read_bytes()
    signer = serialization.load_pem_private_key(own, None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    says = x509.load_pem_x509_certificate(own).extensions
    assert not says.get_extension_for_class(x509.BasicConstraints).value.ca
    assert not says.get_extension_for_class(x509.KeyUsage).value.key_cert_sign
    top = x509.load_pem_x509_certificate((robot / "fleet.pem").read_bytes())
    assert top.extensions.get_extension_for_class(x509.BasicConstraints).value.path_length == 0
    now = datetime.datetime.now(datetime.UTC)
    uri = x509.UniformResourceIdentifier("pancakes://default/operator/eve")
    forged = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([]))
        .issuer_name(x509.load_pem_x509_certificate(own).subject)
        .public_key(key.public_key())
        .serial_number(7)
        .not_valid_before(now)
        .not_valid_after(now + datetime.timedelta(days=9))
        .add_extension(x509.SubjectAlternativeName([uri]), True)
        .sign(signer, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
    )
    folder = rig.directory / "eve"
    write_private(folder / KEY, forged + own[: own.index(b"-----BEGIN PRIVATE")] + pem_of_key(key))
    with raw(address) as link, bare_context(rig, folder).wrap_socket(link) as tls, pytest.raises(ssl.SSLError):
        tls.recv(1)
    rig.until(lambda: there.closed_for)
    assert there.connection is None and there.closed_for[0].startswith("its certificate ")


def test_a_certificate_without_a_name_is_none_whoever_has_signed_it(rig, listening):
    there, address = listening
    folder, key = rig.enrol("a"), new_key()
    authority = rig.directory / "authority"
    signer = serialization.load_pem_private_key((authority / "authority.key").read_bytes(), None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    issuer = x509.load_pem_x509_certificate((authority / "fleet.pem").read_bytes()).subject
    now = datetime.datetime.now(datetime.UTC)
    nameless = x509.CertificateBuilder(
        issuer, x509.Name([]), key.public_key(), 7, now, now + datetime.timedelta(days=9)
    )
    pem = nameless.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    write_private(folder / KEY, pem + pem_of_key(key))
    with raw(address) as link, bare_context(rig, folder).wrap_socket(link) as tls:
        while tls.recv(4096):
            continue
    rig.until(lambda: there.closed_for)
    assert there.closed_for == ["its certificate names 0 agents or people, and not one"] and there.connection is None


def test_without_keys_there_is_no_connection_over_tcp_unless_a_person_says_so(rig):
    bare = SocketTransport(rig.clock, "a", Plugins())
    rig.transports.append(bare)
    with pytest.raises(PancakesError, match=r"'tcp://127\.0\.0\.1:0' needs keys: run pancakes keys join"):
        bare.listen(rig.listen_at, rig.ear)
    here = rig.ear()
    bare.dial("tcp://127.0.0.1:9", here)
    rig.until(lambda: here.closed_for)
    assert here.closed_for[0].startswith("'tcp://127.0.0.1:9' needs keys")
    assert not bare.may_be_named("tcp://127.0.0.1:9"), "what a peer names is not dialled either"


def test_a_handshake_that_takes_too_long_is_given_up(rig, listening, monkeypatch):
    there, address = listening
    monkeypatch.setattr("pancakes.mesh.tls.HANDSHAKE_S", 0.1)
    with raw(address):
        rig.until(lambda: there.closed_for)
    assert there.closed_for == ["no handshake within 0.1 s"] and there.connection is None


def test_a_key_is_used_for_so_many_bytes_and_then_there_is_a_new_link(rig, monkeypatch):
    a = rig.agent("a")
    b = rig.agent("b", [a.address])
    rig.until(lambda: a.knows("b") and b.knows("a"))
    monkeypatch.setattr("pancakes.mesh.tls.MOST_BYTES", 20_000)
    b.say("a", "x" * 30_000)
    rig.until(lambda: a.downs and b.downs)
    assert "it has carried 20000 bytes, and begins again with new keys" in a.downs[0][1] + b.downs[0][1]
    rig.until(lambda: a.knows("b") and b.knows("a"))


def test_an_older_tls_is_refused(rig, listening):
    there, address = listening
    context = bare_context(rig, rig.enrol("a"))
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with raw(address) as link, pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"):
        context.wrap_socket(link)
    rig.until(lambda: there.closed_for)
    assert there.closed_for[0].endswith("it speaks no TLS 1.3")


def test_a_connection_that_is_cut_off_says_so(rig, listening):
    there, address = listening
    with raw(address) as link:
        tls = bare_context(rig, rig.enrol("a")).wrap_socket(link, suppress_ragged_eofs=False)
        rig.until(lambda: there.connection)
        socket.socket(fileno=tls.detach()).close()  # without a word
    rig.until(lambda: there.closed_for)
    assert there.closed_for[0].endswith("broke: its end was cut off")


def test_a_key_that_others_can_read_is_refused(rig):
    folder = rig.enrol("a")
    (folder / "key.pem").chmod(0o644)
    with pytest.raises(PancakesError, match=r"key\.pem can be read by others \(mode 644\): chmod 600 it"):
        rig.with_keys(folder).listen(rig.listen_at, rig.ear)
    (folder / "key.pem").unlink()
    with pytest.raises(PancakesError, match=r"key\.pem cannot be used: no such file"):
        rig.with_keys(folder).listen(rig.listen_at, rig.ear)


def test_handshakes_are_bounded():
    shakes: Handshakes[int] = Handshakes(0.0)
    assert [shakes.may_begin(0.0) for _ in range(int(AT_ONCE) + 2)] == [*[True] * int(AT_ONCE), False, False]
    assert shakes.may_begin(0.01) and shakes.may_begin(0.01) and not shakes.may_begin(0.01)
    assert [shakes.begun(number) for number in range(MOST_UNFINISHED)] == [None] * MOST_UNFINISHED
    assert shakes.begun(MOST_UNFINISHED) == 0
    shakes.over(0)
    assert shakes.begun(MOST_UNFINISHED + 1) == 1


def test_a_newcomer_comes_in_through_a_crowd_that_says_nothing(rig, listening):
    _, address = listening
    crowd = [raw(address) for _ in range(MOST_UNFINISHED + 10)]
    try:
        here = rig.ear()
        transport = rig.transport("a")

        def again(reason: str) -> None:
            transport.dial(address, here)

        here.closed = again
        transport.dial(address, here)
        rig.until(lambda: here.connection)
    finally:
        for link in crowd:
            link.close()


@pytest.mark.parametrize(
    ("at_once", "rate_hz", "crowd", "given_up"),
    [(1000.0, 1000.0, MOST_UNFINISHED + 1, 0), (1.0, 0.001, 2, 1)],
    ids=["too many are not finished", "too many begin"],
)
def test_a_stranger_that_says_nothing_is_given_up_and_a_link_stays(rig, monkeypatch, at_once, rate_hz, crowd, given_up):
    there, here = rig.ear(), rig.ear()
    monkeypatch.setattr("pancakes.mesh.admission.AT_ONCE", at_once + 1)
    monkeypatch.setattr("pancakes.mesh.admission.RATE_HZ", rate_hz)
    address = rig.transport("b").listen(rig.listen_at, lambda: there)
    rig.transport("a").dial(address, here)
    rig.until(lambda: here.connection and there.connection)
    strangers = [raw(address) for _ in range(crowd)]
    try:
        assert was_closed(strangers[given_up]), "it waits for ever"
        assert not here.closed_for
    finally:
        for link in strangers:
            link.close()


def was_closed(link: socket.socket) -> bool:
    """Returns whether the other side closes a connection, long before the time for a handshake is over."""
    link.settimeout(3.0)
    try:
        while link.recv(4096):
            continue
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return True


def test_keys_in_a_folder_that_others_can_write_to_are_refused(rig):
    folder = rig.enrol("a")
    folder.chmod(0o770)
    with pytest.raises(PancakesError, match=r"others can put files into the key folder .*: chmod 700 it"):
        rig.with_keys(folder)
