"""From a publisher to the sessions of the peers that its packet is for.

This is the way of every packet that leaves an agent, so it is short: what packets of one channel, type, source and
destination have in common is looked up once (`Way`), what a turn publishes is joined without a lock and leaves with one
system call at the end of the turn (`_Turn`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Final

from pancakes.errors import PancakesError
from pancakes.net.outbox import Message, PeerBusy
from pancakes.net.session import BATCH_BYTES, Session, Train
from pancakes.packet import NEIGHBOURS, Packet, agent_of
from pancakes.wire.runs import ENCODE, RowEncoder, framed_run, head_of

MOST_WAYS: Final = 4096
"""So many are remembered; whoever makes up one destination after the other must not fill the memory."""

Key = tuple[str, str, str, str]
Defer = Callable[[Callable[[], None]], None]


class _Turn:
    """What a thread has published and not yet sent.

    Args:
        defer: see `Mesh`.

    Attributes:
        way: the way of the newest packet; None: nothing waits.
        rows: the rows of that packet's train.
        size: bytes of all packets.
    """

    __slots__ = ("_defer", "_last", "_trains", "rows", "size", "way")

    def __init__(self, defer: Defer) -> None:
        self.way: Way | None = None
        self.rows: list[bytes] = []
        self.size = 0
        self._defer = defer
        # In the order in which the first packet of each was published.
        self._trains: list[Train] = []
        # The train of each place that the next packet may join: nothing else went there since.
        self._last: dict[str, tuple[Way, Train]] = {}

    def add(self, way: Way, sessions: tuple[Session, ...], row: bytes, retries: int) -> None:
        """Takes a packet; see `Way.send`."""
        if self.size + len(row) > BATCH_BYTES and self._trains:  # do not let a turn pile up what could be on its way
            self.flush()
        self.size += len(row)
        place, last = way.place, self._last
        newest = last.get(place)
        if newest is not None and newest[0] is way:
            train = newest[1]
            train.rows.append(row)
            train.retries += retries
            self.way, self.rows = way, train.rows
            return
        # What goes to all neighbours and what goes to one of them must not overtake each other.
        if place == NEIGHBOURS:
            last.clear()
        elif last:
            last.pop(NEIGHBOURS, None)
        train = Train(way.channel, way.head, sessions, [row], retries)
        last[place] = (way, train)
        self._trains.append(train)
        self.way, self.rows = way, train.rows
        if len(self._trains) == 1:
            self._defer(self.flush)

    def flush(self) -> None:
        """Sends all of it."""
        trains, size = self._trains, self.size
        self._trains = []
        self._last.clear()
        self.way, self.rows, self.size = None, [], 0
        if len(trains) == 1:
            train = trains[0]
            data = framed_run(train.head, train.rows, size)
            for session in train.sessions:
                session.send(trains, data)
            return
        by_session: dict[Session, list[Train]] = {}
        for train in trains:
            for session in train.sessions:
                by_session.setdefault(session, []).append(train)
        for session, its in by_session.items():
            session.send(its)


class _Local(threading.local):
    """What each thread has for itself."""

    def __init__(self, defer: Defer) -> None:
        self.turn = _Turn(defer)


class Way:
    """Where packets of one channel, type, source, destination and fence go, until other links are up.

    Args:
        packet: one of them.
        sessions: the peers that they go to.
        local: what each thread has for itself.

    Attributes:
        channel: the channel.
        head: what their runs begin with.
        sessions: as above; None: the way has ended.
        place: the name of the one agent, or `NEIGHBOURS`: ways of different places do not get in each other's way.
    """

    __slots__ = ("_encoder", "_fence", "_local", "channel", "head", "place", "sessions")

    def __init__(self, packet: Packet, sessions: tuple[Session, ...], local: _Local) -> None:
        self.channel = packet.channel
        self.head = head_of(packet)
        self.place = agent_of(packet.destination)
        self.sessions: tuple[Session, ...] | None = sessions
        self._encoder = RowEncoder(self.head)
        self._fence = packet.fence
        self._local = local

    def send(self, packet: Packet, retries: int = 0) -> int | None:
        """Sends a packet, one that was sent before where `retries` is 1; see `Mesh.send`.

        Returns:
            To how many peers it was given; None: the way has ended, or is not this packet's, and nothing was done.
        """
        sessions, fence = self.sessions, packet.fence
        if sessions is None or (fence is not self._fence and fence != self._fence):
            return None
        encoder, body = self._encoder, packet.body
        if body.__class__ is encoder.closed:
            try:
                # What `encode` does where nothing is wrong, without the call: 1.1 µs for a packet instead of 1.2.
                row = ENCODE((packet.stamp, packet.seq, packet.cause, body))
            except Exception:  # `encode` knows what to do with it
                row = encoder.encode(packet)
        else:
            row = encoder.encode(packet)
        for session in sessions:
            if session.congested:
                return self._offer(packet, sessions, row, retries)
        turn = self._local.turn
        if turn.way is self and (size := turn.size + len(row)) <= BATCH_BYTES and not retries:
            # What `turn.add` does, for who comes behind one of its way, as nearly all packets of a busy task: 0.48 µs
            # instead of 0.60.
            turn.size = size
            turn.rows.append(row)
        else:
            if len(row) > encoder.most:
                encoder.encode(packet)  # which says so
            turn.add(self, sessions, row, retries)
        return len(sessions)

    def _offer(self, packet: Packet, sessions: tuple[Session, ...], row: bytes, retries: int) -> int:
        """Gives a packet to peers of whom one at least is slow, behind what this thread has published before."""
        if len(row) > self._encoder.most:
            self._encoder.encode(packet)
        message = Message(row, not retries, self.head)
        self._local.turn.flush()
        key = (packet.source, packet.type, packet.destination)
        given = 0
        for session in sessions:
            try:
                session.offer(packet.channel, key, message)
            except PeerBusy:
                if packet.destination != NEIGHBOURS:
                    raise
            else:
                given += 1
        return given


class Sending:
    """Sends packets. From any thread.

    Args:
        lost: returns the error for a packet to an agent to which no link is up.
        defer: see `Mesh`.

    Attributes:
        neighbours: the sessions that the destination `*` means.
    """

    def __init__(self, lost: Callable[[Packet], PancakesError], defer: Defer) -> None:
        self.neighbours: tuple[Session, ...] = ()
        self._lost = lost
        self._links: Mapping[str, Session] = {}
        self._lock = threading.Lock()  # so that no way is made of links that are being replaced
        self._ways: dict[Key, Way] = {}
        self._local = _Local(defer)

    def change(self, links: Mapping[str, Session], neighbours: tuple[Session, ...]) -> None:
        """Other links are up from now on.

        Args:
            links: the sessions that are up, by name.
            neighbours: see the attributes.
        """
        with self._lock:
            self._links = links
            self.neighbours = neighbours
            self._end_ways()

    def send(self, packet: Packet, retry: bool = False) -> int:
        """See `Mesh.send`."""
        way = self._ways.get((packet.channel, packet.type, packet.source, packet.destination))
        while True:
            given = way.send(packet, int(retry)) if way is not None else None
            if given is not None:
                return given
            way = self._new_way(packet)

    def _new_way(self, packet: Packet) -> Way:
        destination = packet.destination
        with self._lock:
            sessions = self.neighbours if destination == NEIGHBOURS else self._sessions_of(agent_of(destination))
            if sessions is not None:
                way = Way(packet, sessions, self._local)
                if len(self._ways) >= MOST_WAYS:
                    self._end_ways()
                key = (packet.channel, packet.type, packet.source, destination)
                if key in self._ways:  # of a task that has moved, say, and speaks under another right now
                    self._ways[key].sessions = None
                self._ways[key] = way
                return way
        raise self._lost(packet)

    def _sessions_of(self, agent: str) -> tuple[Session, ...] | None:
        session = self._links.get(agent)
        return (session,) if session is not None else None

    def _end_ways(self) -> None:
        # Whoever still knows one of them must not keep sessions that have ended. Under the lock.
        for way in self._ways.values():
            way.sessions = None
        self._ways = {}
