"""What a page shows."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from pancakes.control import Describe, Reply
from pancakes.packet import Cause
from pancakes.tools.web.feed import Feed


@dataclass(frozen=True)
class Shown:
    """What a page shows.

    Attributes:
        feed: the fleet.
        explain: returns why an agent's actuator was commanded; as `Explaining.explain`, from any thread.
        look: asks an agent what is to be known of a task, within a time limit; from any thread.
        order: asks an agent for something within a time limit; None: the page may only look.
        title: what the page is headed with; empty: the fleet's name.
    """

    feed: Feed
    explain: Callable[[str, str, float | None, Cause | None, int], dict[str, Any] | None]
    look: Callable[[str, Describe, float], Future[Reply]]
    order: Callable[[str, Any, float], Future[Reply]] | None = None
    title: str = ""
