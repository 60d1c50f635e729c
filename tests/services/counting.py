"""A task that counts its ticks, and takes the number along when it moves."""

from dataclasses import dataclass

from pancakes.task import Task, every


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1
