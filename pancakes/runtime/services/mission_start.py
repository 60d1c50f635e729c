"""How the mission of an agent begins: at the time that it has in its fleet, or at 0."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from pancakes.mesh.net.mesh import Mesh
from pancakes.mesh.wire.fleet_mission import PeerMission, mission_of_fleet
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.kernel import Kernel

LOOK_S: Final = 0.02
"""How often it is looked whether the fleet is known by now, in host time."""
MISSION: Final = "mission"
"""A peer is believed the time of the mission that has the right `publish` on this."""


class MissionStart:
    """Has an agent that has just begun take the mission's time from its fleet, before any of its services starts.

    So no task ever sees the time jump: timers, commands and what a task remembers are in the fleet's time from the
    first tick on. A mission that runs is left alone. Leases rest on the host clock, which nothing here touches. In the
    actor of the root.

    Args:
        kernel: the agent's kernel, whose mission is held.
        mesh: its links.
        hold: whether the mission waits for `Begin` where it runs nowhere yet.
        join_s: so long the agent waits for its fleet at most, in host time.
        comes_back: whether it has been in a fleet before: where it dials no other agent, it waits to be dialled.
    """

    def __init__(self, kernel: Kernel, mesh: Mesh, hold: bool, join_s: float, comes_back: bool) -> None:
        self._kernel = kernel
        self._mesh = mesh
        self._hold = hold
        self._until_s = kernel.host.now() + join_s
        self._comes_back = comes_back
        self._tell: Callable[[Component], None] = lambda root: None

    def begin(self, root: Component, then: Callable[[], None]) -> None:
        """Looks at the fleet until its mission is known, or need not be waited for any more; then it goes on.

        Args:
            root: the root of the agent.
            then: goes on.
        """
        kernel = self._kernel
        if kernel.stopping:
            return
        if kernel.mission.held:
            missions, awaited = self._mesh.clocks.missions(self._may_say)
            left_s = self._until_s - kernel.host.now()
            if left_s > 0 and (awaited or self._awaits_peers()):
                root.after_host(min(LOOK_S, left_s), lambda: self.begin(root, then))
                return
            self._decide(missions)
        then()

    def tell(self, root: Component) -> None:
        """Tells on `log` how it came out, once there is a Log Service to hear it."""
        self._tell(root)

    def _may_say(self, peer: str) -> bool:
        return not self._kernel.access.fault(peer, "publish", MISSION)

    def _awaits_peers(self) -> bool:
        return self._mesh.awaits_peers() or (self._comes_back and not self._mesh.neighbours())

    def _decide(self, missions: tuple[PeerMission, ...]) -> None:
        kernel, speed = self._kernel, self._kernel.mission.speed
        found = mission_of_fleet(missions, speed)
        if found is not None:
            kernel.join(found.zero_s)
            bound_s = round(found.bound_s * speed, 6)
            self._tell = lambda root: root.event("mission_joined", peer=found.peer, bound_s=bound_s)
            return
        if missions:
            other = missions[0]
            text = (
                f"the mission of {other.peer} runs at speed {other.speed:g} and here at {speed:g}: its time is not"
                " taken. Set [clock] speed alike in both files, where it is to be one mission"
            )
            self._tell = lambda root: root.log("warning", text)
        if not self._hold:
            kernel.begin(0.0)
