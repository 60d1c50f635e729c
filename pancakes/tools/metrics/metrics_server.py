"""Serves an agent's metrics over HTTP on the loopback interface."""

from __future__ import annotations

import contextlib
import hmac
import threading
from collections.abc import Callable, Iterable
from http import HTTPStatus
from socketserver import ThreadingMixIn
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

from pancakes.errors import describe
from pancakes.tools.loopback import names_loopback

HOST: Final = "127.0.0.1"
"""Metrics tell much about an agent, and any program may ask for them: they are served to this machine only."""
REQUEST_S: Final = 5.0
"""The time that a request may take to arrive, in host time; then its connection is closed."""
MOST_REQUESTS: Final = 16
"""The most requests that are answered at a time."""
LONGEST_BODY: Final = 64 * 1024
"""The most that is read of a body, which no request here needs, so that its sender gets to read the answer."""

_Respond = Callable[[str, list[tuple[str, str]]], object]


class MetricsServer:
    """Answers GET requests that name the loopback interface, in threads of its own, until it is closed.

    Args:
        port: the port; 0: a free one.
        registry: what is served.
        token: what a request must show, as `Authorization: Bearer TOKEN`; empty: nothing.

    Attributes:
        port: the port that it is at.

    Raises:
        OSError: the port cannot be had.
    """

    def __init__(self, port: int, registry: CollectorRegistry, token: str) -> None:
        self._server = _Server((HOST, port), _MetricsRequestHandler)
        self._server.set_app(_guarded(make_wsgi_app(registry), token))
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Listens no more. Not from one of its own threads."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    """A thread for each request, and no more than so many at a time."""

    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._room = threading.Semaphore(MOST_REQUESTS)
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        full = HTTPStatus.SERVICE_UNAVAILABLE
        with contextlib.suppress(OSError):
            head = f"HTTP/1.1 {full.value} {full.phrase}\r\nConnection: close\r\n\r\n"
            request.send(f"{head}full: {MOST_REQUESTS} requests are being answered\n".encode())
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a request that breaks off, or never comes."""


class _MetricsRequestHandler(WSGIRequestHandler):
    """Reads one request, and logs nothing."""

    timeout = REQUEST_S

    def log_message(self, format: str, *args: Any) -> None:
        """Does nothing."""


def _guarded(metrics: Callable[..., Iterable[bytes]], token: str) -> Callable[..., Iterable[bytes]]:
    """Returns a WSGI application that hands on what may be asked, and says to others why not."""

    def answer(environ: dict[str, Any], respond: _Respond) -> Iterable[bytes]:
        method = environ["REQUEST_METHOD"]
        if not names_loopback([environ.get("HTTP_HOST", "")]):
            return _refuse(environ, respond, HTTPStatus.MISDIRECTED_REQUEST, f"these metrics are at http://{HOST} only")
        if method != "GET":
            sentence = f"{method[:20]} changes nothing here: there is only GET"
            return _refuse(environ, respond, HTTPStatus.METHOD_NOT_ALLOWED, sentence, ("Allow", "GET"))
        if token and not hmac.compare_digest(
            environ.get("HTTP_AUTHORIZATION", "").encode(), f"Bearer {token}".encode()
        ):
            challenge = ("WWW-Authenticate", "Bearer")
            return _refuse(environ, respond, HTTPStatus.UNAUTHORIZED, "show the token that the log names", challenge)
        try:
            return metrics(environ, respond)
        except Exception as error:  # else the library would print a traceback
            sentence = f"a defect in Pancakes or in prometheus_client: {describe(error)}"
            return _refuse(environ, respond, HTTPStatus.INTERNAL_SERVER_ERROR, sentence)

    return answer


def _refuse(
    environ: dict[str, Any], respond: _Respond, status: HTTPStatus, sentence: str, *headers: tuple[str, str]
) -> Iterable[bytes]:
    length = environ.get("CONTENT_LENGTH", "")
    if length.isascii() and length.isdigit():
        with contextlib.suppress(OSError):  # its sender may have announced more than ever comes
            environ["wsgi.input"].read(min(int(length[:9]), LONGEST_BODY))
    respond(f"{status.value} {status.phrase}", [("Content-Type", "text/plain; charset=utf-8"), *headers])
    return [f"{sentence}\n".encode()]
