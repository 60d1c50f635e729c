"""The links of an agent that stand. The transport's thread changes them, all threads ask."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from pancakes.mesh.net.send_buffer import CountersOfAll
from pancakes.mesh.net.session import Session
from pancakes.mesh.wire.link_messages import Hello


class Links:
    """The sessions that are up, and what was sent over all that ever were.

    Args:
        change: takes the sessions over which packets go from now on, as `Sending.change`: before other threads find a
            link that stands, and after they find one no more. So what they send to a peer that they find has a way.
    """

    def __init__(self, change: Callable[[Mapping[str, Session], tuple[Session, ...]], None]) -> None:
        self._change = change
        self._up: dict[str, Session] = {}  # both are replaced, never changed: all threads read them
        self._said: dict[str, Hello] = {}
        self._counters = CountersOfAll()
        self._lock = threading.Lock()
        self._mission_packets = 0  # over links that have ended, and announcements

    def __iter__(self) -> Iterator[Session]:
        """The sessions that are up, by the names of their peers."""
        return iter(_by_name(self._up))

    def __len__(self) -> int:
        return len(self._up)

    def add(self, session: Session, hello: Hello) -> None:
        """A link stands, to the agent that said `hello`."""
        session.stood_up(hello, self._counters.of(hello.name, self._up))
        up = {**self._up, hello.name: session}
        self._change(up, _neighbours(up))
        self._up = up
        self._said = dict(sorted({**self._said, hello.name: hello}.items()))

    def remove(self, session: Session) -> None:
        """A link has ended."""
        session.is_up = False
        with self._lock:
            self._mission_packets += session.counted
            self._up = {name: other for name, other in self._up.items() if other is not session}
            self._said = {name: hello for name, hello in self._said.items() if name in self._up}
        self._change(self._up, _neighbours(self._up))
        if session.role == "client":
            self._counters.forget(session.peer)  # clients come under ever new names

    def by_name(self) -> dict[str, Session]:
        """Returns the sessions that are up, by the names of their peers. Not to be changed."""
        return self._up

    def neighbours(self) -> tuple[Session, ...]:
        """Returns the sessions of the peers in the role `agent`, by name."""
        return _neighbours(self._up)

    def connected(self) -> Mapping[str, Hello]:
        """Returns what all peers said about themselves, by name, in the order of their names."""
        return self._said

    def rtt_s(self, peer: str) -> float | None:
        """Returns the smoothed round trip time to a peer, or None where there is none yet."""
        session = self._up.get(peer)
        return session.link.rtt_s if session is not None and session.link is not None else None

    def announced(self, peers: int) -> None:
        """An announcement went to so many peers."""
        with self._lock:
            self._mission_packets += peers

    def mission_packets_sent(self) -> int:
        """Returns how many mission packets went out; see `Mesh.mission_packets_sent`."""
        with self._lock:
            return self._mission_packets + sum(session.counted for session in self)

    def describe(self) -> list[dict[str, Any]]:
        """Returns the state of the links as plain values."""
        return [session.describe() for session in self]


def _by_name(up: Mapping[str, Session]) -> list[Session]:
    return [up[name] for name in sorted(up)]


def _neighbours(up: Mapping[str, Session]) -> tuple[Session, ...]:
    return tuple(session for session in _by_name(up) if session.role == "agent")
