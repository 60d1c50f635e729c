"""Which packets a task never got although they came for it. Pure."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from pancakes.packet import Cause
from pancakes.tools.replay.steps import Change, Given


class Overtaken:
    """Tells which packets fell out of the task's mailbox before the task handled them. No recording says so by itself.

    Args:
        steps: the packets that arrived, and the changes.
        limits: how many packets of a type on a channel wait at most.
        handled: packets that had an effect, so that they were handled for sure.
        close_s: no task is surely given a turn in less mission time than this.
    """

    def __init__(
        self,
        steps: Iterable[Given | Change],
        limits: Mapping[tuple[str, str], int],
        handled: Collection[Cause],
        close_s: float,
    ) -> None:
        self._limits = limits
        self._handled = handled
        self._close_s = close_s
        self._given: dict[tuple[str, str], list[Given]] = {}
        self._number: dict[int, int] = {}
        for step in steps:
            if isinstance(step, Given) and not step.letter:
                alike = self._given.setdefault((step.packet.channel, step.packet.type), [])
                self._number[id(step)] = len(alike)
                alike.append(step)

    def fell_out(self, step: Given | Change) -> bool:
        """Returns whether newer packets of its type took a packet's place."""
        if not isinstance(step, Given) or step.letter or self._is_handled(step):
            return False
        key = (step.packet.channel, step.packet.type)
        limit = self._limits.get(key)
        last = self._number[id(step)] + (limit or 0)
        if limit is None or last >= len(self._given[key]):
            return False
        newer = self._given[key][last]
        if newer.published_s < step.time_s:
            return True  # the task was busy with something else until after that
        # Several at once of the same source, of which only the last had an effect.
        while limit == 1 and newer.packet.source == step.packet.source and self._at_once(step, newer):
            if self._is_handled(newer):
                return True
            last += 1
            if last >= len(self._given[key]):
                break
            step, newer = newer, self._given[key][last]
        return False

    def came_late(self, step: Given | Change, end_s: float) -> bool:
        """Returns whether a packet came too late to be handled, when the task may have ended."""
        return isinstance(step, Given) and step.published_s > end_s and not self._is_handled(step)

    def _at_once(self, one: Given, other: Given) -> bool:
        return other.published_s - one.published_s <= self._close_s

    def _is_handled(self, given: Given) -> bool:
        return (given.packet.source, given.packet.seq) in self._handled
