"""When a task moves by itself: `[task.NAME] migrate` in the configuration. Pure."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.errors import MigrationError, describe
from pancakes.mesh.migration.cost import CostChoice

AGAIN_S: Final = 60.0


class MigrationRule(msgspec.Struct, frozen=True):
    """Moves a task when a reading passes a threshold.

    Attributes:
        when: the type of the readings to watch, on `system`.
        below: moves the task when the field lies below this.
        above: moves the task when the field lies above this.
        field: the field of the reading.
        cost: the cost function that neighbours answer with, or the weight of each of several.
        then: a task to start here once this one has gone; empty: none. Not after a take-over: the agent that had the
            task is silent then.
        otherwise: a task to start here in the place of this one, which is stopped, where no agent can take it; empty:
            it goes on.
        again_s: after no agent could take the task, the rule asks again after so long, in host time.
    """

    when: str
    below: float | None = None
    above: float | None = None
    field: str = "level"
    cost: CostChoice = "tasks"
    then: str = ""
    otherwise: str = ""
    again_s: float = AGAIN_S

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
