"""A fleet in which most agents have no link to each other; `test_large_fleet_full` has a larger one."""

from simulation.large_fleet import live_through


def test_fleet_with_few_links_runs_each_task_once() -> None:
    live_through(24)
