"""Packets that are addressed to a task reach it in order and once: many voyages, with a source that sends quickly."""

import pytest
from seeded import for_each
from services.voyages import (
    bad_links,
    failures_of_the_task,
    killed_agents,
    killed_agents_of_a_lazy_task,
    moves_of_the_source,
)

DURABILITIES = pytest.mark.parametrize("durability", ["lazy", "each"])


@DURABILITIES
def test_packets_arrive_in_order_from_a_source_that_moves_full(durability):
    for_each(range(6), lambda seed: moves_of_the_source(seed, durability))


@DURABILITIES
def test_packets_arrive_once_and_in_order_over_bad_links_full(durability):
    for_each(range(15), lambda seed: bad_links(seed, durability))


@DURABILITIES
def test_packets_arrive_once_while_the_task_fails_full(durability):
    for_each(range(8), lambda seed: failures_of_the_task(seed, durability))


def test_packets_arrive_once_while_agents_are_killed_full():
    for_each(range(24), killed_agents)


def test_packets_to_a_lazy_task_are_never_doubled_full():
    for_each(range(24), killed_agents_of_a_lazy_task)
