"""One sweep of a ring of sensors that each speak for themselves. Pure."""

from __future__ import annotations

from typing import Final

Measured = tuple[float, float]
"""A distance, and the full range of the sensor."""
PATIENCE: Final = 3
"""A sensor that says nothing while another one speaks so often is not waited for, until it speaks again."""


class Sweeps:
    """Puts together what the sensors of a ring measure.

    A sweep is complete when each sensor has spoken. One that measures nothing, or says nothing, is left out of it: the
    others are readings all the same.

    Args:
        count: how many sensors there are.

    Attributes:
        silent: those that are not waited for.
    """

    def __init__(self, count: int) -> None:
        self._all = frozenset(range(count))
        self._sweep: dict[int, Measured | None] = {}
        self._spoke = [0] * count
        self.silent: frozenset[int] = frozenset()

    def heard(self, number: int, measured: Measured | None) -> dict[int, Measured] | None:
        """A sensor has spoken.

        Args:
            number: the sensor.
            measured: what it measures; None: nothing.

        Returns:
            The sweep that is complete with this, in the order of the sensors; None: it is not complete.
        """
        self.silent -= {number}
        self._sweep[number] = measured
        self._spoke[number] += 1
        missing = self._all - self.silent - self._sweep.keys()
        if missing and self._spoke[number] < PATIENCE:
            return None
        self.silent |= missing
        found = {it: told for it in sorted(self._sweep) if (told := self._sweep[it]) is not None}
        self._sweep.clear()
        self._spoke = [0] * len(self._spoke)
        return found
