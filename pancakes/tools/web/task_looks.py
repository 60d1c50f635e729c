"""What a page shows of one task while a person looks at it: its state, its settings and its timers."""

from __future__ import annotations

import asyncio
from typing import Any, Final

from pancakes.control import Describe, Reply
from pancakes.errors import ControlRefused, NoAnswer, PancakesError
from pancakes.tools.short_state import ShortState
from pancakes.tools.web.setting_fields import fields_of
from pancakes.tools.web.shown import Shown

AGAIN_S: Final = 0.5
"""An agent is asked about a task no more often than that, however many pages look at it."""
LOOK_S: Final = 3.0
"""How long an agent may take; a task tells its state in its own turn, and may be busy."""
NEVER_SEEN: Final = "the timeline has no state of it at this moment: states are seen while a page shows the task, \
and every ten seconds"


class TaskLooks:
    """Asks agents about tasks, for any number of pages. In the thread of the page's server."""

    def __init__(self) -> None:
        self._asked: dict[tuple[str, str], tuple[Shown, float, asyncio.Task[dict[str, Any]]]] = {}

    async def look(self, shown: Shown, agent: str, target: str, t: float | None) -> dict[str, Any]:
        """Returns what there is to be known of a task.

        That is `state`: its `rows`, whether they are `cut`, and at what moment `t` of the timeline it was seen with
        them; None, and the sentence `no_state`, where it is not known. And of the present `settings` with the number
        of those that are `left_out` (see `fields_of`), and `timers`.

        Args:
            shown: what the pages show.
            agent: the agent's name.
            target: the task, as `service/task`.
            t: a moment of the timeline; None: the present.

        Raises:
            PancakesError: its agent refuses, or does not answer, and the timeline has no state of it.
        """
        if t is not None:
            state = _seen(shown, agent, target, t)
            return {"state": state, "no_state": "" if state else NEVER_SEEN}
        now_s = asyncio.get_running_loop().time()
        self._asked = {key: row for key, row in self._asked.items() if not row[2].done() or now_s - row[1] < AGAIN_S}
        known = self._asked.get((agent, target))
        if known is None or known[0] is not shown:
            asking = asyncio.ensure_future(_look(shown, agent, target))
            asking.add_done_callback(lambda done: done.cancelled() or done.exception())  # the page may have gone
            self._asked[agent, target] = known = shown, now_s, asking
        # One page that goes away ends no question of another.
        return await asyncio.shield(known[2])


async def _look(shown: Shown, agent: str, target: str) -> dict[str, Any]:
    try:
        told, no_state = await _described(shown, agent, target)
    except PancakesError as error:
        state = _seen(shown, agent, target, shown.feed.now())
        if state is None:
            raise
        return {"state": state, "no_state": str(error)}
    if not no_state:
        shown.feed.take_detail(agent, told)
    settings, left_out = fields_of(told["settings_schema"], told["settings"])
    return {
        "state": None if no_state else _seen(shown, agent, target, shown.feed.now()),
        "no_state": no_state,
        "settings": settings,
        "left_out": left_out,
        "timers": [{key: timer[key] for key in ("timer", "rate_hz", "ticks", "missed")} for timer in told["timers"]],
    }


async def _described(shown: Shown, agent: str, target: str) -> tuple[dict[str, Any], str]:
    """Returns what an agent says of a task, and why its state is not among it; empty: it is.

    Raises:
        PancakesError: it says nothing of it.
    """
    try:
        reply = await _asked(shown, agent, Describe(target, state=True))
        no_state = reply.reason
    except NoAnswer:
        no_state = f"{agent}/{target} has not told its state within {LOOK_S:g} s: it may be busy"
    if not no_state:
        return reply.result, ""
    reply = await _asked(shown, agent, Describe(target))
    if not reply.ok:
        raise ControlRefused(reply.reason)
    return reply.result, no_state


async def _asked(shown: Shown, agent: str, body: Describe) -> Reply:
    asked_for = asyncio.wrap_future(shown.look(agent, body, LOOK_S))
    try:
        return await asyncio.wait_for(asked_for, 2 * LOOK_S)
    except TimeoutError:
        raise NoAnswer(f"{agent} did not answer in time") from None


def _seen(shown: Shown, agent: str, target: str, t: float) -> dict[str, Any] | None:
    with shown.feed.lock:
        found = shown.feed.states.at(f"{agent}/{target}", t)
    if found is None:
        return None
    seen_s, state = found
    return _plain(seen_s, state)


def _plain(seen_s: float, state: ShortState) -> dict[str, Any]:
    return {"t": round(seen_s, 3), "rows": state.rows, "cut": state.cut}
