"""How a service talks to the guardians of its tasks."""

from __future__ import annotations

from pancakes.errors import PancakesError
from pancakes.mesh.guarding.choosing import MayGuard
from pancakes.mesh.guarding.guard_messages import KeepLease, SeizeTask, YieldLease
from pancakes.mesh.migration.guards import GuardianId
from pancakes.mesh.migration.messages import ForJournal, addressed, is_for
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import NETWORK, join
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.supervision.guardian_messages import GUARDIAN

ToGuardian = KeepLease | SeizeTask | YieldLease | MayGuard


class GuardTalk:
    """Sends messages to guardians; each may be lost. All in the service's actor.

    Args:
        service: the service.
        mesh: knows this agent's journal, and the neighbours with theirs.
    """

    def __init__(self, service: HostingService, mesh: Mesh) -> None:
        self._service = service
        self._mesh = mesh

    @property
    def me(self) -> GuardianId:
        """This agent as a guardian."""
        return GuardianId(self._service.agent, self._mesh.identity.journal)

    @property
    def boot(self) -> int:
        """Which life of this agent this is."""
        return self._mesh.identity.boot

    def neighbours(self) -> list[GuardianId]:
        """Returns the guardians of all agents that are linked."""
        return [GuardianId(hello.name, hello.journal) for hello in self._mesh.connected() if hello.journal]

    def say(self, guardian: GuardianId, message: ToGuardian) -> None:
        """Sends a message to a guardian, on this agent or another one."""
        linked = ((hello.name, hello.journal) for hello in self._mesh.connected())
        if guardian != self.me and guardian not in linked:
            return
        try:
            self._service.publish(NETWORK, addressed(message, guardian.journal), to=join(guardian.agent, GUARDIAN))
        except PancakesError as error:
            name = type(message).__name__
            self._service.log("debug", f"{name} of {message.task_id} did not reach {guardian.agent}: {error}")

    def is_for_me(self, message: ForJournal) -> bool:
        """Returns whether a message was meant for this agent with this disk."""
        return is_for(message, self._mesh.identity.journal)
