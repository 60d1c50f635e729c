"""The verdict on the encirclement in the Robotarium: ours, and that of the laboratory's own simulator."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pancakes import PancakesError
from pancakes.tools.demo import Run
from pancakes_encirclement.verdict import finish, judge_encirclement

VERDICT: Final = "robotarium.json"
"""The file that the world leaves."""
_FAULTS: Final = {
    "collision": "two of its robots were too near to each other in {} steps",
    "boundary": "a robot was outside its floor in {} steps",
    "actuator": "wheels were commanded to run too fast in {} steps",
    "other": "it has {} other complaints",
}


def judge_robotarium(run: Run) -> dict[str, Any]:
    """Judge a mission as the experiment of the paper, and by the counts of the Robotarium's simulator.

    Args:
        run: the mission; it left `trajectory.csv`, `events.jsonl` and `robotarium.json`.

    Returns:
        The contents of `summary.json`. It passes only if both judges have nothing to complain about.

    Raises:
        PancakesError: the files or the configurations cannot be read.
    """
    ours = judge_encirclement(run)
    theirs, reasons = read_verdict(run.out / VERDICT)
    return finish({**ours, "robotarium": theirs}, [*ours["reasons"], *reasons])


def read_verdict(path: Path) -> tuple[Mapping[str, Any] | None, list[str]]:
    """Read the verdict of the Robotarium's simulator.

    Returns:
        The counts and the words of its judge; None if it left none. And the reasons for which it fails the mission.

    Raises:
        PancakesError: the file is no such verdict.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None, [f"the Robotarium's simulator left no verdict: the world did not end as it should ({path.name})"]
    except OSError as error:
        raise PancakesError(f"{path} cannot be read: {error.strerror}") from None
    try:
        found = json.loads(text)
        counts = found["counts"]
        if counts is None:
            return found, ["the judge of the Robotarium's simulator does not tell what it counted"]
        counted = {name: int(counts[name]) for name in _FAULTS}
    except (KeyError, TypeError, ValueError) as error:
        raise PancakesError(f"{path} is no verdict of the Robotarium's simulator: {error!r}") from None
    said = [text.format(counted[name]) for name, text in _FAULTS.items() if counted[name]]
    return found, [f"the Robotarium's judge: {reason}" for reason in said]
