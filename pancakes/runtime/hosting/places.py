"""The places of all tasks of one service."""

from __future__ import annotations

from collections.abc import Mapping

from pancakes.mesh.migration.record import Record, TaskId
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.hosting.standing import Standing
from pancakes.runtime.supervision.slot import Slot


class Places(dict[TaskId, Place]):
    """All places, by task, and which of them each slot belongs to. In the service's actor.

    To look up a task that the service has never heard of makes a place for it.

    Args:
        agent: the agent's name.
        slots: the service's slots, by the names of tasks.

    Attributes:
        at: the place that each slot belongs to, by the name of the task.
    """

    def __init__(self, agent: str, slots: Mapping[str, Slot]) -> None:
        super().__init__()
        self.at: dict[str, Place] = {}
        self._agent = agent
        self._slots = slots
        self._by_name: dict[str, list[Place]] = {}

    def __missing__(self, task_id: TaskId) -> Place:
        return self.open(Record(task_id))

    def open(self, record: Record) -> Place:
        """Makes a place for a task of which there is a record."""
        place = Place(record.task_id, Standing(record))
        self.keep(place)
        return place

    def keep(self, place: Place) -> None:
        """Takes a place in, unless it is there."""
        if place.task_id not in self:
            self[place.task_id] = place
            self._by_name.setdefault(place.task_id.name, []).append(place)

    def drop(self, place: Place) -> None:
        """Forgets a place where nothing has come of what was asked, and of which there is no record."""
        if self.pop(place.task_id, None) is not None:
            self._by_name[place.task_id.name].remove(place)

    def named(self, name: str) -> list[Place]:
        """Returns the places of all tasks of a name: each birthplace may have one."""
        return list(self._by_name.get(name, ()))

    def bind(self, name: str) -> None:
        """Finds out anew which place the slot of a name belongs to: a record has changed, or the slot has."""
        for place in self._by_name.get(name, ()):
            place.slot = None
        slot = self._slots.get(name)
        if slot is None:
            self.at.pop(name, None)
            return
        here = [place for place in self._by_name.get(name, ()) if place.standing.leaving or place.standing.record.here]
        place = here[0] if here else self[TaskId(self._agent, name)]
        place.slot = slot
        self.at[name] = place
