"""Tasks that move in storms: many seeds."""

from seeded import for_each
from services.migration_storms import (
    change_places_over_bad_links,
    change_places_while_agents_are_killed,
    stop_while_they_move,
)


def test_migration_storm_over_bad_links_full():
    for_each(range(24), change_places_over_bad_links)


def test_migration_storm_with_killed_agents_full():
    for_each(range(24), change_places_while_agents_are_killed)


def test_migration_storm_with_a_stop_full():
    for_each(range(12), stop_while_they_move)
