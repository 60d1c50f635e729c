"""What a process of many missions does first, in tests in which some of its missions break."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pancakes.tools.demo import monte_carlo
from pancakes.tools.demo.monte_carlo import MissionWishes


def nothing() -> None:
    """All missions run as they are."""


def some_break() -> None:
    """Seed 3 is killed, 4 ends its process, 5 fails in a way that no author thought of; the others are trivial."""
    monte_carlo.fly_unattended = _fly


def _fly(seed: int, out: Path, wishes: MissionWishes, said: list[str]) -> Mapping[str, Any]:
    if seed == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 4:
        os._exit(7)
    if seed == 5:
        raise ZeroDivisionError("by hand")
    print("a plug-in that prints")
    return {"verdict": "PASS", "reasons": [], "seed": seed, "figure": seed * 0.5}
