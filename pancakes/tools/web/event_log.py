"""The newest of what happened, numbered, each thing once. Pure."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Final

from pancakes.client.sentences import is_quiet, sentence_of

MOST: Final = 2000
"""The most events that are kept; then the oldest is forgotten."""
LONGEST: Final = 400
"""A sentence is cut after so many characters."""
SHOWN: Final = (
    "task",
    "task_id",
    "source_agent",
    "cost",
    "winner",
    "outcome",
    "level",
    "by",
    "lines",
    "to",
)
"""What a page gets of an event's own fields, besides its sentence."""


class EventLog:
    """Events and lines of the agents' logs, as a page shows them.

    Args:
        limit: see `MOST`.

    Attributes:
        count: how many there were; the newest bears this number.
    """

    def __init__(self, limit: int = MOST) -> None:
        self.count = 0
        self._limit = limit
        self._kept: OrderedDict[tuple[str, float, str, str], dict[str, Any]] = OrderedDict()

    def add(self, record: Mapping[str, Any], timeline_s: float) -> bool:
        """Takes a record of a log.

        Args:
            record: see `pancakes.runtime.services.log_record.record_of`.
            timeline_s: where it lies on the timeline.

        Returns:
            Whether it is new: what was said while an agent could not be heard may come twice.
        """
        text = sentence_of(record)
        if len(text) > LONGEST:
            text = text[: LONGEST - 1] + "…"
        key = (str(record["source"]), float(record["t_s"]), str(record["kind"]), text)
        if key in self._kept:
            return False
        self.count += 1
        shown = {name: record[name] for name in SHOWN if name in record}
        self._kept[key] = {
            "n": self.count,
            "t": round(timeline_s, 3),
            "m": round(float(record["t_s"]), 3),
            "agent": record["agent"],
            "kind": record["kind"],
            "text": text,
            "quiet": is_quiet(record),
            **shown,
        }
        if len(self._kept) > self._limit:
            self._kept.popitem(last=False)
        return True

    def since(self, number: int) -> list[dict[str, Any]]:
        """Returns those after a number that are still kept, oldest first."""
        found = []
        for it in reversed(self._kept.values()):
            if it["n"] <= number:
                break
            found.append(it)
        return found[::-1]
