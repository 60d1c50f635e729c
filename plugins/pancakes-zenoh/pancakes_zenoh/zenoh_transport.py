"""Bytes through Zenoh routers, between sites: `zenoh://NAME:PORT`.

An agent dials out to a router, and has no port of its own. For each agent there are one session, one key of its data
and one token that says it lives:

    pancakes/1/SPACE/at/NAME/PORT   answered with the session that listens at zenoh://NAME:PORT
    pancakes/1/SPACE/to/SESSION     all frames for a session (`link_frames`)
    pancakes/1/SPACE/up/SESSION     the token; its end ends all links to that session

SPACE is the fleet of the keys, or `default` where there are none.
"""

from __future__ import annotations

import os
import secrets
import threading
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.address import DEFAULT_FLEET, Reach, TransportFacts, parse_address
from pancakes.mesh.admission import Handshakes
from pancakes.mesh.event_loop import Loop
from pancakes.mesh.stream import Disposable
from pancakes.mesh.tcp import needs_keys
from pancakes.mesh.transport import ConnectionHandler, SchemeTransport
from pancakes.settings import FilePath
from pancakes_zenoh.credit_pool import CreditPool
from pancakes_zenoh.inbox import Inbox
from pancakes_zenoh.link_frames import BadFrame, FrameKind, LinkFrame, frame_bytes, frame_of
from pancakes_zenoh.routed_link import RoutedLink, SealedLink

if TYPE_CHECKING:
    from pancakes.mesh.tls import TlsLayer
    from pancakes.security.keys import Keys
    from pancakes_zenoh.router_session import RouterSession

SCHEME: Final = "zenoh"
COST: Final = 5.0
"""See `TransportFacts`; through one router on the same machine, as docs/zenoh.md has it."""
MOST_CUT: Final = 512
"""How many ended sessions are remembered, at most, in case they come back."""
ROUTERS: Final = "PANCAKES_ZENOH"
"""The routers of a terminal, and of an agent whose configuration names none: addresses with a comma between them."""


class ZenohTransport(SchemeTransport):
    """Connections through Zenoh routers, encrypted from end to end, and between bearers of the fleet's certificates.

    Args:
        loop: the transport's thread.
        settings: see `Settings`.
        keys: see `SchemeTransport`.
    """

    class Settings(msgspec.Struct):
        """How it connects.

        Attributes:
            routers: where routers are reached, such as `tcp/192.0.2.1:7447`; empty: those of the file, or of the
                environment variable `PANCAKES_ZENOH`.
            file: a configuration file of Zenoh's, with certificates for the routers, say; empty: none.
            dial_s: so long a dial may take, in seconds of host time.
            silent_s: an agent that stands still has ended for the routers once it is silent for so long, in seconds of
                host time. It speaks to its router four times as often: a longer one spares a large fleet that work.
            insecure: whether it connects without keys too: what is said can then be read, changed and made up by all
                that reach a router.
        """

        routers: tuple[str, ...] = ()
        file: FilePath = ""
        dial_s: Annotated[float, msgspec.Meta(gt=0, le=60)] = 5.0
        silent_s: Annotated[float, msgspec.Meta(ge=0.5, le=60)] = 2.0
        insecure: bool = False

    def __init__(self, loop: Loop, settings: Settings, keys: Keys | None = None) -> None:
        self.loop = loop
        self.keys = keys
        self.dial_s = settings.dial_s
        self.open: dict[Disposable, None] = {}
        self.credit = CreditPool()
        self.links: dict[int, RoutedLink] = {}
        self._cut: dict[str, list[int]] = {}  # sessions that have ended, and the links that ended with them
        self._insecure, self._silent_s = settings.insecure, settings.silent_s
        self._file = settings.file
        self._routers = settings.routers or _routers_of_environment()
        self._listeners: dict[str, Callable[[], ConnectionHandler]] = {}
        self._handshakes: Handshakes[TlsLayer] = Handshakes(loop.now())
        self._making = threading.Lock()
        self._made: tuple[RouterSession, Inbox] | None = None

    @classmethod
    def facts(cls, address: str, keyed: bool) -> TransportFacts:
        return TransportFacts(Reach.ROUTERS, encrypted=keyed, cost=COST, tells_deaths=True)

    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        try:
            name, port = self._place(address)
            session, _ = self._session()
            place = f"{name}/{port or secrets.randbelow(64512) + 1024}"
            if place in self._listeners or session.is_taken(place, self.dial_s):
                raise PancakesError("address already in use: another agent listens there")
        except (ValueError, PancakesError) as error:
            raise PancakesError(f"cannot listen at {address}: {error}") from None
        self._listeners[place] = accept
        session.listen(place, self.dial_s)
        return f"{SCHEME}://{place.replace('/', ':')}"

    def stop_listening(self, address: str) -> None:
        name, port = self._place(address)
        place = f"{name}/{port}"
        if self._listeners.pop(place, None) is not None:
            self._session()[0].stop_listening(place)

    def dial(self, address: str, handler: ConnectionHandler) -> None:
        self.loop.call_later(0.0, lambda: _Dial(self, address, handler).begin())

    def may_be_named(self, address: str) -> bool:
        try:
            self._place(address)
        except (ValueError, PancakesError):
            return False
        return True

    def close(self) -> None:
        for it in list(self.open):
            it.dispose("the transport was closed")
        if self._made is not None:
            session, inbox = self._made
            session.close()
            inbox.close()

    # For links, and what becomes one

    def post(self, peer: str, frame: bytes) -> None:
        """See `LinkOwner`."""
        if self._made is not None:
            self._made[0].post(peer, frame)

    def link_ended(self, link: RoutedLink) -> None:
        """See `LinkOwner`."""
        self._spare(link.peer)

    def ask(self, address: str, answer: Callable[[str, str], None]) -> str:
        """Asks which session listens at an address; the answer comes in the loop's thread.

        Args:
            address: what to dial.
            answer: takes the session, and why there is none, as a phrase.

        Returns:
            What the session that listens there is told: this session, and the `NAME/PORT` of the address.

        Raises:
            ValueError: it is no address of this transport, or there are no keys.
            PancakesError: there is no way to a router.
        """
        name, port = self._place(address)
        session, inbox = self._session()
        place = f"{name}/{port}"
        session.ask(place, lambda found, why: inbox.put(lambda: answer(found, why)))
        return f"{session.id} {place}"

    def begin(self, number: int, peer: str, remote: str, dialled: str, handler: ConnectionHandler) -> None:
        """Makes the connection of a link, and begins it."""
        carried = (self, number, peer, remote, dialled, handler)
        if self.keys is None:
            RoutedLink(*carried).begin()
            return
        made = SealedLink(*carried, keys=self.keys, dialled=bool(dialled), shaken=self._handshakes.over)
        if not dialled and (oldest := self._handshakes.begun(made)) is not None:
            oldest.dispose("it was slow to say who it is, and others wait")
        made.begin()

    # What hears of the session's news, in threads of Zenoh's

    def came(self, frame: bytes) -> None:
        """See `SessionUser`."""
        if self._made is not None:
            self._made[1].put_bytes(len(frame), partial(self._take, frame))

    def gone(self, session: str, why: str) -> None:
        """See `SessionUser`."""
        if self._made is not None:
            self._made[1].put(lambda: self._gone(session, why))

    def there(self, session: str) -> None:
        """See `SessionUser`."""
        if self._made is not None:
            self._made[1].put(lambda: self._there(session))

    # In the loop's thread

    def _take(self, data: bytes) -> None:
        try:
            frame = frame_of(data)
            link = self.links.get(frame.link)
            if link is not None:
                link.take(frame)
            elif frame.kind is FrameKind.OPEN:
                self._opened(frame)
        except BadFrame as error:
            if error.link in self.links:
                self.links[error.link].break_off(f"a frame came that is none: {error}")

    def _opened(self, frame: LinkFrame) -> None:
        """A session dials."""
        peer, place = frame.opening()
        accept = self._listeners.get(place)
        if accept is None:
            return  # it will find out by its own time
        handler, remote = accept(), f"{SCHEME}://{peer}:0"
        handler.comes_from(remote)
        if self.keys is not None and not self._handshakes.may_begin(self.loop.now()):
            why = "too many begin at once to say who they are"
            self.post(peer, frame_bytes(FrameKind.BREAK, frame.link, 0, 0, why.encode()))
            handler.closed(why)
        else:
            self.begin(frame.link, peer, remote, "", handler)

    def _gone(self, session: str, why: str) -> None:
        for link in [it for it in self.links.values() if it.peer == session]:
            self._cut.setdefault(session, []).append(link.number)
            link.gone(why)
        if len(self._cut) > MOST_CUT:
            del self._cut[next(iter(self._cut))]

    def _there(self, session: str) -> None:
        # Where an agent loses its router and finds another at once, only the agent sees its links end.
        numbers = self._cut.pop(session, ())
        for number in numbers:
            self.post(session, frame_bytes(FrameKind.BREAK, number, 0, 0, b"its session with the routers was lost"))
        if numbers:
            self._spare(session)

    def _spare(self, session: str) -> None:
        if self._made is not None and not any(link.peer == session for link in self.links.values()):
            self._made[0].forget(session)

    # From any thread

    def _place(self, address: str) -> tuple[str, int]:
        """Returns name and port of an address.

        Raises:
            ValueError: it is none of this transport, or there are no keys; the phrase says so.
            PancakesError: there is no router to dial it at.
        """
        parts = parse_address(address)
        if parts.scheme != SCHEME or parts.path or not parts.host[0].isalpha() or parts.loopback:
            raise ValueError(
                f"{address!r} is no address of Zenoh: write it as {SCHEME}://NAME:PORT, with a name of its own"
            )
        if self.keys is None and not self._insecure:
            raise ValueError(needs_keys(address))
        if not self._routers and not self._file:
            raise PancakesError(
                f"no Zenoh router is known: name one in [service.network], settings.transports.zenoh.routers ="
                f' ["tcp/HOST:7447"], or in {ROUTERS}'
            )
        return parts.host, parts.port

    def _session(self) -> tuple[RouterSession, Inbox]:
        """Returns the session, which is made when an address is first listened at or dialled.

        Raises:
            PancakesError: the configuration is of no use.
        """
        with self._making:
            if self._made is None:
                from pancakes_zenoh.router_session import RouterSession  # and with it Zenoh, 20 MiB

                space = self.keys.own.fleet if self.keys is not None else DEFAULT_FLEET
                inbox = Inbox(self.loop)
                try:
                    self._made = (RouterSession(self._routers, self._file, space, self, self._silent_s), inbox)
                except PancakesError:
                    self.loop.call_later(0.0, inbox.close)
                    raise
            return self._made


class _Dial(Disposable):
    """Finds the session that listens at an address, and begins a link to it."""

    def __init__(self, transport: ZenohTransport, address: str, handler: ConnectionHandler) -> None:
        self._transport = transport
        self._address = address
        self._handler = handler
        self._opening = ""
        late = f"{address} did not answer within {transport.dial_s:g} s"
        self._timer = transport.loop.call_later(transport.dial_s, lambda: self.dispose(late))

    def begin(self) -> None:
        self._transport.open[self] = None
        try:
            self._opening = self._transport.ask(self._address, self._answered)
        except ValueError as error:
            self.dispose(str(error))
        except PancakesError as error:
            self.dispose(f"{self._address} cannot be reached: {error}")

    def dispose(self, reason: str) -> None:
        if self in self._transport.open:
            self._finish()
            self._handler.closed(reason)

    def _finish(self) -> None:
        del self._transport.open[self]
        self._timer.cancel()

    def _answered(self, session: str, why: str) -> None:
        if self not in self._transport.open:
            return  # too late
        if why:
            self.dispose(f"{self._address} cannot be reached: {why}")
            return
        self._finish()
        number = secrets.randbits(64)
        self._transport.begin(number, session, self._address, self._opening, self._handler)


def _routers_of_environment() -> tuple[str, ...]:
    return tuple(filter(None, (it.strip() for it in os.environ.get(ROUTERS, "").split(","))))
