"""The kernel's bounds that docs/architecture.md tells are those of the code."""

from __future__ import annotations

import pytest
from told_bounds import told

from pancakes.kernel.dispatchers import HOGGED_S, MOST_WORKERS, WATCH_S
from pancakes.kernel.handlers import MOST_BYTES


@pytest.mark.parametrize(
    "sentence, values",
    [
        (r"At most (\d+) MiB of large bodies wait for a subscription", (MOST_BYTES / 1024**2,)),
        (r"holds a thread for more than (\d+) ms", (HOGGED_S * 1e3,)),
        (r"at most (\d+) threads; looks every (\d+) ms", (MOST_WORKERS, WATCH_S * 1e3)),
    ],
)
def test_a_sentence_tells_the_bounds_that_hold(sentence: str, values: tuple[float, ...]) -> None:
    assert told(sentence) == values
