"""What happens at the place of a task that is handed over: it stands still, goes on or leaves."""

from __future__ import annotations

from functools import partial

from pancakes.errors import PancakesError
from pancakes.mesh.migration.effect import Freeze
from pancakes.mesh.migration.event import FreezeFailed, Frozen
from pancakes.mesh.migration.sequel import Sequel
from pancakes.packet import join
from pancakes.runtime.hosting.hosting_effect import TakeDown
from pancakes.runtime.hosting.hosting_event import StillOverdue, StoodStill
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.supervision.closing import STUCK_S
from pancakes.runtime.supervision.slot import Slot
from pancakes.runtime.supervision.task_messages import Carried, GoOn, StandStill


class Departures:
    """Carries out what hand-offs ask of tasks that leave one service. All in that service's actor.

    Args:
        host: the service.
    """

    def __init__(self, host: HostingService) -> None:
        self._host = host

    def freeze(self, slot: Slot, place: Place, effect: Freeze) -> StoodStill | None:
        """Has a task stand still; its actor answers `StoodStill`. Where it has none, that is returned."""
        if slot.task is None:
            return StoodStill(effect.offer, reason="it does not run")
        tell(slot.task, StandStill(effect.offer))
        self._host.after_host(STUCK_S, partial(self._host.feed_place, place, StillOverdue(effect.offer)))
        return None

    def take_down(self, slot: Slot, place: Place, effect: TakeDown) -> Frozen | FreezeFailed:
        """Writes down a task that stands still, and holds its actuators; returns what follows."""
        self._host.hold_actuators(slot, "its task is handed over")
        assert isinstance(effect.carried, Carried)
        try:
            snapshot = self._host.snapshot(slot, effect.carried, self._host.outbox.leave(place.task_id))
        except PancakesError as error:
            self._host.outbox.stay(place.task_id)
            self.let_go_on(slot)
            return FreezeFailed(effect.offer, str(error))
        self._host.event("task_frozen", task=slot.name, offer=effect.offer.n)
        move = place.move
        sequel = Sequel(move.then, move.ledger).encode() if move is not None else b""
        return Frozen(effect.offer, snapshot, sequel)

    def let_go_on(self, slot: Slot) -> None:
        """Lets a task go on that stands still."""
        if slot.task is not None:
            tell(slot.task, GoOn())

    def resume(self, place: Place, slot: Slot | None) -> None:
        """Lets a task go on that does not leave after all."""
        self._host.outbox.stay(place.task_id)
        if slot is not None and slot.task is not None:
            self._host.event("task_resumed", task=slot.name)
            self.let_go_on(slot)

    def drop(self, place: Place, slot: Slot | None, ends: bool) -> None:
        """Forgets what is owed for a task, and kept for it."""
        self._host.kernel.registry.unreserve(join(self._host.address, place.task_id.name))
        # What it was, down to the last byte of its state, is elsewhere now.
        place.came_from, place.letters, place.written, place.ask_again_s = "", None, None, 0.0
        self._host.outbox.gone(place.task_id, ends)
        if ends and slot is not None:
            # At once: what its `on_stop` may still command must not reach a wheel that the new owner's host may need.
            self._host.hold_actuators(slot, "its task was handed over")
            self._host.kernel.registry.release(slot.address)

    def vacate(self, slot: Slot) -> list[Place]:
        """A task was given away: what is left of it here is the tombstone in the journal.

        Returns:
            The places of other tasks of this name, which may wait for its slot.
        """
        slot.carried = None
        slot.mailbox.clear_data()
        if slot.fence is not None:
            self._host.outbox.ended(slot.fence.task_id)
        if slot.name not in self._host.residents:
            del self._host.slots[slot.name]
            self._host.kernel.tasks.strike_out(self._host.name, slot.name)
        return self._host.places.named(slot.name)
