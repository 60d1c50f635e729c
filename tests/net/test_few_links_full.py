"""The search of test_few_links.py with more newcomers."""

from __future__ import annotations

from net.test_few_links import check_newcomer
from seeded import for_each


def test_few_links_newcomer_among_silent_agents_full():
    for_each(["z0", "z1", "z2", "z3"], check_newcomer)
