"""The census: linked agents tell each other what tasks they own, so that two owners of one task are noticed."""

from __future__ import annotations

from typing import Any, Final

from pancakes.errors import PancakesError
from pancakes.mesh.migration.claim import Claims, Owned, OwnerClaim, claims_of, in_packets
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import NETWORK, Packet, agent_of, join
from pancakes.runtime.hosting.census_messages import CENSUS, ClaimsCame, HostBegan, NeighbourUp, NetworkBegan, Owns
from pancakes.runtime.hosting.courier_messages import COURIER, OwnerHeard
from pancakes.runtime.hosting.host_state import HostState
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.handlers import on
from pancakes.runtime.kernel.keep import queue
from pancakes.runtime.kernel.tell import tell

KEEP: Final = queue(256)


class Census(Component):
    """Tells neighbours what this agent owns, and its services what neighbours own.

    It belongs to no service: what a service owns that does not run now is owned all the same.

    Args:
        records: what this agent owns.
        state: says which services host tasks.
        mesh: says what neighbours there are.
    """

    def __init__(self, *args: Any, records: Records, state: HostState, mesh: Mesh, **others: Any) -> None:
        super().__init__(*args, **others)
        self._records = records
        self._state = state
        self._mesh = mesh
        self._claims = Claims()

    def on_receive(self, message: Any) -> Any:
        match message:
            case NeighbourUp():
                self._say([message.peer], claims_of(self._records.all().values()))
            case NetworkBegan():
                self._say(self._mesh.neighbours(), claims_of(self._records.all().values()))
            case Owns():
                self._say([message.peer] if message.peer else self._mesh.neighbours(), [message.owned])
            case HostBegan():
                for peer, claims in self._claims.by_peer().items():
                    tell(message.service, ClaimsCame(peer, claims))
            case _:
                return super().on_receive(message)
        return None

    def _say(self, peers: list[str], claims: list[OwnerClaim]) -> None:
        for peer in peers:
            for body in in_packets(claims):
                try:
                    self.publish(NETWORK, body, to=join(peer, CENSUS))
                except PancakesError as error:
                    self.log("debug", f"{peer} was not told what {self.agent} owns: {error}")

    @on(NETWORK, Owned, keep=KEEP, addressed=True)
    def on_owned(self, packet: Packet) -> None:
        """Another agent tells what it owns."""
        peer = agent_of(packet.source)
        if peer not in self._mesh.neighbours():
            return
        claims: dict[TaskId, OwnerClaim] = {}
        for claim in packet.body.claims:
            self._claims.heard(peer, claim)
            claims[claim.task_id] = claim
        for service in self._state.services():
            tell(service, ClaimsCame(peer, claims))
        courier = self.kernel.registry.get(join(self.agent, COURIER))
        if courier is not None:
            tell(courier, OwnerHeard(peer, packet.body.claims))
