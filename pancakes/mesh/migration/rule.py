"""When a task moves by itself: `[task.NAME] migrate` in the configuration. Pure."""

from __future__ import annotations

import msgspec

from pancakes.errors import MigrationError, describe
from pancakes.mesh.migration.cost import CostChoice

ASK_AGAIN_S = 60.0
"""After no agent could take the task, the rule asks again only after this time."""


class MigrationRule(msgspec.Struct, frozen=True):
    """Moves a task when a reading passes a threshold.

    Attributes:
        when: the type of the readings to watch, on `system`.
        below: moves the task when the field lies below this.
        above: moves the task when the field lies above this.
        field: the field of the reading.
        cost: the cost function that neighbours answer with, or the weight of each of several.
        then: a task to start here once this one has gone; empty: none.
    """

    when: str
    below: float | None = None
    above: float | None = None
    field: str = "level"
    cost: CostChoice = "tasks"
    then: str = ""

    def met_by(self, reading: object) -> bool:
        """Returns whether a reading (a packet's body) asks for a move.

        Raises:
            MigrationError: its field cannot be read.
        """
        try:
            value = reading.get(self.field) if isinstance(reading, dict) else getattr(reading, self.field, None)
        except Exception as error:  # a property of a plug-in's packet may raise anything
            raise MigrationError(f"the {self.field} of {self.when} cannot be read: {describe(error)}") from None
        if not isinstance(value, (int, float)):
            return False
        return (self.below is not None and value < self.below) or (self.above is not None and value > self.above)
