"""The send path: from a publisher to the sessions of the peers that a packet is for. Any thread.

What packets with one channel, type, source and destination have in common is looked up once (`Way`). What a turn
publishes is joined without a lock, and leaves with one system call for each peer at the end of the turn. Packets for
an agent to which a link is still being made wait here.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.codec import RowEncoder, head_of
from pancakes.mesh.session import BATCH_BYTES, Message, PeerBusy, Session, Train
from pancakes.packet import LOG, NEIGHBOURS, Fence, Packet, agent_of

MOST_WAYS: Final = 4096
"""How many ways are cached: a task that uses ever new destinations must not fill the memory."""
MOST_WAITING_BYTES: Final = 256 * 1024
"""How many bytes may wait for an agent while a link to it is made, ..."""
MOST_WAITED_FOR: Final = 64
"""... and for how many agents at the same time."""

Key = tuple[str, str, str, str]
Defer = Callable[[Callable[[], None]], None]


class Way(msgspec.Struct, frozen=True, eq=False):
    """Where packets with one channel, type, source, destination and fence go, until the links change.

    Attributes:
        channel: the channel.
        fence: the fence.
        right: the same if the packets need it: lines of a task on `log` do not.
        place: the name of the agent, or `NEIGHBOURS`; ways of different places are independent.
        head: the head of their runs.
        sessions: the peers.
        encoder: encodes the packets.
    """

    channel: str
    fence: Fence | None
    right: Fence | None
    place: str
    head: bytes
    sessions: tuple[Session, ...]
    encoder: RowEncoder


class _Turn:
    """The packets that a thread has published and not yet sent.

    Args:
        defer: see `Mesh`.
    """

    def __init__(self, defer: Defer) -> None:
        self._defer = defer
        self._size = 0
        # In the order of the first packet of each.
        self._trains: list[Train] = []
        # The train of each place that the next packet may join: nothing else was published to that place since.
        self._last: dict[str, tuple[Way, Train]] = {}

    def add(self, way: Way, row: bytes, retry: bool) -> None:
        """Take an encoded packet."""
        size = self._size + len(row)
        if size > BATCH_BYTES and self._trains:  # a long turn must not hold back what could be on its way
            self.flush()
            size = len(row)
        self._size = size
        newest = self._last.get(way.place)
        if newest is not None and newest[0] is way:
            train = newest[1]
            train.rows.append(row)
            train.retries += retry
        else:
            self._begin(way, row, retry)

    def _begin(self, way: Way, row: bytes, retry: bool) -> None:
        """Begin another train."""
        # Packets to all neighbours and packets to one of them must not overtake each other.
        if way.place == NEIGHBOURS:
            self._last.clear()
        else:
            self._last.pop(NEIGHBOURS, None)
        train = Train(way.channel, way.head, way.sessions, [row], int(retry), way.right)
        self._last[way.place] = (way, train)
        self._trains.append(train)
        if len(self._trains) == 1:
            self._defer(self.flush)

    def flush(self) -> None:
        """Send all of it."""
        trains, self._trains, self._size = self._trains, [], 0
        self._last.clear()
        if len(trains) == 1:
            for session in trains[0].sessions:
                session.send(trains)
            return
        by_session: dict[Session, list[Train]] = {}
        for train in trains:
            for session in train.sessions:
                by_session.setdefault(session, []).append(train)
        for session, its in by_session.items():
            session.send(its)


class _Waiting(msgspec.Struct):
    """The packets that wait for an agent while a link to it is made: arguments of `Session.offer`, in order."""

    packets: list[tuple[str, tuple[str, str, str], Message]] = []
    size: int = 0


class _Local(threading.local):
    """What each thread has for itself."""

    def __init__(self, defer: Defer) -> None:
        self.turn = _Turn(defer)


class Sending:
    """Send packets. From any thread.

    Args:
        lost: returns the error for a packet to an agent without a link.
        defer: see `Mesh`.
        seek: begins to link to an agent; returns whether a link is being made.
    """

    def __init__(self, lost: Callable[[Packet], PancakesError], defer: Defer, seek: Callable[[str], bool]) -> None:
        self._lost = lost
        self._seek = seek
        self._waiting: dict[str, _Waiting] = {}
        self._links: Mapping[str, Session] = {}
        self._neighbours: tuple[Session, ...] = ()
        # Held so that no way is made of links that are being replaced. A gate that holds packets back logs that, and
        # the thread with this lock may send the line.
        self._lock = threading.RLock()
        self._ways: dict[Key, Way] = {}
        self._local = _Local(defer)

    def change(self, links: Mapping[str, Session], neighbours: tuple[Session, ...]) -> None:
        """Replace the links.

        Args:
            links: the sessions that are up, by name.
            neighbours: the sessions that the destination `*` means.
        """
        with self._lock:
            while there := self._waiting.keys() & links.keys():
                for agent in there:  # before packets that are published from now on
                    for channel, key, message in self._waiting.pop(agent).packets:
                        with suppress(PeerBusy):
                            links[agent].offer(channel, key, message)
            self._links = links
            self._neighbours = neighbours
            self._ways = {}

    def give_up(self, agent: str) -> int:
        """Drop the packets that wait for an agent, because no link to it was made; return how many."""
        with self._lock:
            waiting = self._waiting.pop(agent, None)
        return len(waiting.packets) if waiting is not None else 0

    def send(self, packet: Packet, retry: bool = False) -> int:
        """See `Mesh.send`."""
        key = (packet.channel, packet.type, packet.source, packet.destination)
        way = self._ways.get(key)
        fence = packet.fence
        if way is None or (way.fence is not fence and way.fence != fence):
            way = self._new_way(key, packet, retry)
        if way is None:
            return 1
        row = way.encoder.encode(packet)
        for session in way.sessions:
            if session.congested:
                return self._offer(way, packet, Message(row, not retry, way.head, way.right))
        self._local.turn.add(way, row, retry)
        return len(way.sessions)

    def _offer(self, way: Way, packet: Packet, message: Message) -> int:
        """Give a packet to peers of which at least one is slow, after what this thread published earlier."""
        self._local.turn.flush()
        key = (packet.source, packet.type, packet.destination)
        given = 0
        for session in way.sessions:
            try:
                session.offer(packet.channel, key, message)
            except PeerBusy:
                if packet.destination != NEIGHBOURS:
                    raise
            else:
                given += 1
        return given

    def _new_way(self, key: Key, packet: Packet, retry: bool) -> Way | None:
        """Return the way of a packet; None: the packet waits for a link."""
        place, head = agent_of(packet.destination), head_of(packet)
        right = packet.fence if packet.channel != LOG else None
        with self._lock:
            sessions = self._sessions_at(place)
            if sessions is None and self._waits(packet, place, head, right, retry):
                return None
            if sessions is not None:
                way = Way(packet.channel, packet.fence, right, place, head, sessions, RowEncoder(head))
                if len(self._ways) >= MOST_WAYS:
                    self._ways = {}
                self._ways[key] = way
                return way
        raise self._lost(packet)

    def _waits(self, packet: Packet, agent: str, head: bytes, right: Fence | None, retry: bool) -> bool:
        """Make a packet wait until its agent has a link; return False if no link is being made.

        Raises:
            PeerBusy: too many bytes wait already.
        """
        waiting = self._waiting.get(agent)
        if waiting is None:
            if len(self._waiting) >= MOST_WAITED_FOR or not self._seek(agent):
                return False
            waiting = self._waiting[agent] = _Waiting()
        row = RowEncoder(head).encode(packet)
        if waiting.size + len(row) > MOST_WAITING_BYTES:
            raise PeerBusy(f"{waiting.size} bytes already wait for the link to {agent}, which is being made")
        waiting.size += len(row)
        key = (packet.source, packet.type, packet.destination)
        waiting.packets.append((packet.channel, key, Message(row, not retry, head, right)))
        return True

    def _sessions_at(self, place: str) -> tuple[Session, ...] | None:
        if place == NEIGHBOURS:
            return self._neighbours
        session = self._links.get(place)
        return (session,) if session is not None else None
