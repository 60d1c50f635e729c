"""Serve the page: files over HTTP, news and orders over a WebSocket; only on the loopback interface, unless exposed.

The server runs in its own thread. The WebSocket library ignores the method of a request, and does not answer a request
with a body; so `PageConnection` refuses all methods except GET. `TaskLooks` asks agents about the task that a person
looks at. Needs `websockets`.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import logging
import math
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from importlib import resources
from typing import Annotated, Any, ClassVar, Final

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from pancakes.control import Describe, Reply
from pancakes.errors import ControlRefusedError, NoAnswerError, PancakesError, describe
from pancakes.packet import Cause
from pancakes.tools.loopback import names_loopback
from pancakes.tools.short_state import ShortState
from pancakes.tools.web.exposure import Exposure
from pancakes.tools.web.feed import FRAMES_HZ, Cursor, Shown
from pancakes.tools.web.orders import AgentName, PageDrive, ServiceTask, fields_of, order_from
from pancakes.tools.web.page_secret import secret_of
from pancakes.tools.web.sign_in import HEADER, SignIn, is_own_name
from pancakes.util import codecs
from pancakes.util.arrays import as_list
from pancakes.util.codecs import MALFORMED, why_malformed

_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; connect-src 'self' ws: wss:;"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def response(status: HTTPStatus, type_: str, data: bytes) -> Response:
    """Return an HTTP response with a body of this type; it closes the connection."""
    headers = Headers({**_HEADERS, "Content-Type": type_, "Content-Length": str(len(data)), "Connection": "close"})
    return Response(status.value, status.phrase, headers, data)


def refused(status: HTTPStatus, sentence: str) -> Response:
    """Return an HTTP response whose body is only a sentence."""
    return response(status, "text/plain; charset=utf-8", f"{sentence}\n".encode())


METHODS: Final = "GET"
MOST_CONNECTIONS: Final = 256
"""The most connections to one server, of pages and others; further ones are closed at once."""
LONGEST_METHOD: Final = 20
"""The longest method, in characters; the library refuses longer ones."""


class PageConnection(ServerConnection):
    """Refuse requests with any method except GET."""

    connected: ClassVar[set[PageConnection]]
    """The connections of one server."""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._begun: bytes | None = b""
        self._refused = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""
        super().connection_made(transport)
        self.connected.add(self)
        if len(self.connected) > MOST_CONNECTIONS:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        self.connected.discard(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        if self._refused:
            return  # the rest of the refused request; the connection is closed like any that opens no page in time
        if self._begun is not None:
            data = self._begun + data
            method, space, _ = data.partition(b" ")
            if not space and len(data) < LONGEST_METHOD and b"\n" not in data:
                self._begun = data
                return
            self._begun = None
            if space and method.isalpha() and method != METHODS.encode():
                self._refuse(method.decode())
                return
        super().data_received(data)

    def _refuse(self, method: str) -> None:
        self._refused = True
        response: Response = refused(HTTPStatus.METHOD_NOT_ALLOWED, f"{method} changes nothing here: there is only GET")
        response.headers["Allow"] = METHODS
        self.transport.write(response.serialize())
        if self.transport.can_write_eof():  # TLS cannot
            self.transport.write_eof()
        else:
            self.transport.close()


TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}


@dataclass(frozen=True, slots=True)
class StaticFile:
    """A file, and its content type."""

    type: str
    data: bytes


def static_files() -> dict[str, StaticFile]:
    """Return the files of the page by their URL path; no other file is ever served."""
    found = {}
    top = resources.files("pancakes.tools.web").joinpath("static")
    for prefix, folder in (("/", top), ("/vendor/", top.joinpath("vendor"))):
        for file in folder.iterdir():
            suffix = file.name[file.name.rfind(".") :]
            if suffix in TYPES:
                found[f"{prefix}{file.name}"] = StaticFile(TYPES[suffix], file.read_bytes())
    found["/"] = found["/index.html"]
    return found


AGAIN_S: Final = 0.5
"""The least time between two questions about a task, however many pages look at it, in seconds."""
LOOK_S: Final = 3.0
"""How long an agent may take to answer, in seconds; a task reports its state in its own turn, and may be busy."""
NEVER_SEEN: Final = "the timeline has no state of this task at this moment: states are recorded while a page shows the \
task, and every ten seconds"


class TaskLooks:
    """Ask agents about tasks, for any number of pages. Use it in the thread of the page's server."""

    def __init__(self) -> None:
        self._asked: dict[tuple[str, str], tuple[Shown, float, asyncio.Task[dict[str, Any]]]] = {}

    async def look(self, shown: Shown, agent: str, target: str, t: float | None) -> dict[str, Any]:
        """Return the state, settings and timers of a task.

        Args:
            shown: what the pages show.
            agent: the agent's name.
            target: the task, as `service/task`.
            t: a moment of the timeline; None: the present.

        Returns:
            `state`: its `rows`, whether they are `cut`, the nodes of its behaviour `tree` (depth, name, kind, status,
            message), and the moment `t` of the timeline at which it was seen; None if the state is unknown, with the
            reason as `no_state`. Only for the present: `settings`, the number of those that are `left_out` (see
            `fields_of`), and `timers`.

        Raises:
            PancakesError: the agent refuses or does not answer, and the timeline has no state of the task.
        """
        if t is not None:
            state = _seen(shown, agent, target, t)
            return {"state": state, "no_state": "" if state else NEVER_SEEN}
        now_s = asyncio.get_running_loop().time()
        self._asked = {key: row for key, row in self._asked.items() if not row[2].done() or now_s - row[1] < AGAIN_S}
        known = self._asked.get((agent, target))
        if known is None or known[0] is not shown:
            asking = asyncio.ensure_future(_look(shown, agent, target))
            asking.add_done_callback(lambda done: done.cancelled() or done.exception())  # the page may be closed
            self._asked[agent, target] = known = shown, now_s, asking
        # Other pages may wait for the same answer, so a page that closes must not cancel the question.
        return await asyncio.shield(known[2])


async def _look(shown: Shown, agent: str, target: str) -> dict[str, Any]:
    try:
        description, no_state = await _described(shown, agent, target)
    except PancakesError as error:
        state = _seen(shown, agent, target, shown.feed.now())
        if state is None:
            raise
        return {"state": state, "no_state": str(error)}
    if not no_state:
        shown.feed.take_detail(agent, description)
    settings, left_out = fields_of(description["settings_schema"], description["settings"])
    timers = description["timers"]
    return {
        "state": None if no_state else _seen(shown, agent, target, shown.feed.now()),
        "no_state": no_state,
        "settings": settings,
        "left_out": left_out,
        "timers": [{key: timer[key] for key in ("timer", "rate_hz", "ticks", "missed")} for timer in timers],
    }


async def _described(shown: Shown, agent: str, target: str) -> tuple[dict[str, Any], str]:
    """Return the description of a task, and why it lacks the state; empty if it has the state.

    Raises:
        PancakesError: the agent refuses or does not answer.
    """
    try:
        reply = await _asked(shown, agent, Describe(target, state=True))
        no_state = reply.reason
    except NoAnswerError:
        no_state = f"{agent}/{target} has not told its state within {LOOK_S:g} s: it may be busy"
    if not no_state:
        return reply.result, ""
    reply = await _asked(shown, agent, Describe(target))
    if not reply.ok:
        raise ControlRefusedError.of(reply.refusal)
    return reply.result, no_state


async def _asked(shown: Shown, agent: str, body: Describe) -> Reply:
    asked_for = asyncio.wrap_future(shown.look(agent, body, LOOK_S))
    try:
        return await asyncio.wait_for(asked_for, 2 * LOOK_S)
    except TimeoutError:
        raise NoAnswerError(f"{agent} did not answer in time") from None


def _seen(shown: Shown, agent: str, target: str, t: float) -> dict[str, Any] | None:
    with shown.feed.lock:
        found = shown.feed.states.at(f"{agent}/{target}", t)
    if found is None:
        return None
    seen_s, state = found
    return _plain(seen_s, state)


def _plain(seen_s: float, state: ShortState) -> dict[str, Any]:
    tree = [[row.depth, row.name, row.kind, row.status, row.message] for row in state.tree]
    return {"t": round(seen_s, 3), "rows": state.rows, "cut": state.cut, "tree": tree}


ADDRESS: Final = "127.0.0.1"
PORT: Final = 7480
"""The default port of the page."""
SOCKET: Final = "/news"
MOST_PAGES: Final = 32
"""The most pages that may be open."""
MOST_ASIDE: Final = 32
"""The most connections that have not shown the token yet; beyond that the oldest is closed."""
TOKEN_S: Final = 2.0
"""How long a page may take to show the token, in seconds."""
MOST_NAMES: Final = 200
"""The most series that one question asks for."""
MOST_FOUND: Final = 60
"""The most series that a search returns."""
MOST_ASKED: Final = 16
"""The most questions of one page at a time."""
LONGEST_MESSAGE: Final = 16 * 1024
ORDER_S: Final = 30.0
"""How long an agent may take for an order, in seconds: a task may be busy before it migrates."""
DRIVE_S: Final = 2.0
"""The same of a command with which a person drives: the robot has stopped by then."""
CLOSE_S: Final = 2.0
FULL: Final = f"full: {MOST_PAGES} pages are open already, close one"
WITHOUT_TOKEN: Final = "open the page at the address that was printed: it contains a token"
WITHOUT_PASSWORD: Final = "sign in with the password of the page"
NEEDS_PASSWORD: Final = 4401
"""The code with which a connection without a cookie is closed; the page then asks for the password."""
LOGIN: Final = "/login"
LOGOUT: Final = "/logout"

_LOG: Final = logging.getLogger("pancakes.tools.web.page")
"""Takes the library's complaints about malformed requests, which should not appear on the terminal."""
_LOG.addHandler(logging.NullHandler())
_LOG.propagate = False


class PageServer:
    """Show a fleet to any number of pages, in a thread of its own.

    A page gets the changes since its last frame, as soon as it has taken that frame: a slow page gets fewer frames, and
    delays no other page. The server answers only pages that it served itself under a name of the loopback interface, so
    another site in the same browser can neither read nor order anything. A page must also show the token from the
    printed address, because other users of the machine reach the loopback interface too. A page that is served beyond
    that interface needs its password instead, see `SignIn`.

    Args:
        shown: what the pages show.
        exposure: how it is served beyond the loopback interface; None: only on that interface.

    Attributes:
        token: the secret that a page must show.
        port: the port, after `start`.
        skipped: how many frames were skipped because pages were too slow.
    """

    def __init__(self, shown: Shown, exposure: Exposure | None = None) -> None:
        self._shown = shown
        self._exposure = exposure
        self._tls = exposure.tls() if exposure is not None else None
        self._names = exposure.all_names() if exposure is not None else frozenset()
        self._sign_in: SignIn | None = None
        self._files = static_files()
        self._pages: set[ServerConnection] = set()
        self._looks = TaskLooks()
        self._aside: dict[ServerConnection, asyncio.Future[str | bytes]] = {}
        self._loop = asyncio.new_event_loop()
        self._stop: asyncio.Event | None = None
        self._begun = threading.Event()
        self._fault: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="page-server", daemon=True)
        self.token = secrets.token_urlsafe(24)
        self.port = 0
        self.skipped = 0

    @property
    def address(self) -> str:
        """The address of the page, for people."""
        if self._exposure is not None:
            return f"{self._scheme}://{self._exposure.shown_name()}:{self.port}/"
        return f"http://{ADDRESS}:{self.port}/#token={self.token}"

    @property
    def _scheme(self) -> str:
        return "https" if self._tls is not None else "http"

    def start(self, port: int | None = 0) -> None:
        """Begin to listen; see `open_page` for the port.

        Raises:
            PancakesError: the port is taken.
        """
        self._ports = (PORT, 0) if port is None else (port,)
        self._thread.start()
        self._begun.wait()
        if self._fault is not None:
            self._thread.join()
            where = f"{self._host} port {port or PORT}" if self._exposure is not None else f"port {port}"
            why = f"{self._fault.strerror or self._fault}: choose another with --port"
            if isinstance(self._fault, socket.gaierror) or self._fault.errno == errno.EADDRNOTAVAIL:
                why = f"this machine has no such address: choose another with --host ({self._fault.strerror})"
            raise PancakesError(f"the page cannot be served at {where}: {why}")

    @property
    def _host(self) -> str:
        return self._exposure.host if self._exposure is not None else ADDRESS

    def show(self, shown: Shown) -> None:
        """Show something else to all pages from now on. Any thread."""
        self._shown = shown

    def close(self) -> None:
        """End all connections. Not from its own thread."""
        stop = self._stop
        if stop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(stop.set)
        self._thread.join()

    # In its thread from here on --------------------------------------------------------------------------------

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        try:
            server = await self._listen()
        except OSError as error:
            self._fault = error
            self._begun.set()
            return
        self.port = next(iter(server.sockets)).getsockname()[1]
        if self.port == self._ports[0]:  # a page at a port that comes by chance is not the same page again
            self.token = secret_of(self.port, self._shown.order is not None)
        if self._exposure is not None:
            self._sign_in = SignIn(self._exposure.password, self.token, f"pancakes_{self.port}")
        self._begun.set()
        try:
            await self._stop.wait()
        finally:
            server.close(close_connections=True)
            await asyncio.wait({asyncio.ensure_future(server.wait_closed())}, timeout=CLOSE_S)

    async def _listen(self) -> Server:
        for port in self._ports[:-1]:
            try:
                return await self._listen_at(port)
            except OSError:
                continue
        return await self._listen_at(self._ports[-1])

    async def _listen_at(self, port: int) -> Server:
        class Connection(PageConnection):
            connected: ClassVar[set[PageConnection]] = set()

        return await serve(
            self._page,
            self._host,
            port,
            ssl=self._tls,
            process_request=self._request,
            compression=None,
            max_size=LONGEST_MESSAGE,
            max_queue=MOST_ASKED,
            close_timeout=CLOSE_S / 2,
            server_header=None,
            create_connection=Connection,
            logger=_LOG,
        )

    # HTTP ------------------------------------------------------------------------------------------------------

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file, or let a WebSocket be opened (None)."""
        # Any other host name can be a DNS rebinding attack: a foreign site whose name leads to this machine.
        host = request.headers.get_all("Host")
        if self._exposure is None and not names_loopback(host):
            return refused(HTTPStatus.MISDIRECTED_REQUEST, "open this page at http://127.0.0.1")
        if self._exposure is not None and not is_own_name(host, self._names):
            return refused(
                HTTPStatus.MISDIRECTED_REQUEST,
                "open this page at the address that was printed; for another name, start it with --name NAME",
            )
        path = request.path.partition("?")[0]
        if path == SOCKET:
            if request.headers.get_all("Origin") != [f"{self._scheme}://{host[0]}"]:
                return refused(HTTPStatus.FORBIDDEN, "only the page of this server may open this")
            return None
        if self._sign_in is not None and path in (LOGIN, LOGOUT):
            return self._sign(self._sign_in, path, connection, request.headers.get_all(HEADER))
        file = self._files.get(path)
        if file is None:
            return refused(HTTPStatus.NOT_FOUND, "not found")
        return response(HTTPStatus.OK, file.type, file.data)

    def _sign(self, sign_in: SignIn, path: str, connection: ServerConnection, given: Sequence[str]) -> Response:
        """Sign a browser in or out. Another site cannot send the header: nothing is permitted across sites here."""
        if len(given) != 1:
            return refused(HTTPStatus.BAD_REQUEST, f"{path} needs the header {HEADER}")
        if path == LOGOUT:
            return self._with_cookie(sign_in.no_cookie(self._tls is not None))
        address, now_s = str(connection.remote_address[0]), self._loop.time()
        pause_s = sign_in.pause_s(address, now_s)
        if pause_s > 0.0:
            answer = refused(
                HTTPStatus.TOO_MANY_REQUESTS, f"too many wrong passwords: try again in {math.ceil(pause_s)} s"
            )
            answer.headers["Retry-After"] = str(math.ceil(pause_s))
            return answer
        if not sign_in.is_right(given[0], address, now_s):
            return refused(HTTPStatus.UNAUTHORIZED, "this is not the password of the page")
        return self._with_cookie(sign_in.new_cookie(time.time(), self._tls is not None))

    def _with_cookie(self, cookie: str) -> Response:
        answer = response(HTTPStatus.OK, "text/plain; charset=utf-8", b"")
        answer.headers["Set-Cookie"] = cookie
        return answer

    # The WebSocket ---------------------------------------------------------------------------------------------

    async def _page(self, connection: ServerConnection) -> None:
        if not await self._let_in(connection):
            return
        self._pages.add(connection)
        answering = asyncio.ensure_future(self._answer_all(connection))
        try:
            await self._show(connection)
        except ConnectionClosed:
            pass
        except Exception as error:  # else the library would print a traceback
            await connection.close(1011, f"a defect in Pancakes: {type(error).__name__}")
        finally:
            self._pages.discard(connection)
            answering.cancel()

    async def _let_in(self, connection: ServerConnection) -> bool:
        """Return whether a page may look. Otherwise close it with a reason.

        Its first message must show the token; if the page has a password, the request must have its cookie.
        """
        while len(self._aside) >= MOST_ASIDE:
            self._aside.pop(next(iter(self._aside))).cancel()
        self._aside[connection] = first = asyncio.ensure_future(connection.recv())
        try:
            await asyncio.wait({first}, timeout=TOKEN_S)
            if not first.done() or first.cancelled() or not self._is_known(connection, first.result()):
                if self._sign_in is not None:
                    await connection.close(NEEDS_PASSWORD, WITHOUT_PASSWORD)
                else:
                    await connection.close(1008, WITHOUT_TOKEN)
                return False
            if len(self._pages) >= MOST_PAGES:
                await connection.close(1013, FULL)
                return False
            await connection.send(await self._answer(first.result()), text=True)
        except ConnectionClosed:
            return False
        finally:
            self._aside.pop(connection, None)
            first.cancel()
        return True

    def _is_known(self, connection: ServerConnection, message: str | bytes) -> bool:
        try:
            asked = _ASKED(message)
        except MALFORMED:
            return False
        if asked.get("ask") != "hello":
            return False
        if self._sign_in is not None:
            request = connection.request
            return request is not None and self._sign_in.knows(request.headers.get_all("Cookie"), time.time())
        given = str(asked.get("token", ""))
        return hmac.compare_digest(given.encode(), self.token.encode())

    async def _show(self, connection: ServerConnection) -> None:
        """Send frames as fast as the page takes them, at most at `FRAMES_HZ`."""
        period_s = 1.0 / FRAMES_HZ
        shown: Shown | None = None
        seen: Cursor | None = None
        due_s = self._loop.time()
        while True:
            if shown is not self._shown:
                shown, seen = self._shown, None
            data, seen = shown.feed.frame(seen)
            await connection.send(data, text=True)
            now_s = self._loop.time()
            late = int((now_s - due_s) / period_s)
            self.skipped += late
            due_s += period_s * (late + 1)
            await asyncio.sleep(due_s - now_s)

    async def _answer_all(self, connection: ServerConnection) -> None:
        """Answer the questions of a page, several at a time."""
        room = asyncio.Semaphore(MOST_ASKED)
        asked: set[asyncio.Task[None]] = set()

        async def answer(message: str | bytes) -> None:
            try:
                with contextlib.suppress(ConnectionClosed):
                    await connection.send(await self._answer(message), text=True)
            finally:
                room.release()

        try:
            async for message in connection:
                await room.acquire()
                task = asyncio.ensure_future(answer(message))
                asked.add(task)
                task.add_done_callback(asked.discard)
        finally:
            for task in list(asked):
                task.cancel()

    async def _answer(self, message: str | bytes) -> bytes:
        """Return the answer to a message: `answer` (its `id`), `ok`, `reason` and `result`."""
        number = None
        try:
            asked = _ASKED(message)
            number = codecs.convert(asked.pop("id", None), _Number)
            result = await self._do(asked.pop("ask", None), asked)
            reply = result if isinstance(result, Reply) else Reply(None, result)
            return _ENCODE({"answer": number, "ok": reply.ok, "reason": reply.reason, "result": reply.result})
        except PancakesError as error:
            reason = str(error)
        except MALFORMED as error:
            reason = f"a message of the page is malformed: {why_malformed(error)}"
        except Exception as error:  # otherwise the traceback would appear on the terminal
            reason = f"a defect in Pancakes: {describe(error)}"
        return _ENCODE({"answer": number, "ok": False, "reason": reason, "result": None})

    async def _do(self, what: Any, asked: dict[str, Any]) -> Any:
        shown = self._shown
        if what == "hello":
            return {"control": shown.order is not None, "title": shown.title, "password": self._sign_in is not None}
        if what == "chunk":
            return msgspec.Raw(shown.feed.chunk(_moment_of(asked)))
        if what == "series":
            asked_series = codecs.convert(asked, _SeriesRequest)
            return await self._loop.run_in_executor(None, shown.feed.plot, asked_series.names, asked_series.since)
        if what == "find":
            return shown.feed.find_series(codecs.convert(asked, _FindRequest).words, MOST_FOUND)
        if what == "explain":
            return await self._loop.run_in_executor(None, shown.explain, *_command_of(asked))
        if what == "task":
            wanted = codecs.convert(asked, _TaskLookRequest)
            return await self._looks.look(shown, wanted.agent, wanted.task, wanted.t)
        if what == "order":
            if shown.order is None:
                raise ControlRefusedError("this page is read-only: start it with --control to change something")
            order = order_from(asked)
            limit_s = DRIVE_S if isinstance(order, PageDrive) else ORDER_S
            asked_for = asyncio.wrap_future(shown.order(order.agent, order.body(), limit_s))
            try:
                return await asyncio.wait_for(asked_for, limit_s + CLOSE_S)
            except TimeoutError:
                raise NoAnswerError(f"{order.agent} did not answer in time") from None
        raise ControlRefusedError(f"a page cannot ask for {str(what)[:40]!r}")


_Number = Annotated[int, msgspec.Meta(ge=0, le=2**53)] | None
"""The number of a question; the answer has the same."""


def _moment_of(asked: dict[str, Any]) -> float:
    """Return the moment on the timeline that a page asks for; 0 if it is invalid, such as a number of 400 digits."""
    try:
        return codecs.convert(asked.get("t"), float)
    except msgspec.ValidationError:
        return 0.0


def _command_of(asked: dict[str, Any]) -> tuple[str, str, float | None, Cause | None, int]:
    """Return which command a page asks about, see `CommandExplainer.explain`.

    Raises:
        msgspec.ValidationError: the question is malformed.
    """
    it = codecs.convert(asked, _ExplainRequest)
    return it.agent, it.type, it.t, it.command, it.step


_ENCODE: Final = codecs.json_encoder(as_list)
_ASKED: Final[Callable[[bytes | str], dict[str, Any]]] = codecs.json_decoder(dict[str, Any])


class _TaskLookRequest(msgspec.Struct):
    """The task that a page asks about, and the moment of the timeline; None: now."""

    agent: AgentName
    task: ServiceTask
    t: float | None = None


class _SeriesRequest(msgspec.Struct):
    """The series that a page shows, and the moment of the timeline after which it needs points, of each."""

    names: Annotated[tuple[Annotated[str, msgspec.Meta(max_length=300)], ...], msgspec.Meta(max_length=MOST_NAMES)]
    since: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.since):
            raise ValueError("each name needs a moment")


class _FindRequest(msgspec.Struct):
    """The words that the name of a series must have."""

    words: Annotated[str, msgspec.Meta(max_length=200)] = ""


class _ExplainRequest(msgspec.Struct):
    """The command that a page asks about."""

    agent: str
    type: str = ""
    t: float | None = None
    command: Cause | None = None
    step: int = 0
