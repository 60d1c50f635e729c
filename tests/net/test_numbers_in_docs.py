"""The bounds that docs/architecture.md tells are those of the code."""

from __future__ import annotations

import pytest
from told_bounds import told

from pancakes.mesh.link import LinkTimes
from pancakes.mesh.peers import MAX_AGENTS, MAX_CLIENTS, MOST_DIALS, MOST_OF_PEER

TIMES = LinkTimes()


@pytest.mark.parametrize(
    "sentence, values",
    [
        (r"each agent: (\d+) agents, (\d+) of each peer", (MAX_AGENTS, MOST_OF_PEER)),
        (r"(\d+) dials at a time, (\d+) clients", (MOST_DIALS, MAX_CLIENTS)),
        (
            r"Heartbeats every ([\d.]+) s; four missed, or (\d+) s in which it takes no byte",
            (TIMES.heartbeat_s, TIMES.stuck_s),
        ),
        (
            r"dialled again after ([\d.]+) s, doubling to (\d+) s",
            (TIMES.retry_first_s, TIMES.retry_longest_s),
        ),
    ],
)
def test_a_sentence_tells_the_bounds_that_hold(sentence: str, values: tuple[float, ...]) -> None:
    assert told(sentence) == values
