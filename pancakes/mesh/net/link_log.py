"""What the log says of links: which came to stand, which ended and why, and which could not be made.

A refusal is said aloud, and again only where its reason has changed. Clients come and go all the time, which is no news
of the fleet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.address import is_local
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.transport import UNSAID
from pancakes.mesh.wire.link import Over
from pancakes.mesh.wire.link_messages import Hello

DROPS_REPORTED_EVERY_S: Final = 5.0
"""The log names a slow peer, or one that speaks for another, at most that often, in seconds of host time."""
_AGAIN_S: Final = 60.0
"""So often, in host time, it names the same reason again for which a place gets no link."""
_MOST_PLACES: Final = 256
_NEWS: Final = ("version", "fleet", "name", "full", "protocol")


class LinkLog:
    """Says what happens to links.

    Args:
        say: takes (level, text).
        static: the addresses of the configuration, which a person counts on.
    """

    def __init__(self, say: Callable[[str, str], None], static: Sequence[str]) -> None:
        self._say = say
        self._static = static
        # The last that was told, when that was, and how many were not told of since; by the place that it is about, and
        # by how loud that was.
        self._last_reason: dict[tuple[str, str], tuple[str, float, int]] = {}

    def stood_up(self, session: Session, hello: Hello) -> None:
        """A link stands."""
        level = "debug" if hello.role == "client" else "info"
        self._say(level, f"{hello.name} ({hello.role}, {session.remote}) is connected")

    def ended(self, session: Session, over: Over) -> None:
        """A link that stood has ended."""
        is_client = session.role == "client"
        why = over.refused or over.refusing
        # A client gives its place up to another as often as one comes: nothing to warn of each time.
        is_usual = why is None or (is_client and over.refusing == "full")
        level = "warning" if over.broken or not is_usual else "debug" if is_client else "info"
        self._say(level, f"the link to {session.peer} has ended: {over.reason}")

    def not_made(self, session: Session, over: Over, now_s: float) -> None:
        """A connection did not become a link.

        Of an address that is dialled, each new reason is told. Of the connections that come in from one place, one is
        told of each 5 s, and one each minute while the reason stays the same; it says how many were not.
        """
        why = over.refused or over.refusing or ""
        place = session.address or (f"a connection from {_place(session.remote)}" if session.remote else "a connection")
        text = f"no link over {place}: {over.reason}"
        # That one of two links goes is usual.
        quiet = "info" if session.address in self._static and not why else "debug"
        # Its transport will have nothing to do with it.
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
        """No link to an agent came to stand for which packets were waiting."""
        if packets:
            lost = f"{packets} packets for {agent} are" if packets > 1 else f"a packet for {agent} is"
            self._say("warning", f"{lost} lost: no link to it could be made")

    def drops(self, session: Session, now_s: float) -> None:
        """Names a peer that lost packets since it was last named."""
        dropped = sum(session.counters.dropped.values())
        if dropped > session.reported_drops and now_s - session.reported_s >= DROPS_REPORTED_EVERY_S:
            lost = ", ".join(f"{count} on {channel}" for channel, count in sorted(session.counters.dropped.items()))
            self._say("warning", f"{session.peer} is slow; packets given up so far: {lost}")
            session.reported_drops, session.reported_s = dropped, now_s

    def false_source(self, session: Session, fault: str, number: int, now_s: float) -> None:
        """Packets came that their peer may not send: `number` more."""
        session.refused += number
        if now_s - session.refused_said_s >= DROPS_REPORTED_EVERY_S:
            self._say("warning", f"{fault}; packets refused so far: {session.refused}")
            session.refused_said_s = now_s

    def attempt(self, function: Callable[..., None], *arguments: Any) -> None:
        """Calls what the mesh was given; its failure is told, and must not cost a link."""
        try:
            function(*arguments)
        except Exception as error:  # whatever it is, it belongs in the log
            text = str(error) if isinstance(error, PancakesError) else f"{type(error).__name__}: {error}"
            name = getattr(function, "__qualname__", repr(function))
            self._say("warning" if isinstance(error, PancakesError) else "error", f"{name} failed: {text}")


def _place(remote: str) -> str:
    """Returns where a connection comes from, without the port or the process, which may be another each time."""
    return "this machine" if is_local(remote) else remote.rpartition(":")[0]
