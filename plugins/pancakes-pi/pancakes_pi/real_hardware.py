"""Hardware is real: no virtual time moves it."""

from __future__ import annotations

from pancakes.devices.driver import DeviceContext
from pancakes.errors import PancakesError


def refuse_virtual_time(context: DeviceContext) -> None:
    """Raises PancakesError where the agent runs in virtual time."""
    if context.virtual:
        raise PancakesError(
            f"{context.agent}/device/{context.device} is real hardware, which knows no virtual time:"
            " give it a null or a sim driver there"
        )
