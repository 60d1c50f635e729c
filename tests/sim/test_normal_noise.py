"""Normal noise: the numbers of `random.gauss`, in their order."""

import random

from pancakes.sim.normal import normals


def test_they_are_the_numbers_of_gauss():
    source = random.Random(7)
    normal = normals(random.Random(7))
    assert [normal() for _ in range(9)] == [source.gauss(0.0, 1.0) for _ in range(9)]
