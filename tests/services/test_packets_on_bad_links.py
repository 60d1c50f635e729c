"""Packets that are addressed to a task reach it in order and once, over bad links, while tasks move and agents die.

A few voyages each; `test_packets_on_bad_links_full.py` has many more.
"""

from seeded import for_each
from services.numbered import Source
from services.voyages import (
    bad_links,
    failures_of_the_task,
    killed_agents,
    killed_agents_of_a_lazy_task,
    moves_of_the_source,
)

from pancakes.task import every

CASES = [(0, "lazy"), (1, "each")]
"""Seeds and durabilities."""


class SlowSource(Source):
    """Sends less, so that a voyage takes less time."""

    @every(hz=10)
    def send(self, tick):
        super().send(tick)


def test_packets_arrive_in_order_from_a_source_that_moves():
    for_each(CASES, lambda case: moves_of_the_source(case[0], case[1], SlowSource))


def test_packets_arrive_once_and_in_order_over_bad_links():
    for_each(CASES, lambda case: bad_links(case[0], case[1], SlowSource))


def test_packets_arrive_once_while_the_task_fails():
    for_each(CASES, lambda case: failures_of_the_task(case[0], case[1], SlowSource))


def test_packets_arrive_once_while_agents_are_killed():
    for_each(range(2), lambda seed: killed_agents(seed, SlowSource))


def test_packets_to_a_lazy_task_are_never_doubled():
    for_each(range(2), lambda seed: killed_agents_of_a_lazy_task(seed, SlowSource))
