"""A filter that limits the speed of a drive (`limit`): slower on the same path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pancakes.devices import Twist
from pancakes.filters.filter import Changed, Filter
from pancakes.settings import Positive


def within(command: Twist, max_mps: float | None, max_radps: float | None) -> Twist:
    """Return a command within limits of speed and turning rate; its curvature is kept. None: no limit."""
    share = max(
        abs(command.v_mps) / max_mps if max_mps is not None else 0.0,
        abs(command.omega_radps) / max_radps if max_radps is not None else 0.0,
    )
    return command if share <= 1.0 else Twist(command.v_mps / share, command.omega_radps / share)


class Limit(Filter):
    """Slow down a drive that is commanded too fast (`limit`). The path stays the same: the curvature is kept."""

    type = "motors"

    @dataclass
    class Settings:
        """How fast it may be. At least one limit is needed.

        Attributes:
            max_mps: the fastest speed, forward and backward; None: no limit.
            max_radps: the fastest turning rate, either way; None: no limit.
        """

        max_mps: Positive | None = None
        max_radps: Positive | None = None

        def __post_init__(self) -> None:
            if self.max_mps is None and self.max_radps is None:
                raise ValueError("needs a limit: max_mps, max_radps or both")

    settings: Settings

    def apply(self, command: Twist, ttl_s: float, source: str) -> Any:
        """Return the command within the limits."""
        slower = within(command, self.settings.max_mps, self.settings.max_radps)
        return command if slower is command else Changed(slower, "too fast")
