"""Whatever a member of the fleet says, with whatever values: no actor that Pancakes brings fails on it.

What of Pancakes itself fails, fails the test: see docs/testing.md, "What may not fail". `test_odd_packets_full.py` has
more seeds.
"""

from seeded import for_each
from services.odd_packets import say_odd_control_packets, say_odd_messages


def test_odd_control_packets_end_no_actor() -> None:
    for_each(range(3), say_odd_control_packets)


def test_odd_messages_end_no_actor() -> None:
    for_each(range(3), say_odd_messages)
