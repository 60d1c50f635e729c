"""Normal noise: the numbers of `random.gauss`, in their order."""

import random
from itertools import islice

from pancakes.sim.normal import normals


def test_they_are_the_numbers_of_gauss():
    source = random.Random(7)
    assert list(islice(normals(random.Random(7)), 9)) == [source.gauss(0.0, 1.0) for _ in range(9)]
