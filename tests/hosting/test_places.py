"""The places of a service's tasks: which are known, and to which of them a slot belongs."""

from __future__ import annotations

from pancakes.durable.hosting import Place, Places
from pancakes.durable.reconcile import Course
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.supervision.lifecycle import Life
from pancakes.supervision.restart import Restarts, RestartSpec
from pancakes.supervision.slots import Slot
from pancakes.task import Task, TaskSpec

A, Z = Identity("a"), Identity("z")
MINE, OTHERS = TaskId("a", "Scan"), TaskId("z", "Scan")


def slot() -> Slot:
    return Slot("Scan", TaskSpec("Scan", Task), "a/client/Scan", Life("a/client/Scan", Restarts(RestartSpec())))


def owned(task_id: TaskId) -> Record:
    return Record(task_id, Register(Epoch(0, A), 0, ((A,),)), A)


def left(task_id: TaskId) -> Record:
    return Record(task_id, Register(Epoch(1, Z), -1, ((Z,),)), A)


def test_a_place_that_is_dropped_is_forgotten_by_its_name_too() -> None:
    places = Places(A, {})
    place = Place(OTHERS, Course(Record(OTHERS)))
    places.drop(place)  # it was never kept
    places.keep(place)
    places.keep(place)
    assert places.named("Scan") == [place]

    places.drop(place)

    assert (places.get(OTHERS), places.named("Scan")) == (None, [])
    places.drop(place)
    assert [places[OTHERS]] == places.named("Scan")


def test_a_slot_belongs_to_the_task_that_is_here_and_else_to_the_one_that_was_born_here() -> None:
    slots = {"Scan": slot()}
    places = Places(A, slots)
    other = places.open(owned(OTHERS))

    places.bind("Scan")
    assert (places.at["Scan"], other.slot) == (other, slots["Scan"])

    other.course = Course(left(OTHERS))
    places.bind("Scan")
    assert (places.at["Scan"].task_id, places[MINE].slot, other.slot) == (MINE, slots["Scan"], None)


def test_a_slot_belongs_to_a_task_that_leaves_until_its_actor_has_ended() -> None:
    places = Places(A, {"Scan": slot()})
    mine, other = places.open(owned(MINE)), places.open(Record(OTHERS))
    mine.course = Course(left(MINE), leaving=True)

    places.bind("Scan")

    assert (places.at["Scan"], other.slot) == (mine, None)


def test_a_name_without_a_slot_belongs_to_no_task() -> None:
    slots = {"Scan": slot()}
    places = Places(A, slots)
    place = places.open(owned(MINE))
    places.bind("Scan")

    slots.clear()
    places.bind("Scan")

    assert (place.slot, places.at) == (None, {})
    places.bind("Scan")
    assert places.named("Other") == []
