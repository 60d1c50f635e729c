"""Where a service that takes tasks in finds their classes."""

from __future__ import annotations

from typing import Protocol

from pancakes.task import Task


class Catalogue(Protocol):
    """Where task classes are found by name."""

    def find(self, type_name: str) -> tuple[type[Task], str]:
        """Returns the class of an entry point, and the version of the distribution that it comes from.

        Raises:
            PancakesError: there is none, or it cannot be loaded.
        """
        ...
