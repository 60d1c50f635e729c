"""What users derive from shows documented names only, and one private object."""

import inspect
import re
from pathlib import Path

import pykka
import pytest

from pancakes.devices.driver import Actuator, Sensor
from pancakes.durable.client_service import ClientService
from pancakes.service import Service
from pancakes.task import Task
from pancakes.testing import Fleet

GUIDES = Path(__file__).resolve().parent.parent / "docs"
OF_PYKKA = {name for name in dir(pykka.Actor) if name.startswith("_")} | {"_actor_ref", "_abc_impl"}
PRIVATE = {"_actor", "_made_as", "_is_protocol"}
"""`_made_as` says how Pancakes makes an instance, and belongs to the class; `_is_protocol` is of `typing.Generic`."""

BASES = [
    (Task, "writing-a-task.md"),
    (Service, "writing-a-task.md"),
    (ClientService, "writing-a-task.md"),
    (Sensor, "writing-a-driver.md"),
    (Actuator, "writing-a-driver.md"),
]


def names_of(cls: type) -> set[str]:
    """All names that a class has or declares, without those of every class."""
    declared = {name for one in cls.__mro__[:-1] for name in inspect.get_annotations(one)}
    return {name for name in {*dir(cls), *declared} if not (name.startswith("__") and name.endswith("__"))}


@pytest.mark.parametrize(("cls", "guide"), BASES, ids=[cls.__name__ for cls, _ in BASES])
def test_base_shows_the_names_of_its_guide_only(cls, guide):
    text = (GUIDES / guide).read_text(encoding="utf-8")
    names = names_of(cls)
    told = {name for name in names if re.search(rf"(?:\bself\.|\bdef |`){name}\b|^\s+{name}(?::| = )", text, re.M)}
    assert not {name for name in names - told if not name.startswith("_")}, f"in no line of {guide}"
    assert {name for name in names if name.startswith("_")} <= OF_PYKKA | PRIVATE


def test_object_of_a_user_has_no_other_attribute():
    class Mine(Task):
        def on_start(self):
            self.own = 1

    class Brings(Service):
        def on_start(self):
            self.own = 1

    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Mine": Mine}, services={"brings": Brings})
        for found, cls in ((agent.task("Mine"), Task), (agent.component("brings").facade, Service)):
            assert set(vars(found)) - {"own"} <= names_of(cls), f"a {cls.__name__} has been given more"
