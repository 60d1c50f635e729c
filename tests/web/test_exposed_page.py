"""A page that is served to other machines: with real sockets, and in a browser."""

from __future__ import annotations

import http.client
import json
import signal
import socket
import ssl
import time
from base64 import b64encode
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cli.processes import Rig
from web.browsing import WALK, WALKING, chip, expect, opened
from web.page_rig import PATIENCE_S, Fleet, answer_to
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from pancakes.errors import PancakesError
from pancakes.tools.web.exposure import Exposure
from pancakes.tools.web.feed import Shown
from pancakes.tools.web.page import open_page
from pancakes.tools.web.page_server import MOST_CONNECTIONS, NEEDS_PASSWORD, PageServer
from pancakes.tools.web.sign_in import MOST_WRONG

PASSWORD = "a-password"
ORDER = {"do": "migrate", "agent": "a", "task": "client/T", "to": "b", "dry_run": True}


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """A certificate that signs itself, with its key, as PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    file = tmp_path / "page.pem"
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    file.write_bytes(private + made.public_bytes(serialization.Encoding.PEM))
    return file


def exposed(fleet: Fleet, **others: Any) -> PageServer:
    shown = Shown(fleet.feed, fleet.explain, fleet.look, fleet.order, "a fleet")
    return open_page(shown, 0, Exposure("127.0.0.1", PASSWORD, **others))


@pytest.fixture
def outside(fleet: Fleet) -> Iterator[PageServer]:
    server = exposed(fleet)
    yield server
    server.close()


@pytest.fixture
def secured(fleet: Fleet, certificate: Path) -> Iterator[PageServer]:
    server = exposed(fleet, certificate=certificate)
    yield server
    server.close()


def get(
    server: PageServer, path: str, headers: dict[str, str], tls: ssl.SSLContext | None = None
) -> tuple[int, http.client.HTTPMessage, str]:
    if tls is None:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    else:
        connection = http.client.HTTPSConnection("localhost", server.port, timeout=PATIENCE_S, context=tls)
    try:
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        return response.status, response.headers, response.read().decode()
    finally:
        connection.close()


def sign_in(server: PageServer, password: str = PASSWORD, **others: Any) -> tuple[int, http.client.HTTPMessage, str]:
    return get(server, "/login", {"X-Page-Password": b64encode(password.encode()).decode()}, **others)


def cookie(server: PageServer) -> str:
    status, headers, _ = sign_in(server)
    assert status == 200
    return str(headers["Set-Cookie"]).partition(";")[0]


def socket_of(server: PageServer, cookie: str = "", origin: str = "", host: str = "") -> ClientConnection:
    headers = {"Cookie": cookie} if cookie else {}
    if host:
        headers["Host"] = host
    at = f"127.0.0.1:{server.port}"
    return connect(
        f"ws://{at}/news", origin=Origin(origin or f"http://{at}"), additional_headers=headers, compression=None
    )


def ask(connection: ClientConnection, what: str, **fields: Any) -> dict[str, Any]:
    connection.send(json.dumps({"id": 7, "ask": what, **fields}))
    return answer_to(connection, 7)


def test_password_opens_the_page(outside: PageServer, fleet: Fleet):
    assert outside.address == f"http://127.0.0.1:{outside.port}/"
    with socket_of(outside, cookie(outside)) as page:
        assert ask(page, "hello")["result"] == {"control": True, "title": "a fleet", "password": True}
        assert ask(page, "order", **ORDER)["ok"]
    assert len(fleet.asked) == 1


@pytest.mark.parametrize("given", ["", "pancakes_1=x", "pancakes_PORT=9999999999.{}"])
def test_nothing_is_shown_without_the_password(outside: PageServer, fleet: Fleet, given: str):
    made_up = given.replace("PORT", str(outside.port)).format("0" * 64)
    for what in ("hello", "order", "series", "find", "chunk", "explain", "task"):
        with socket_of(outside, made_up) as page:
            page.send(json.dumps({"id": 7, "ask": what, "token": outside.token, **ORDER}))
            with pytest.raises(ConnectionClosed) as closed:
                page.recv(PATIENCE_S)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == NEEDS_PASSWORD
    assert fleet.asked == []


def test_wrong_password_is_refused_and_then_delayed(outside: PageServer):
    for _ in range(MOST_WRONG):
        status, headers, text = sign_in(outside, "no password")
        assert (status, text) == (401, "this is not the password of the page\n")
        assert headers["Set-Cookie"] is None
    status, headers, text = sign_in(outside)
    assert status == 429 and "too many wrong passwords: try again in" in text
    assert 1 <= int(str(headers["Retry-After"])) <= 60


def test_password_is_taken_only_from_the_header(outside: PageServer):
    """Another site in the same browser cannot set the header without asking first, which nobody answers."""
    assert get(outside, f"/login?password={PASSWORD}", {})[0] == 400
    connection = http.client.HTTPConnection("127.0.0.1", outside.port, timeout=PATIENCE_S)
    headers = {"Origin": "http://evil.example", "Access-Control-Request-Headers": "x-page-password"}
    connection.request("OPTIONS", "/login", headers=headers)
    answer = connection.getresponse()
    assert answer.status == 405 and answer.getheader("Access-Control-Allow-Origin") is None
    connection.close()


def test_page_of_another_site_is_refused_with_a_cookie(outside: PageServer):
    known = cookie(outside)
    for origin in ("http://evil.example", "http://127.0.0.1:1", f"https://127.0.0.1:{outside.port}", "null"):
        with pytest.raises(InvalidStatus) as refused:
            socket_of(outside, known, origin)
        assert refused.value.response.status_code == 403, origin


def test_foreign_host_names_are_refused(outside: PageServer):
    for name in ("evil.example", f"evil.example:{outside.port}", ""):
        status, _, text = get(outside, "/", {"Host": name})
        assert status == 421 and "--name NAME" in text, name
    assert get(outside, "/", {"Host": "10.1.2.3"})[0] == 200
    assert (
        get(outside, "/login", {"Host": "evil.example", "X-Page-Password": b64encode(PASSWORD.encode()).decode()})[0]
        == 421
    )


def test_sign_out_ends_the_cookie(outside: PageServer):
    status, headers, _ = get(outside, "/logout", {"X-Page-Password": ""})
    assert status == 200 and "Max-Age=0" in str(headers["Set-Cookie"])
    assert get(outside, "/logout", {})[0] == 400, "another site cannot sign a person out"


def test_page_on_loopback_has_no_sign_in(server: PageServer):
    assert get(server, "/login", {"X-Page-Password": "x"})[0] == 404


def test_number_of_connections_is_limited(outside: PageServer):
    request = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{outside.port}\r\n\r\n".encode()
    with ExitStack() as stack:
        for _ in range(MOST_CONNECTIONS):
            stack.enter_context(socket.create_connection(("127.0.0.1", outside.port), PATIENCE_S))
        late = stack.enter_context(socket.create_connection(("127.0.0.1", outside.port), PATIENCE_S))
        with suppress(ConnectionError):
            late.sendall(request)
            assert late.recv(1) == b"", "it is not answered"
    until_s = time.monotonic() + PATIENCE_S
    while not answers(outside):  # those that are closed make room, once the server has noticed
        assert time.monotonic() < until_s


def answers(server: PageServer) -> bool:
    try:
        return get(server, "/", {})[0] == 200
    except (ConnectionError, http.client.HTTPException):
        return False


def test_page_is_served_over_tls(secured: PageServer, certificate: Path):
    tls = ssl.create_default_context(cafile=str(certificate))
    assert secured.address.startswith("https://")
    status, headers, _ = sign_in(secured, tls=tls)
    assert status == 200 and "; Secure" in str(headers["Set-Cookie"])
    at = f"localhost:{secured.port}"
    known = str(headers["Set-Cookie"]).partition(";")[0]
    options: dict[str, Any] = {"ssl": tls, "additional_headers": {"Cookie": known}, "compression": None}
    with connect(f"wss://{at}/news", origin=Origin(f"https://{at}"), **options) as page:
        assert ask(page, "hello")["ok"]
    with pytest.raises(InvalidStatus):
        connect(f"wss://{at}/news", origin=Origin(f"http://{at}"), **options)
    connection = http.client.HTTPSConnection("localhost", secured.port, timeout=PATIENCE_S, context=tls)
    connection.request("POST", "/login", body="x")
    assert connection.getresponse().status == 405
    connection.close()


def test_unusable_certificate_and_address_are_named(fleet: Fleet, tmp_path: Path):
    bad = tmp_path / "bad.pem"
    with pytest.raises(PancakesError, match=r"cannot use the certificate in .*bad\.pem: No such file"):
        exposed(fleet, certificate=bad)
    bad.write_text("no certificate")
    with pytest.raises(PancakesError, match=r"cannot use the certificate in .*bad\.pem"):
        exposed(fleet, certificate=bad)
    for host in ("203.0.113.9", "no-such-host.invalid"):
        with pytest.raises(PancakesError, match=f"cannot be served at {host} port .*choose another with --host"):
            open_page(Shown(fleet.feed, fleet.explain, fleet.look), 0, Exposure(host, PASSWORD))


def test_person_signs_in_and_out_in_a_browser(outside: PageServer, browser: Any, fleet: Fleet):
    faults: list[str] = []
    page = opened(browser, outside.address, [])
    page.on("pageerror", lambda error: faults.append(str(error)))
    field = page.get_by_role("textbox", name="Password")
    expect(field).to_be_focused()
    page.keyboard.press("Escape")
    field.fill("wrong password")
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog").get_by_role("status")).to_have_text("this is not the password of the page")
    expect(page.locator("#status")).to_have_text("signed out")
    field.fill(PASSWORD)
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_have_text("live")
    page.reload()
    expect(page.locator("#status")).to_have_text("live")
    page.get_by_role("button", name="Keys and hints").click()
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_role("textbox", name="Password")).to_be_visible()
    assert faults == []


def test_view_is_served_to_other_machines_with_a_password(rig: Rig, browser: Any, faults: list[str]):
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    rig.ready("a", WALKING)
    secret = rig.directory / "password"
    secret.write_text(f"{PASSWORD}\n")
    secret.chmod(0o600)
    arguments = ["view", "--host", "0.0.0.0", "--password-file", str(secret), "--name", "robot1.example"]
    running = rig.run("-u", "-m", "pancakes.tools.cli.main", *arguments, whole=True)
    address = running.hear("the page is at http://").rpartition(" ")[2]
    assert any("travel unencrypted: use --certificate" in line for line in running.said)
    port = address.rstrip("/").rpartition(":")[2]
    page = opened(browser, f"http://127.0.0.1:{port}/", faults)
    page.get_by_role("textbox", name="Password").fill(PASSWORD)
    page.keyboard.press("Enter")
    expect(chip(page, "a", "Walk")).to_have_attribute("data-state", "running")
    assert faults == []
    assert running.signalled(signal.SIGINT)[0] == 0


def test_view_for_other_machines_without_a_password_is_refused(rig: Rig):
    rig.ready("a")
    refused = rig.pancakes("view", "--host", "0.0.0.0")
    assert refused.returncode == 1
    assert "needs a password, because other machines reach it: use --password-file" in " ".join(refused.stderr.split())
    for options in (
        ["--password-file", "x"],
        ["--host", "127.0.0.1"],
        ["--host", "0.0.0.0", "--key", "x"],
        ["--host", "0.0.0.0", "--generate-password", "--password-file", "x"],
        ["--foxglove", "--host", "0.0.0.0"],
    ):
        ended = rig.pancakes("view", *options)
        assert ended.returncode == 2 and "Traceback" not in ended.stderr, options


def test_generated_password_is_printed_once_and_opens_the_page(rig: Rig):
    rig.ready("a")
    arguments = ["view", "--host", "0.0.0.0", "--generate-password", "--format", "json"]
    running = rig.run("-u", "-m", "pancakes.tools.cli.main", *arguments, whole=True)
    running.hear("]")
    (row,) = json.loads("".join(running.said[running.said.index("[") :]) if "[" in running.said else running.said[-1])
    port = int(row["address"].rstrip("/").rpartition(":")[2])
    assert row["control"] is False and len(row["password"]) >= 16
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", "/login", headers={"X-Page-Password": b64encode(row["password"].encode()).decode()})
    assert connection.getresponse().status == 200
    connection.close()
