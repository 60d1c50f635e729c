"""What agents say to each other on `network` is for one actor: no other one takes it, and answers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import pancakes.runtime.agent  # noqa: F401  # every component of an agent is imported
from pancakes.packet import NETWORK
from pancakes.runtime.kernel.component import Component


def components(of: type[Component] = Component) -> Iterator[type[Component]]:
    for cls in of.__subclasses__():
        if cls.__module__.startswith("pancakes.runtime."):
            yield cls
        yield from components(cls)


def subscribed(cls: type) -> list[tuple[str, bool]]:
    marks = [mark for method in vars(cls).values() for mark in getattr(method, "__subscriptions__", ())]
    return [(mark.type, mark.addressed) for mark in marks if mark.channel == NETWORK]


LISTENERS = [cls for cls in components() if subscribed(cls)]


def test_those_that_speak_with_other_agents_are_found() -> None:
    assert {"ClientService", "Guardian", "Census", "Courier", "TaskMigrator"} <= {cls.__name__ for cls in LISTENERS}


@pytest.mark.parametrize("listener", LISTENERS, ids=lambda cls: cls.__name__)
def test_each_takes_what_is_addressed_to_it_alone(listener: type) -> None:
    assert [kind for kind, addressed in subscribed(listener) if not addressed] == []
