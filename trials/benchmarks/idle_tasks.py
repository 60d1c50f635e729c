"""The tasks of an agent that does next to nothing, and of one of which only the start is measured."""

from __future__ import annotations

import os
from dataclasses import dataclass

from pancakes.task import Task, Tick, every


class Started(Task):
    """Says on a file descriptor that it was ticked for the first time."""

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
            os.write(self.settings.report_fd, b"{}\n")


class Idle(Task):
    """Does next to nothing, now and then."""

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Does nothing."""
