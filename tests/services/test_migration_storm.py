"""Tasks that move in storms: never do two copies run, and at the end one does.

More seeds: `test_migration_storm_full.py`.
"""

from seeded import for_each
from services.migration_storms import (
    change_places_over_bad_links,
    change_places_while_agents_are_killed,
    stop_while_they_move,
)


def test_migration_storm_over_bad_links():
    for_each(range(2), change_places_over_bad_links)


def test_migration_storm_with_killed_agents():
    for_each(range(2), change_places_while_agents_are_killed)


def test_migration_storm_with_a_stop():
    for_each(range(2), stop_while_they_move)
