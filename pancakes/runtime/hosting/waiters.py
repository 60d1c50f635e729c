"""Requests that wait for the journal, or for guardians: their senders hear in time what they wait for."""

from __future__ import annotations

from typing import Final

from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.machine import settled
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.life.life import State
from pancakes.runtime.life.request import Request

JOURNAL_S: Final = 1.5
"""The sender of a request that waits for the journal is told so after this time, in host time."""
GUARDIANS_S: Final = 4.0
"""That of one that waits for guardians is told so after this time, in host time."""
LOOK_AGAIN_S: Final = 0.25
"""What the journal has begun to write meanwhile may fail a moment later."""


class Waiters:
    """Looks after the requests to one service. All in that service's actor.

    Args:
        host: the service.
        records: knows what keeps a record from being written.
    """

    def __init__(self, host: HostingService, records: Records) -> None:
        self._host = host
        self._records = records

    def look_after(self, place: Place, request: Request) -> None:
        """Sees to it that a request about a task is answered, where that waits for the journal or for guardians.

        What was asked for is done all the same once the journal can write, or more than half of them answer.
        """
        self._host.after_host(JOURNAL_S, lambda: self._look(place, request))
        if place.standing.record.guarded:
            self._host.after_host(GUARDIANS_S, lambda: self._look_at_guardians(place, request))

    def _look(self, place: Place, request: Request) -> None:
        host, standing = self._host, place.standing
        if not host.waits(request):
            return
        trouble = "" if settled(standing) else standing.trouble or self._records.trouble(place.task_id)
        if not trouble:
            host.after_host(LOOK_AGAIN_S, lambda: self._look(place, request))
            return
        slot = place.slot
        what = slot.how_it_is if slot is not None else str(place.task_id)
        host.put_off(
            request, f"{what}; what was asked for waits: {trouble}. It is done as soon as the journal can write"
        )

    def _look_at_guardians(self, place: Place, request: Request) -> None:
        host, slot, record = self._host, place.slot, place.standing.record
        starts = slot is not None and slot.life.state in (State.ASKED, State.CALLED_OFF)
        if slot is None or not starts or not record.guarded or place.permit or not host.waits(request):
            return
        others = ", ".join(sorted({one.agent for one in record.guards.members()} - {host.agent}))
        host.put_off(
            request,
            f"{slot.how_it_is}; what was asked for waits for its guardians ({others}). It is done"
            " once more than half of them answer",
        )
