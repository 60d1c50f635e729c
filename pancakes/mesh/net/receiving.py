"""What the peers of an agent send: let in where they may send it, and handed over."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pancakes.mesh.net.link_log import LinkLog
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.trust import Trust
from pancakes.mesh.wire.link import PacketsReceived
from pancakes.mesh.wire.runs import Unfit
from pancakes.packet import Packet


class Receiving:
    """Hands over the packets of all links. In the transport's thread.

    Args:
        trust: what peers may send.
        log: tells what they may not.
        now: the host clock.
        call: calls what was given to the mesh, whose failure must not cost a link.
        on_packets: see `Mesh`.
        on_unfit: see `Mesh`.
    """

    def __init__(
        self,
        trust: Trust,
        log: LinkLog,
        now: Callable[[], float],
        call: Callable[..., None],
        on_packets: Callable[[str, list[Packet], int], Any],
        on_unfit: Callable[[str, Packet, str], Any],
    ) -> None:
        self._trust = trust
        self._log = log
        self._now = now
        self._call = call
        self._on_packets, self._on_unfit = on_packets, on_unfit

    def packets(self, session: Session, came: PacketsReceived) -> None:
        """Packets of one head came."""
        first, number = came.packets[0], len(came.packets)
        session.counters.packets_in += number
        if not self._may_send(session, first, number):
            return
        if too_much := self._trust.asks_too_much(session, first, number):
            for packet in came.packets:
                self._call(self._on_unfit, session.peer, packet, too_much)
        else:
            self._call(self._on_packets, session.peer, came.packets, came.size)

    def unfit(self, session: Session, came: Unfit) -> None:
        """A packet came whose body is not what its type says."""
        session.counters.packets_in += 1
        if self._may_send(session, came.packet, 1):
            self._call(self._on_unfit, session.peer, came.packet, came.reason)

    def _may_send(self, session: Session, first: Packet, number: int) -> bool:
        """Returns whether the peer may send packets of this head; where not, they are dropped, and the log says so."""
        if not (fault := self._trust.fault_of_packet(session, first)):
            return True
        self._log.false_source(session, fault, number, self._now())
        return False
