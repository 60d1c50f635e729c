"""Carries hand-off messages between the services of two agents that host a task (docs/protocol.md)."""

from __future__ import annotations

from pancakes.errors import RemoteProtocolError
from pancakes.mesh.migration.candidate import would_take
from pancakes.mesh.migration.messages import (
    Abort,
    Commit,
    HandOffMessage,
    Nak,
    Piece,
    Transfer,
)
from pancakes.mesh.migration.pieces import Assembly, cut
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import Packet, agent_of
from pancakes.runtime.hosting.peer_talk import PeerTalk
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.kernel.component import Component


class Carrier:
    """Sends and takes in the hand-off messages of one service. All in that service's actor.

    The service on the other agent has the same name. A message may be lost; it is said again where it is needed.

    Args:
        service: the service.
        mesh: says what neighbours are connected, and with which journals.
    """

    def __init__(self, service: Component, mesh: Mesh) -> None:
        self._service = service
        self._mesh = mesh
        self._talk = PeerTalk(service, mesh)
        self._assembly = Assembly()

    def connected(self, peer: str) -> bool:
        """Returns whether there is a link to an agent now."""
        return peer in self._mesh.connected()

    def send(self, peer: str, message: HandOffMessage) -> None:
        """Sends a message; a snapshot in pieces."""
        if isinstance(message, Transfer):
            for piece in cut(message):
                self._talk.say(peer, self._service.name, piece)
        else:
            self._talk.say(peer, self._service.name, message)

    def take(self, packet: Packet, place: Place | None) -> HandOffMessage | None:
        """Takes a message in; `place`: that of its task, if there is one.

        Returns:
            The message; None: there is none yet, or it was meant for this agent with another disk.
        """
        message, peer = packet.body, agent_of(packet.source)
        if not self._talk.is_for_me(message):
            return None
        if isinstance(message, Piece):
            return self._add(peer, message, place)
        if isinstance(message, (Commit, Abort)):
            self._assembly.end(peer, message.task_id)
        whole: HandOffMessage = message
        return whole

    def _add(self, peer: str, piece: Piece, place: Place | None) -> Transfer | None:
        if place is None or place.promised != (peer, piece.offer):
            # Where it is no news, its sender hears by another message what became of it.
            if place is None or would_take(place.standing.record, piece.offer):
                self.send(peer, Nak(piece.task_id, piece.offer, "was not asked for a place for it first"))
            return None
        try:
            return self._assembly.add(peer, piece)
        except RemoteProtocolError as error:
            self.send(peer, Nak(piece.task_id, piece.offer, str(error)))
            return None

    def drop(self, peer: str) -> None:
        """Forgets the pieces of a peer that has gone: a snapshot that was on its way would come anew."""
        self._assembly.drop(peer)
