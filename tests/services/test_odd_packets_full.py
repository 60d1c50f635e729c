"""Odd values from members of the fleet end no actor of Pancakes: more seeds."""

from seeded import for_each
from services.odd_packets import say_odd_control_packets, say_odd_messages


def test_odd_control_packets_end_no_actor_full() -> None:
    for_each(range(12), say_odd_control_packets)


def test_odd_messages_end_no_actor_full() -> None:
    for_each(range(12), say_odd_messages)
