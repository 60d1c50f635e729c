"""The time of day of a real agent is set forward while it has a guarded task."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torture.live import LiveFleet

from pancakes.client import Client, Target
from pancakes.control import Guarding
from pancakes.errors import PancakesError

NAMES = ("a", "b", "c")
PATIENCE_S = 60.0
STEPPED = """
real_time = time.time
time.time = lambda: real_time() + (60.0 if os.path.exists("THE_DIRECTORY/stepped") else 0.0)
"""
"""A time of day that is set forward by a minute once a file is there: that of the machine is not a test's to set."""


def wait_until(condition: Callable[[], Any]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_clock_step_pauses_a_guarded_task_until_guardians_answer(tmp_path: Path) -> None:
    """And it goes on under the same epoch."""
    task = '[task.One]\ntype = "torture.Holder"\nguard = { copies = 3, lease_s = 10.0, takeover = "ask" }\n'
    rest = {"a": f'{task}settings = {{directory = "{tmp_path}"}}\n'}
    listen = {name: f"local://{tmp_path}/{name}" for name in NAMES}
    fleet = LiveFleet(tmp_path, NAMES, rest, listen, spoilt_by=STEPPED.replace("THE_DIRECTORY", str(tmp_path)))
    try:
        for name in NAMES:
            fleet.start(name, wait=True)
        with Client(Target((listen["a"],), "torture"), PATIENCE_S) as client:

            def row() -> dict[str, Any]:
                try:
                    rows = client.request("a", Guarding()).result
                except PancakesError:  # it has just begun
                    return {}
                return dict(rows[0]) if rows else {}

            wait_until(lambda: len(row().get("guardians", ())) == 3)
            fleet.running["a"].hear("permit_given task=One")
            (tmp_path / "stepped").touch()
            fleet.running["a"].hear("the time of day of a was set forward by 60.0 s")
            acts = (tmp_path / "One.count").stat().st_size
            wait_until(lambda: (tmp_path / "One.count").stat().st_size > acts)
            now = row()
            assert (now["clock_steps"], now["epoch"]) == (1, "0@a") and now["permit_s"] > 0
    finally:
        fleet.close()
