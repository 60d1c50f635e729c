"""The links of an agent that are up: their table, their log lines, and a timer that can be set again.

The transport's thread changes the table; all threads read it. `LinkLog` logs a refusal again only if its reason has
changed, and logs clients at level debug, because they come and go all the time.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.address import is_local
from pancakes.mesh.link import Over
from pancakes.mesh.messages import Hello
from pancakes.mesh.session import PeerCounters, Session
from pancakes.mesh.transport import UNSAID, Scheduled, Transport


class Links:
    """The sessions that are up, and the counters of all links since the start.

    Args:
        change: takes the sessions for packets from now on, as `Sending.change` does: called before other threads can
            find a new link, and after they can no longer find an old one. So a link that they find can always be used.
    """

    def __init__(self, change: Callable[[Mapping[str, Session], tuple[Session, ...]], None]) -> None:
        self._change = change
        self._up: dict[str, Session] = {}  # both are replaced, never changed: all threads read them
        self._said: dict[str, Hello] = {}
        self._counters = PeerCounters()
        self._lock = threading.Lock()
        self._mission_packets = 0  # over ended links, and announcements

    def __iter__(self) -> Iterator[Session]:
        """Iterate over the sessions that are up, by the names of their peers."""
        return iter(_by_name(self._up))

    def __len__(self) -> int:
        return len(self._up)

    def add(self, session: Session, hello: Hello) -> None:
        """Add a link that is up, to the agent that said `hello`."""
        session.on_link_up(hello, self._counters.of(hello.name, self._up))
        up = {**self._up, hello.name: session}
        self._change(up, _neighbours(up))
        self._up = up
        self._said = dict(sorted({**self._said, hello.name: hello}.items()))

    def remove(self, session: Session) -> None:
        """Remove a link that has ended."""
        session.is_up = False
        with self._lock:
            self._mission_packets += session.counted
            self._up = {name: other for name, other in self._up.items() if other is not session}
            self._said = {name: hello for name, hello in self._said.items() if name in self._up}
        self._change(self._up, _neighbours(self._up))
        if session.role == "client":
            self._counters.forget(session.peer)  # clients come under ever new names

    def by_name(self) -> dict[str, Session]:
        """Return the sessions that are up, by the names of their peers. Not to be changed."""
        return self._up

    def neighbours(self) -> tuple[Session, ...]:
        """Return the sessions of the peers in the role `agent`, by name."""
        return _neighbours(self._up)

    def connected(self) -> Mapping[str, Hello]:
        """Return what all peers said about themselves, by name, in the order of their names."""
        return self._said

    def rtt_s(self, peer: str) -> float | None:
        """Return the smoothed round trip time to a peer, or None if there is none yet."""
        session = self._up.get(peer)
        return session.link.rtt_s if session is not None and session.link is not None else None

    def announced(self, peers: int) -> None:
        """Count an announcement to this many peers."""
        with self._lock:
            self._mission_packets += peers

    def mission_packets_sent(self) -> int:
        """Return how many mission packets went out; see `Mesh.mission_packets_sent`."""
        with self._lock:
            return self._mission_packets + sum(session.counted for session in self)

    def describe(self) -> list[dict[str, Any]]:
        """Return the state of the links as plain values."""
        return [session.describe() for session in self]


def _by_name(up: Mapping[str, Session]) -> list[Session]:
    return [up[name] for name in sorted(up)]


def _neighbours(up: Mapping[str, Session]) -> tuple[Session, ...]:
    return tuple(session for session in _by_name(up) if session.role == "agent")


DROPS_REPORTED_EVERY_S: Final = 5.0
"""How often at most the log names a slow peer, or one that speaks for another, in seconds of host time."""
_AGAIN_S: Final = 60.0
"""How often it repeats the reason why an address gets no link, in host time."""
_MOST_PLACES: Final = 256
_NEWS: Final = ("version", "fleet", "name", "full", "protocol")


class LinkLog:
    """Say what happens to links.

    Args:
        say: takes (level, text).
        static: the configured addresses, whose failures are warnings.
    """

    def __init__(self, say: Callable[[str, str], None], static: Sequence[str]) -> None:
        self._say = say
        self._static = static
        # The last logged reason, when it was logged, and how many were left out since; by place and level.
        self._last_reason: dict[tuple[str, str], tuple[str, float, int]] = {}

    def on_link_up(self, session: Session, hello: Hello) -> None:
        """Log that a link is up."""
        level = "debug" if hello.role == "client" else "info"
        self._say(level, f"{hello.name} ({hello.role}, {session.remote}) is connected")

    def on_link_ended(self, session: Session, over: Over) -> None:
        """Log that a link that was up has ended."""
        is_client = session.role == "client"
        why = over.refused or over.refusing
        # A client that gives its place to another is usual, and not worth a warning each time.
        is_usual = why is None or (is_client and over.refusing == "full")
        level = "warning" if over.broken or not is_usual else "debug" if is_client else "info"
        self._say(level, f"the link to {session.peer} has ended: {over.reason}")

    def not_made(self, session: Session, over: Over, now_s: float) -> None:
        """Log that a connection did not become a link.

        Each new reason is logged for a dialled address. Of the connections that come in from one place, one is logged
        each 5 s, or each minute while the reason stays the same, with the number of those left out.
        """
        why = over.refused or over.refusing or ""
        place = session.address or (f"a connection from {_place(session.remote)}" if session.remote else "a connection")
        text = f"no link over {place}: {over.reason}"
        # One of two links to a peer always ends.
        quiet = "info" if session.address in self._static and not why else "debug"
        # Its transport refuses it.
        stranger = not session.address and session.link is None and UNSAID not in over.reason
        level = "warning" if over.broken or over.turned_away or stranger or why in _NEWS else quiet
        if len(self._last_reason) > _MOST_PLACES:
            self._last_reason.clear()
        last, said_s, untold = self._last_reason.get((place, level), ("", -math.inf, 0))
        if session.address and last == text:
            return
        if not session.address and now_s < said_s + (_AGAIN_S if last == text else DROPS_REPORTED_EVERY_S):
            self._last_reason[place, level] = (last, said_s, untold + 1)
            return
        self._last_reason[place, level] = (text, now_s, 0)
        self._say(level, f"{text} (and {untold} others, that were not told of)" if untold else text)

    def given_up(self, agent: str, packets: int) -> None:
        """Log that packets are lost because no link to their agent was made."""
        if packets:
            lost = f"{packets} packets for {agent} are" if packets > 1 else f"a packet for {agent} is"
            self._say("warning", f"{lost} lost: no link to it could be made")

    def drops(self, session: Session, now_s: float) -> None:
        """Log a peer that has lost packets since it was last logged."""
        dropped = sum(session.counters.dropped.values())
        if dropped > session.reported_drops and now_s - session.reported_s >= DROPS_REPORTED_EVERY_S:
            lost = ", ".join(f"{count} on {channel}" for channel, count in sorted(session.counters.dropped.items()))
            self._say("warning", f"{session.peer} is slow; packets given up so far: {lost}")
            session.reported_drops, session.reported_s = dropped, now_s

    def false_source(self, session: Session, fault: str, number: int, now_s: float) -> None:
        """Log that a peer sent `number` more packets that it may not send."""
        session.refused += number
        if now_s - session.refused_said_s >= DROPS_REPORTED_EVERY_S:
            self._say("warning", f"{fault}; packets refused so far: {session.refused}")
            session.refused_said_s = now_s

    def attempt(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call a callback of the mesh's user. If it raises, log that: it must not cost a link."""
        try:
            function(*arguments)
        except Exception as error:  # whatever it is, it belongs in the log
            text = str(error) if isinstance(error, PancakesError) else f"{type(error).__name__}: {error}"
            name = getattr(function, "__qualname__", repr(function))
            self._say("warning" if isinstance(error, PancakesError) else "error", f"{name} failed: {text}")


def _place(remote: str) -> str:
    """Return where a connection comes from, without the port or the process, which may differ each time."""
    return "this machine" if is_local(remote) else remote.rpartition(":")[0]


class Alarm:
    """Call a function when it is due. In the transport's thread.

    Args:
        transport: in whose thread the function is called.
        now: the host clock.
        function: what is called.
        slack_s: how much later than due it is called, so that one call serves what is due soon after.

    Attributes:
        due_s: the host time for which it is set; infinity: it is not.
    """

    def __init__(
        self, transport: Transport, now: Callable[[], float], function: Callable[[], None], slack_s: float = 0.0
    ) -> None:
        self.due_s = math.inf
        self._transport = transport
        self._now = now
        self._function = function
        self._slack_s = slack_s
        self._timer: Scheduled | None = None

    def set(self, due_s: float) -> None:
        """Set it for this time instead of any other; infinity: clear it."""
        if due_s == self.due_s:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.due_s = due_s
        if due_s < math.inf:
            self._timer = self._transport.call_later(max(0.0, due_s + self._slack_s - self._now()), self._ring)

    def _ring(self) -> None:
        self._timer, self.due_s = None, math.inf
        self._function()
