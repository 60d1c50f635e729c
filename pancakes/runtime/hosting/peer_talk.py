"""How the actors that host, move and guard tasks talk to those of other agents: each message is for one disk."""

from __future__ import annotations

from pancakes.errors import PancakesError
from pancakes.mesh.guarding.choosing import CanGuard, MayGuard
from pancakes.mesh.guarding.guard_messages import GuardAnswer, KeepLease, SeizeTask, YieldLease
from pancakes.mesh.guarding.taking_over import AskLease, LeaseSeen, TakeTask
from pancakes.mesh.migration.guards import GuardianId
from pancakes.mesh.migration.messages import HandOffMessage, Message, Transfer, addressed
from pancakes.mesh.migration.pieces import cut
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import NETWORK, join
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.supervision.guardian_messages import GUARDIAN

ToGuardian = KeepLease | SeizeTask | YieldLease | AskLease
ToPeer = Message | ToGuardian | MayGuard | GuardAnswer | LeaseSeen | CanGuard | TakeTask


class PeerTalk:
    """Sends messages to actors of other agents, or of this one; each may be lost. All in one actor.

    Args:
        speaker: that actor.
        mesh: knows this agent's journal, and the neighbours with theirs.

    Attributes:
        me: this agent as a guardian: its name, the id of its journal, and which copy of that it has.
        boot: which life of this agent this is.
    """

    def __init__(self, speaker: Component | HostingService, mesh: Mesh) -> None:
        self.me = GuardianId(speaker.agent, mesh.identity.journal, mesh.identity.copy)
        self.boot = mesh.identity.boot
        self._speaker = speaker
        self._mesh = mesh

    def neighbours(self) -> list[str]:
        """Returns the agents that are linked and have a journal."""
        return [name for name, hello in self._mesh.connected().items() if hello.journal]

    def to_guardian(self, guardian: GuardianId, message: ToGuardian) -> None:
        """Sends a message to a guardian, on this agent or another one."""
        self.say(guardian.agent, GUARDIAN, message, guardian.journal)

    def connected(self, agent: str) -> bool:
        """Returns whether there is a link to an agent now."""
        return agent in self._mesh.connected()

    def hand_off(self, agent: str, message: HandOffMessage) -> None:
        """Sends a hand-off message to the service of the same name on another agent; a snapshot in pieces."""
        for part in cut(message) if isinstance(message, Transfer) else (message,):
            self.say(agent, self._speaker.name, part)

    def say(self, agent: str, actor: str, message: ToPeer, journal: str = "") -> None:
        """Sends a message to an actor of an agent.

        Args:
            agent: the agent, which may be this one. Where it is not linked, and not known, nothing is sent.
            actor: the address of the actor there, without the agent's name.
            message: the message.
            journal: the id of the journal that the agent is to have; empty: that which it has now.
        """
        known = self.me.journal
        if agent != self.me.agent:
            hello = self._mesh.connected().get(agent)
            if hello is not None:
                known = hello.journal
            else:  # it may be known, and the message waits for a link where the disk is known as well
                known = journal if self._mesh.seek(agent) else ""
        if not known or journal not in ("", known):
            return
        try:
            self._speaker.publish(NETWORK, addressed(message, known), to=join(agent, actor))
        except PancakesError as error:
            self._speaker.log("debug", f"{type(message).__name__} of {message.task_id} did not reach {agent}: {error}")
