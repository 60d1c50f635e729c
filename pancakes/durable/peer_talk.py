"""Sends messages to actors of other agents, each meant for one disk. All in one actor."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.durable.messages import REGISTRAR, ToPeer, addressed
from pancakes.durable.register import Identity
from pancakes.errors import PancakesError
from pancakes.kernel.actor import ActorCore
from pancakes.mesh.mesh import Mesh
from pancakes.packet import NETWORK, join

MOST: Final = 256
"""Of at most this many peers it is remembered what was said last."""


class LastSaid:
    """Remembers what was said last of each peer. One actor."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def is_news(self, peer: str, text: str) -> bool:
        """Return whether something else was said of a peer last, or nothing."""
        said = hash(text)  # the peer may have had a part in how long it is
        is_news = self._last.pop(peer, None) != said
        self._last[peer] = said
        if len(self._last) > MOST:
            del self._last[next(iter(self._last))]
        return is_news


class PeerTalk:
    """Sends messages to actors of other agents, or of this one; each may be lost. All in one actor.

    Args:
        speaker: that actor.
        mesh: knows this agent's journal, and the neighbours with theirs.

    Attributes:
        me: this agent as an owner and member of tasks.
        boot: which life of this agent this is.
    """

    def __init__(self, speaker: ActorCore, mesh: Mesh) -> None:
        self.me = Identity(speaker.agent, mesh.identity.journal, mesh.identity.copy)
        self.boot = mesh.identity.boot
        self._speaker = speaker
        self._mesh = mesh

    def neighbours(self) -> list[str]:
        """Return the agents that are linked and have a journal."""
        return [name for name, hello in self._mesh.connected().items() if hello.journal]

    def connected(self, agent: str, journal: str = "") -> bool:
        """Return whether there is a link to an agent now; `journal`: and whether it has the disk with this journal."""
        hello = self._mesh.connected().get(agent)
        return hello is not None and journal in ("", hello.journal)

    def to(self, member: Identity, message: ToPeer) -> None:
        """Send a message to the registrar of an agent with one disk."""
        self.say(member.agent, REGISTRAR, message, member.journal)

    def say(self, agent: str, actor: str, message: ToPeer, journal: str = "") -> None:
        """Send a message to an actor of an agent.

        Args:
            agent: the agent, which may be this one. If it is not linked, and not known, nothing is sent.
            actor: the address of the actor there, without the agent's name.
            message: the message.
            journal: the id of the journal that the agent is to have; empty: that which it has now.
        """
        known = self.me.journal
        if agent != self.me.agent:
            hello = self._mesh.connected().get(agent)
            if hello is not None:
                known = hello.journal
            else:  # it may be known, and the message waits for a link if the disk is known as well
                known = journal if self._mesh.seek(agent) else ""
        if known and journal in ("", known):
            self.tell(agent, actor, addressed(message, known))

    def tell(self, agent: str, actor: str, body: msgspec.Struct) -> None:
        """Send a body to an actor of an agent, whatever disk that has."""
        try:
            self._speaker.publish(NETWORK, body, to=join(agent, actor))
        except PancakesError as error:
            self._speaker.log("debug", f"{type(body).__name__} did not reach {agent}: {error}")
