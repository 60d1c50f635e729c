"""Letters to a task over a bad network: many seeds."""

from migration.bad_networks import post_over_a_bad_network
from seeded import for_each


def test_post_over_a_bad_network_arrives_once_and_in_order_full():
    for_each(range(50), post_over_a_bad_network)
