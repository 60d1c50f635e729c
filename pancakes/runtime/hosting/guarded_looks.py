"""Has the guarded tasks of a service written down: all with the same period at the same moments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.place import Place


class GuardedLooks:
    """Looks at guarded tasks. All in the service's actor.

    Their checkpoints share packets, and rounds of the disk.

    Args:
        host: the service.
        held: the places of its guarded tasks, which change.
        save: has tasks written down where they have changed, by name.
    """

    def __init__(self, host: HostingService, held: Iterable[Place], save: Callable[[Sequence[str]], None]) -> None:
        self._host = host
        self._held = held
        self._save = save
        self._periods: set[float] = set()

    def begin(self, place: Place) -> None:
        """Looks at a task now."""
        self._look_at([place])

    def go_on(self, place: Place) -> None:
        """Looks at a task again and again; its period may be another one since."""
        assert place.tenancy is not None
        every_s = place.tenancy.checkpoint_s
        if every_s in self._periods:
            return
        self._periods.add(every_s)
        to_next_s = every_s - self._host.kernel.host.now() % every_s
        if to_next_s < every_s / 2:  # it may be next to nothing, as numbers are rounded
            to_next_s += every_s
        self._host.after_host(to_next_s, partial(self._look_at_all, every_s))

    def _look_at_all(self, every_s: float) -> None:
        self._periods.discard(every_s)
        places = [it for it in self._held if it.tenancy is not None and it.tenancy.checkpoint_s == every_s]
        self._look_at(places)
        if places:
            self.go_on(places[0])

    def _look_at(self, places: Sequence[Place]) -> None:
        self._save([place.slot.name for place in places if place.slot is not None])
        for place in places:
            self._look_at_actuators(place)

    def _look_at_actuators(self, place: Place) -> None:
        slot, tenancy = place.slot, place.tenancy
        if slot is None or tenancy is None:
            return
        unsafe = frozenset(self._host.kernel.registry.without_dead_man(slot.address))
        for device in sorted(unsafe - tenancy.unsafe):
            self._host.log(
                "warning",
                f"{slot.address} is guarded and commands {device}, whose hardware does not hold by itself: where this"
                " process is stopped or killed, it keeps its last command",
            )
            self._host.event("no_dead_man", task=slot.name, device=device)
        tenancy.unsafe = unsafe
