"""The program in two variables: against a general solver, and its own properties."""

from __future__ import annotations

import math
import random

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qpsolvers import solve_qp

from pancakes.filters.half_planes import HalfPlane, least_bad, nearest


def random_planes(source: random.Random, count: int, least: float, most: float) -> list[HalfPlane]:
    angles = (source.uniform(-math.pi, math.pi) for _ in range(count))
    return [HalfPlane(math.cos(a), math.sin(a), source.uniform(least, most)) for a in angles]


def by_daqp(x: float, y: float, planes: list[HalfPlane]) -> numpy.ndarray | None:
    """Minimizes |z - (x, y)|² as a general solver does: -n z <= -c."""
    rows, bounds = -numpy.array([it[:2] for it in planes]), -numpy.array([it.c for it in planes])
    return solve_qp(numpy.eye(2), -numpy.array([x, y]), rows, bounds, solver="daqp")


@pytest.mark.parametrize("seed", range(300))
def test_nearest_agrees_with_a_general_solver(seed: int) -> None:
    source = random.Random(seed)
    x, y = source.uniform(-1.0, 1.0), source.uniform(-1.0, 1.0)
    planes = random_planes(source, 1 + seed % 18, -0.6, 0.1 if seed % 2 else 0.0)
    found, expected = nearest(x, y, planes), by_daqp(x, y, planes)
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        assert found == pytest.approx(tuple(expected), abs=1e-6)


@pytest.mark.parametrize("seed", range(100))
def test_least_bad_agrees_with_a_general_solver(seed: int) -> None:
    """The least slack of all: a linear program in three variables, with a little weight on the distance."""
    source = random.Random(seed)
    x, y = source.uniform(-0.3, 0.3), source.uniform(-0.3, 0.3)
    hard, soft = random_planes(source, 4, -0.3, -0.1), random_planes(source, 2 + seed % 9, -0.1, 0.4)
    found_x, found_y = least_bad(x, y, hard, soft)
    assert all(it.nx * found_x + it.ny * found_y >= it.c - 1e-6 for it in hard)
    slack = max(0.0, *(it.c - it.nx * found_x - it.ny * found_y for it in soft))
    rows = [[-it.nx, -it.ny, 0.0] for it in hard] + [[-it.nx, -it.ny, -1.0] for it in soft] + [[0.0, 0.0, -1.0]]
    bounds = [-it.c for it in (*hard, *soft)] + [0.0]
    weights = numpy.diag([1e-7, 1e-7, 1e-7])
    best = solve_qp(weights, numpy.array([0.0, 0.0, 1.0]), numpy.array(rows), numpy.array(bounds), solver="daqp")
    assert best is not None and slack <= best[2] + 2e-4


COORDINATE = st.floats(-2.0, 2.0, allow_nan=False)
PLANES = st.lists(st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.0, 1.0)), max_size=20)


@given(COORDINATE, COORDINATE, PLANES)
def test_nearest_lies_in_all_half_planes(x: float, y: float, given_planes: list[tuple[float, float]]) -> None:
    planes = [HalfPlane(math.cos(a), math.sin(a), c) for a, c in given_planes]
    found = nearest(x, y, planes)
    if found is None:
        assert by_daqp(x, y, [HalfPlane(nx, ny, c + 1e-6) for nx, ny, c in planes]) is None
    else:
        assert all(nx * found[0] + ny * found[1] >= c - 1e-6 for nx, ny, c in planes)


def test_nearest_of_no_half_planes_is_the_point() -> None:
    assert nearest(0.3, -0.2, []) == (0.3, -0.2)
    assert least_bad(0.3, -0.2, [], []) == (0.3, -0.2)
