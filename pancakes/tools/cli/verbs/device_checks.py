"""What `pancakes doctor` looks at in the devices of agents that run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from pancakes.bodies.devices.readings import share_of
from pancakes.tools.cli.verbs.finding import Finding

MISSED_SHARE: Final = 0.01
"""A device that misses more than this share of its readings is named."""


def check_device(about: str, task: Mapping[str, Any]) -> Iterator[Finding]:
    """Looks at how a device fares.

    Args:
        about: the agent and the device, such as `agent1/ir`.
        task: what its agent says of the device's task; one that is no device has no readings.
    """
    readings = task.get("readings")
    if readings is None or task["state"] != "running":
        return
    if readings["silent_s"] is not None:
        text = f"has had no reading for {readings['silent_s']:.0f} s"
        advice = "see whether its hardware is plugged in and has power, and whether what it hears is reachable"
        yield Finding("warning", about, text, advice)
    tries = readings["came"] + readings["missed"]
    if readings["missed"] > MISSED_SHARE * tries:
        share = share_of(readings["missed"], tries)
        text = (
            f"missed {readings['missed']} of {tries} readings or commands ({share}), the last one so: {readings['why']}"
        )
        yield Finding("warning", about, text, f"look at its cables and settings: pancakes task info {about}")
