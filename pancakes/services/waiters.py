"""Those who asked for something that has to wait for the journal: each hears in time what it waits for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pancakes.migration.record import TaskId
from pancakes.request import Request
from pancakes.services.records import Records

if TYPE_CHECKING:
    from pancakes.services.recorded import RecordedService

ANSWERED_S: Final = 1.5
"""Who asked for something that waits for the journal is told so after this time, in host time."""
LOOK_AGAIN_S: Final = 0.25
"""What the journal has begun to write meanwhile may fail a moment later."""


class Waiters:
    """Looks after the requests to one service. All in that service's actor.

    Args:
        service: whose requests they are.
        records: knows what keeps a record from being written.
    """

    def __init__(self, service: RecordedService, records: Records) -> None:
        self._service = service
        self._records = records

    def look_after(self, task_id: TaskId, request: Request) -> None:
        """Sees to it that who asked for something that concerns a task is answered, where that waits for the journal.

        What was asked for is done all the same once the journal can write.
        """
        self._service.after_host(ANSWERED_S, lambda: self._look(task_id, request))

    def _look(self, task_id: TaskId, request: Request) -> None:
        service = self._service
        if not service.waits(request):
            return
        hand_off = service.hand_off(task_id)
        trouble = "" if hand_off.settled else hand_off.trouble or self._records.trouble(task_id)
        if not trouble:
            self._service.after_host(LOOK_AGAIN_S, lambda: self._look(task_id, request))
            return
        slot = service.slots.get(task_id.name)
        what = f"{slot.address} is {slot.life.word}" if slot is not None else str(task_id)
        service.put_off(
            request, f"{what}; what was asked for waits: {trouble}. It is done as soon as the journal can write"
        )
