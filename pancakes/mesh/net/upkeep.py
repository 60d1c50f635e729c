"""The upkeep of links: heartbeats, and the ends of those that are stuck. In the transport's thread."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from pancakes.mesh.net.alarm import Alarm
from pancakes.mesh.net.link_log import LinkLog
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.transport import Transport
from pancakes.mesh.wire.link import Action, LinkTimes, Over

TOGETHER: Final = 0.1
"""So much of a heartbeat later the times of links are kept, so that one wake-up of the thread serves many of them."""


class Upkeep:
    """Looks after the links of one agent when something is due.

    Args:
        sessions: its connections, by number, which change.
        transport: in whose thread it works.
        now: the host clock.
        times: the times of links.
        log: tells of packets that were given up.
        act: carries out what a link asks for.
        end: ends a link.
    """

    def __init__(
        self,
        sessions: Mapping[int, Session],
        transport: Transport,
        now: Callable[[], float],
        times: LinkTimes,
        log: LinkLog,
        act: Callable[[Session, Sequence[Action]], None],
        end: Callable[[Session, Over], None],
    ) -> None:
        self._sessions = sessions
        self._now = now
        self._times = times
        self._log = log
        self._act = act
        self._end = end
        self._alarm = Alarm(transport, now, self._run, TOGETHER * times.heartbeat_s)

    def watch(self, session: Session) -> None:
        """Sees to it that a link is looked after when it has something to do."""
        if session.link is not None and session.number in self._sessions:
            session.due_s = session.link.due_s()
            if session.due_s < self._alarm.due_s:
                self._alarm.set(session.due_s)

    def _run(self) -> None:
        self._alarm.due_s = -math.inf  # not to be set for each link
        now_s = self._now()
        try:
            for session in list(self._sessions.values()):
                if session.due_s <= now_s:
                    self._tick(session, now_s)
        finally:
            self._alarm.set(min([session.due_s for session in self._sessions.values()], default=math.inf))

    def _tick(self, session: Session, now_s: float) -> None:
        link = session.link
        if link is None or session.number not in self._sessions:
            return
        if session.is_up:
            if session.stuck_s(now_s) >= (limit_s := self._times.stuck_s):
                self._end(session, Over(f"{session.peer} took nothing for {limit_s:g} s of what waits for it"))
                return
            session.quiet_s(now_s)
            if session.counters.dropped:
                self._log.drops(session, now_s)
        due_s = link.due_s()
        if due_s > now_s:  # mostly something has been sent meanwhile, and nothing is to be done yet
            session.due_s = due_s
            return
        self._act(session, link.tick(now_s))
        self.watch(session)
