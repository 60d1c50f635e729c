"""Agents are killed between any two steps of a move, and after any of some delays."""

from seeded import for_each
from services.test_migration import KILLS, kill_during_a_move


def test_migration_leaves_one_copy_if_agents_are_killed_full():
    for_each(KILLS, kill_during_a_move)
