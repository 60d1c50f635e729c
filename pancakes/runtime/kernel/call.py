"""A function that waits in a control lane for its turn."""

from __future__ import annotations

from collections.abc import Callable

from pancakes.runtime.kernel.mailbox import Runnable


class Call:
    """A function to be called in a component's turn, and in no turn of its successor's."""

    __slots__ = ("component", "function")

    def __init__(self, component: Runnable, function: Callable[[], None]) -> None:
        self.component = component
        self.function = function
