"""One thing that `pancakes doctor` has found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        level: `ok`; `warning`: it works, but not as it could; `error`: something does not work.
        about: what was looked at, such as `runtime directory` or `agent1/ir`.
        text: how it is.
        advice: what to do; empty where nothing is to be done.
    """

    level: Level
    about: str
    text: str
    advice: str = ""
