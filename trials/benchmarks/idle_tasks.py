"""The tasks of an agent that does next to nothing, and of one of which only the start is measured.

It stands for a module of a user: it is copied to where an agent finds it, and imports nothing of the benchmarks.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass

from pancakes.task import Task, Tick, every


class Started(Task):
    """Says on a file descriptor that it was ticked for the first time, and how many modules were imported by then."""

    @dataclass
    class Settings:
        report_fd: int

    def on_start(self) -> None:
        self.is_said = False

    @every(hz=1000)
    def tick(self, tick: Tick) -> None:
        """Says so once, and rests from then on."""
        self.reschedule(0)
        if not self.is_said:  # on a busy machine the second tick waits by now
            self.is_said = True
            ours = sum(name.partition(".")[0] == "pancakes" for name in list(sys.modules))
            report = {"modules": len(sys.modules), "ours": ours}
            os.write(self.settings.report_fd, f"{json.dumps(report)}\n".encode())


class Idle(Task):
    """Does next to nothing, now and then."""

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Does nothing."""
