"""The appraiser: works out what a task would cost here, with cost functions of others, which may wait or fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec

from pancakes.mesh.migration.cost import Cost, CostChoice, CostFacts, appraise
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.kernel.tell import tell

APPRAISER: Final = "kernel/Appraiser"


class Appraise(msgspec.Struct, frozen=True):
    """Asks the appraiser for a cost.

    Attributes:
        asker: the actor that gets the answer, `Appraised`.
        number: the number of the question.
        choice: the cost function, or the weight of each of several.
        facts: what they may know.
    """

    asker: Reference
    number: int
    choice: CostChoice
    facts: CostFacts


class Appraised(msgspec.Struct, frozen=True):
    """What a task would cost here.

    Attributes:
        number: the number of the question.
        terms: what the cost is made of.
        refusal: why it cannot be told, as a phrase; empty: it can.
    """

    number: int
    terms: Mapping[str, float]
    refusal: str


class Appraiser(Component):
    """Calls cost functions in a thread of its own: one that waits holds up no other actor.

    Args:
        costs: returns the cost functions that are installed, by name.
    """

    blocking = True

    def __init__(self, *args: Any, costs: Callable[[], Mapping[str, Cost]], **others: Any) -> None:
        super().__init__(*args, **others)
        self._costs = costs

    def take_message(self, message: Any) -> Any:
        if not isinstance(message, Appraise):
            return super().take_message(message)
        terms, refusal = appraise(message.choice, message.facts, self._costs())
        tell(message.asker, Appraised(message.number, terms, refusal))
        return None
