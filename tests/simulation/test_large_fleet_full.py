"""A larger fleet in which most agents have no link to each other."""

import os

import pytest
from simulation.large_fleet import live_through

AGENTS = int(os.environ.get("PANCAKES_LARGE_FLEET", "40"))
"""Hundreds take minutes."""


@pytest.mark.timeout(300 + 10 * AGENTS)
def test_large_fleet_with_few_links_runs_each_task_once() -> None:
    live_through(AGENTS)
