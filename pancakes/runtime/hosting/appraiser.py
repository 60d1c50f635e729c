"""The appraiser: works out what a task would cost here, with cost functions of others, which may wait or fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec

from pancakes.errors import MigrationError
from pancakes.mesh.migration.cost import Asked, Cost, CostChoice, cost_of, cost_text, fault_of
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.kernel.tell import tell

APPRAISER: Final = "appraiser"


class Appraise(msgspec.Struct, frozen=True):
    """Asks the appraiser for a cost.

    Attributes:
        asker: the actor that gets the answer, `Appraised`.
        number: the number of the question.
        choice: the cost function, or the weight of each of several.
        asked: what they may know.
    """

    asker: Reference
    number: int
    choice: CostChoice
    asked: Asked


class Appraised(msgspec.Struct, frozen=True):
    """What a task would cost here.

    Attributes:
        number: the number of the question.
        terms: what the cost is made of.
        refusal: why it cannot be told, as a phrase; empty: it can.
    """

    number: int
    terms: Mapping[str, float] = {}
    refusal: str = ""


class Appraiser(Component):
    """Calls cost functions in a thread of its own: one that waits holds up no other actor.

    Args:
        costs: returns the cost functions that are installed, by name.
    """

    blocking = True

    def __init__(self, *args: Any, costs: Callable[[], Mapping[str, Cost]], **others: Any) -> None:
        super().__init__(*args, **others)
        self._costs = costs

    def on_receive(self, message: Any) -> Any:
        if not isinstance(message, Appraise):
            return super().on_receive(message)
        tell(message.asker, appraised(message.number, message.choice, message.asked, self._costs()))
        return None


def appraised(number: int, choice: CostChoice, asked: Asked, costs: Mapping[str, Cost]) -> Appraised:
    """Works out what a task would cost."""
    function = f"its cost function {cost_text(choice)!r}"
    try:
        terms = dict(cost_of(choice, costs).terms(asked))
        cost = sum(terms.values())
    except MigrationError as error:
        return Appraised(number, refusal=f"cannot tell its cost: {error}")
    except Exception as error:  # a cost function is a plug-in, and may raise anything
        return Appraised(number, refusal=f"{function} failed: {type(error).__name__}: {error}")
    if not all(isinstance(name, str) and type(value) in (int, float) for name, value in terms.items()):
        return Appraised(number, refusal=f"{function} told no numbers by name, but {terms!r:.80}")
    if fault := fault_of(cost, terms):
        return Appraised(number, refusal=f"{function} is of no use: {fault}")
    return Appraised(number, terms)
