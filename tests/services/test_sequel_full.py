"""A task follows another that moved away, wherever its agent dies after the point of no return."""

from seeded import for_each
from services.sequels import follows_after_a_death


def test_sequel_follows_once_wherever_the_source_dies_full():
    for_each(range(60), follows_after_a_death)
