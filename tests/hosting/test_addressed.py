"""What agents say to each other on `network` is for one actor: no other one takes it, and answers."""

from __future__ import annotations

from collections.abc import Iterator

import pancakes.agent.agent  # noqa: F401  # every component of an agent is imported
from pancakes.kernel.actor import Component
from pancakes.packet import NETWORK


def components(of: type[Component] = Component) -> Iterator[type[Component]]:
    for cls in of.__subclasses__():
        if cls.__module__.startswith(("pancakes.durable.", "pancakes.services.")):
            yield cls
        yield from components(cls)


def subscribed(cls: type) -> list[tuple[str, bool]]:
    marks = [mark for method in vars(cls).values() for mark in getattr(method, "__subscriptions__", ())]
    return [(mark.type, mark.addressed) for mark in marks if mark.channel == NETWORK]


def test_each_takes_what_is_addressed_to_it_alone() -> None:
    heard = {cls.__name__: subscribed(cls) for cls in components()}
    assert all(heard[name] for name in ("Registrar", "Courier", "TaskMigrator"))
    assert [(name, kind) for name, kinds in heard.items() for kind, addressed in kinds if not addressed] == []
