"""The places of all tasks of one service."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pancakes.hosting.place import Place
from pancakes.hosting.standing import Standing
from pancakes.migration.record import Phase, Record, TaskId
from pancakes.slot import Slot


class Places:
    """Finds places, by tasks and by slots. In the service's actor.

    Args:
        agent: the agent's name.
        slots: the service's slots, by the names of tasks.
    """

    def __init__(self, agent: str, slots: Mapping[str, Slot]) -> None:
        self._agent = agent
        self._slots = slots
        self._places: dict[TaskId, Place] = {}
        self._by_name: dict[str, list[Place]] = {}

    def __iter__(self) -> Iterator[Place]:
        return iter(list(self._places.values()))

    def add(self, record: Record) -> Place:
        """Makes a place for a task of which there is a record."""
        place = self._places[record.task_id] = Place(record.task_id, Standing(record))
        self._by_name.setdefault(place.task_id.name, []).append(place)
        return place

    def find(self, task_id: TaskId) -> Place | None:
        """Returns the place of a task; None: this service has never heard of it."""
        return self._places.get(task_id)

    def of(self, task_id: TaskId) -> Place:
        """Returns the place of a task, and makes it where this service has never heard of the task."""
        return self._places.get(task_id) or self.add(Record(task_id))

    def named(self, name: str) -> list[Place]:
        """Returns the places of all tasks of a name: each birthplace may have one."""
        return list(self._by_name.get(name, ()))

    def id_of(self, slot: Slot) -> TaskId:
        """Returns which task a slot is for: of one that came from elsewhere, its birthplace is another agent."""
        for place in self._by_name.get(slot.name, ()):
            standing = place.standing
            if standing.leaving or standing.record.phase not in (Phase.ABSENT, Phase.RELEASED):
                return place.task_id
        return TaskId(self._agent, slot.name)

    def at(self, slot: Slot) -> Place:
        """Returns the place that a slot is part of."""
        return self.of(self.id_of(slot))

    def slot_of(self, place: Place) -> Slot | None:
        """Returns the slot of a place; None: it has none."""
        slot = self._slots.get(place.task_id.name)
        return slot if slot is not None and self.id_of(slot) == place.task_id else None
