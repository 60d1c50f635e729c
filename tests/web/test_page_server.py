"""The page's server over real sockets: who may look, who may order, and that no page delays others."""

from __future__ import annotations

import gc
import http.client
import json
import socket
import sys
import time
from concurrent.futures import Future
from contextlib import ExitStack
from typing import Any

import pytest
from web.page_rig import PATIENCE_S, Fleet, ask, page, stranger
from web.samples import world
from websockets.exceptions import ConnectionClosed, InvalidStatus

from pancakes.control import Migrate, Refusal, Reply
from pancakes.errors import NoAnswerError, PancakesError
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.page import Shown, open_page
from pancakes.tools.web.page_server import MOST_ASIDE, MOST_PAGES, PageServer


def get(server: PageServer, path: str, host: str | None = None) -> tuple[int, dict[str, str], bytes]:
    """Ask for a file."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    try:
        connection.request("GET", path, headers={"Host": host} if host is not None else {})
        response = connection.getresponse()
        return response.status, {name.lower(): value for name, value in response.getheaders()}, response.read()
    finally:
        connection.close()


# Files


def test_page_is_served_and_self_contained(server: PageServer):
    status, headers, body = get(server, "/")
    assert (status, headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert "default-src 'self'" in headers["content-security-policy"]
    for name in ("page.css", "main.js", "icon.svg"):
        assert get(server, f"/{name}?x=1")[0] == 200
    for path in ("/", "/page.css", "/main.js"):
        text = get(server, path)[2].decode()
        assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text
    assert b"main.js" in body


def test_page_server_has_nothing_else(server: PageServer):
    paths = ["/../server.py", "/static/main.js", "/%2e%2e/server.py", "//etc/passwd", "/x"]
    assert {path: get(server, path)[0] for path in paths} == dict.fromkeys(paths, 404)


def test_page_server_refuses_foreign_host_names(server: PageServer):
    names = ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "0.0.0.0", ""]
    assert {name: get(server, "/", name)[0] for name in names} == dict.fromkeys(names, 421)


def test_page_server_refuses_no_host_name_and_two(server: PageServer):
    for names in ([], ["127.0.0.1", "evil.example"], ["localhost", "localhost"]):
        with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as link:
            link.sendall("".join(["GET / HTTP/1.1\r\n", *(f"Host: {name}\r\n" for name in names), "\r\n"]).encode())
            assert link.makefile("rb").readline().startswith(b"HTTP/1.1 421 "), names


def test_page_server_allows_get_only(server: PageServer):
    for method in ("POST", "PUT", "DELETE", "HEAD", "OPTIONS", "TRACE", "PATCH", "get"):
        for path in ("/", "/news"):
            connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
            try:
                connection.request(method, path, body=None if method == "TRACE" else b"something")
                answer = connection.getresponse()
                assert (answer.status, answer.getheader("Allow")) == (405, "GET"), (method, path)
                assert answer.read() == (
                    b"" if method == "HEAD" else f"{method} changes nothing here: there is only GET\n".encode()
                )
            finally:
                connection.close()


def test_request_sent_byte_by_byte_is_answered(server: PageServer):
    with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as slow:
        slow.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for letter in f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n":
            slow.sendall(letter.encode())
        assert slow.recv(12) == b"HTTP/1.1 200"


def test_page_server_listens_on_loopback_only(server: PageServer):
    with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S):
        pass
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", server.port), PATIENCE_S).close()


def test_used_port_is_an_error_unless_default(server: PageServer, fleet: Fleet, monkeypatch: Any):
    with pytest.raises(PancakesError, match=f"cannot be served at port {server.port}: .*--port"):
        open_page(Shown(fleet.feed, fleet.explain, fleet.look), server.port)

    monkeypatch.setattr("pancakes.tools.web.page_server.PORT", server.port)
    other = open_page(Shown(fleet.feed, fleet.explain, fleet.look), None)
    assert other.port not in (0, server.port)
    other.close()


# Who may look


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", None])
def test_page_of_another_origin_is_refused(server: PageServer, origin: Any):
    with pytest.raises(InvalidStatus) as refused:
        stranger(server, origin=origin)
    assert refused.value.response.status_code == 403


def test_page_gets_all_values_and_then_changes(server: PageServer, fleet: Fleet):
    with fleet.feed.lock:
        fleet.feed.model.hear("world", world(0.0, a=(1.0, 0.0)), 0.0)
    with page(server) as connection:
        first = json.loads(connection.recv(PATIENCE_S))
        assert first["all"] and first["set"]["body/a"][0] == 1.0
        with fleet.feed.lock:
            fleet.feed.model.hear("world", world(0.1, a=(2.0, 0.0)), 0.0)
        news: dict[str, Any] = {}
        while "set" not in news:
            news = json.loads(connection.recv(PATIENCE_S))
        assert news["set"] == {"body/a": [2.0, 0.0, 0.5, "Drive"]}


def test_stalled_page_delays_no_other(server: PageServer, fleet: Fleet):
    def push(number: int) -> None:
        with fleet.feed.lock:
            fleet.feed.model.board.set("ballast", f"{number}" + "x" * 1_000_000)

    rounds = 30
    with page(server, max_size=None, max_queue=1) as slow, page(server, max_size=None) as quick:
        slow.recv(PATIENCE_S)
        for number in range(1, rounds + 1):  # far more than has room on the way
            push(number)
            while "ballast" not in json.loads(quick.recv(PATIENCE_S)).get("set", {}):
                pass
        got = [0]
        while got[-1] != rounds:
            ballast = json.loads(slow.recv(PATIENCE_S)).get("set", {}).get("ballast")
            if ballast is not None:
                got.append(int(ballast.partition("x")[0]))
        assert len(got) <= rounds, "the first is of before, and at least one was left out"
        assert got == sorted(got)
        assert server.skipped > 0


def test_number_of_pages_is_limited(server: PageServer):
    with ExitStack() as stack:
        for _ in range(MOST_PAGES):
            stack.enter_context(page(server)).recv(PATIENCE_S)
        with pytest.raises(ConnectionClosed, match="full: 32 pages are open already"), page(server):
            pass
    until_s = time.monotonic() + PATIENCE_S
    while not is_let_in(server):
        assert time.monotonic() < until_s


def test_silent_connections_take_no_place(server: PageServer):
    with ExitStack() as stack:
        for _ in range(MOST_ASIDE + 5):  # the first of them give their places to the next
            stack.enter_context(stranger(server))
        with page(server) as operator:
            assert json.loads(operator.recv(PATIENCE_S))["all"]
            assert ask(operator, "order", **ORDER)["ok"]


def test_oldest_silent_connection_is_closed(server: PageServer, monkeypatch: Any):
    monkeypatch.setattr("pancakes.tools.web.page_server.TOKEN_S", 600.0)
    with ExitStack() as stack:
        first, *_ = [stack.enter_context(stranger(server)) for _ in range(MOST_ASIDE + 1)]
        with pytest.raises(ConnectionClosed, match="open the page at the address that was printed"):
            first.recv(PATIENCE_S)


def is_let_in(server: PageServer) -> bool:
    try:
        with page(server) as connection:
            return bool(json.loads(connection.recv(PATIENCE_S))["all"])
    except ConnectionClosed:
        return False


# Who may ask

ORDER = {"do": "migrate", "agent": "a", "task": "client/T", "to": "b", "dry_run": True}


def test_page_with_the_token_may_order(server: PageServer, fleet: Fleet):
    assert server.address == f"http://127.0.0.1:{server.port}/#token={server.token}"
    with page(server) as connection:
        greeting = {"control": True, "title": "a fleet", "password": False}
        assert ask(connection, "hello", token=server.token)["result"] == greeting
        assert ask(connection, "order", **ORDER)["result"] == {"lines": []}
    assert fleet.asked == [("a", Migrate("client/T", "b", dry_run=True))]


def test_page_server_does_nothing_without_the_token(server: PageServer, fleet: Fleet):
    for asked in ("hello", "chunk", "explain", "task", "order"):
        for token in ("", "x", "é", None, 7):
            with stranger(server) as connection:
                connection.send(json.dumps({"id": 7, "ask": asked, "token": token, **ORDER}))
                with pytest.raises(ConnectionClosed, match="open the page at the address that was printed"):
                    connection.recv(PATIENCE_S)
            assert fleet.asked == [] and fleet.looked == [], (asked, token)


def test_question_before_the_token_is_not_answered(server: PageServer, fleet: Fleet):
    with stranger(server) as connection:
        connection.send(json.dumps({"id": 7, "ask": "order", "token": server.token, **ORDER}))
        with pytest.raises(ConnectionClosed, match="open the page at the address that was printed"):
            connection.recv(PATIENCE_S)
    assert fleet.asked == []


def test_silent_page_gets_nothing(server: PageServer):
    with stranger(server) as connection, pytest.raises(ConnectionClosed, match="it contains a token"):
        connection.recv(PATIENCE_S)


def test_read_only_page_needs_the_token(onlooker: PageServer):
    assert onlooker.address.endswith(f"#token={onlooker.token}")
    with page(onlooker) as connection:
        assert ask(connection, "hello", token=onlooker.token)["result"]["control"] is False
        answer = ask(connection, "order", **ORDER)
    assert not answer["ok"] and "start it with --control" in answer["reason"]


def test_refusal_and_silence_of_an_agent_are_reported(server: PageServer, fleet: Fleet):
    with page(server) as connection:
        ask(connection, "hello", token=server.token)
        fleet.answer = Reply(Refusal("unable", "no neighbour can take T"), {"lines": [1]})
        refused = ask(connection, "order", **ORDER)
        fleet.answer = NoAnswerError("a did not answer")
        silent = ask(connection, "order", **ORDER)
    assert (refused["ok"], refused["reason"], refused["result"]) == (False, "no neighbour can take T", {"lines": [1]})
    assert (silent["ok"], silent["reason"]) == (False, "a did not answer")


NONSENSE = ["nonsense", "[1]", '{"ask": "shutdown"}', '{"ask": 7}', '{"ask": "order"}', '{"ask": "explain"}']


@pytest.mark.parametrize("message", NONSENSE)
def test_malformed_message_is_refused(server: PageServer, message: str):
    with page(server) as connection:
        ask(connection, "hello", token=server.token)
        connection.send(message)
        answer: dict[str, Any] = {}
        while "answer" not in answer:
            answer = json.loads(connection.recv(PATIENCE_S))
        assert answer["ok"] is False and answer["reason"]
        assert ask(connection, "explain", agent="a")["result"] == {"agent": "a", "asked": ["", None, None, 0]}


DEEP = "[" * 7000 + "]" * 7000


@pytest.mark.parametrize(
    "message",
    [
        DEEP,
        f'{{"id": 7, "ask": {DEEP}}}',
        f'{{"id": {DEEP}, "ask": "hello"}}',
        f'{{"id": 7, "ask": "chunk", "t": {DEEP}}}',
    ],
)
def test_deeply_nested_json_is_refused(server: PageServer, message: str, capfd: Any, caplog: Any):
    with page(server) as connection:
        connection.send(message)
        connection.send(json.dumps({"id": 8, "ask": "hello"}))
        answers: list[dict[str, Any]] = []
        while not answers or answers[-1]["answer"] != 8:
            heard = json.loads(connection.recv(PATIENCE_S))
            if "answer" in heard:
                answers.append(heard)
    gc.collect()
    assert len(answers) == 2 and answers[1]["ok"]
    if sys.version_info < (3, 12):  # later ones read what is nested so deep
        assert not answers[0]["ok"] and "malformed" in answers[0]["reason"]
    assert capfd.readouterr().err == "" and caplog.text == ""


def test_page_explains_any_command(server: PageServer):
    with page(server) as connection:
        at = ask(connection, "explain", agent="a", type="motors", t=3)["result"]
        assert at["asked"] == ["motors", 3.0, None, 0]
        before = ask(connection, "explain", agent="a", command=["a/client/T", 7], step=-1)["result"]
        assert before["asked"] == ["", None, ["a/client/T", 7], -1]
        for nonsense in ({}, {"agent": 1}, {"agent": "a", "command": ["x"]}, {"agent": "a", "step": "on"}):
            answer = ask(connection, "explain", **nonsense)
            assert not answer["ok"] and answer["reason"]


def test_past_is_fetched_in_pieces(server: PageServer, fleet: Fleet):
    fleet.feed.record()
    with page(server) as connection:
        assert ask(connection, "chunk", t=0.5)["result"]["key"]["t"] == 1.0
        assert ask(connection, "chunk", t="x")["ok"]
        assert ask(connection, "chunk", t=10**400)["ok"]


def test_open_pages_show_the_next_mission(server: PageServer):
    with page(server) as connection:
        connection.recv(PATIENCE_S)
        other = Feed(lambda: 0.0)
        other.model.board.set("arena", [9.0, 9.0])
        server.show(Shown(other, lambda *question: None, lambda *question: Future()))
        news: dict[str, Any] = {}
        while "arena" not in news.get("set", {}):
            news = json.loads(connection.recv(PATIENCE_S))
        assert news["all"] is True
