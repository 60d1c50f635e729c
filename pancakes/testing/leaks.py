"""What a test has left behind: threads, actors, sockets, open files."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pancakes.runtime.clock import MonotonicClock

if TYPE_CHECKING:
    from pancakes.testing.agent_in_test import AgentInTest

PATIENCE_S = 2.0
"""How long, in seconds of the host, what was told to end may take for that."""
LOOK_S = 0.01
DESCRIPTORS = "/proc/self/fd"


class Leaks:
    """Compares what there is with what there was when this object was made.

    Threads and open files count for the whole process; actors only for the agents that it watches.
    """

    def __init__(self) -> None:
        self._threads = threading.enumerate()
        self._open = _open_descriptors()
        self._agents: list[Callable[[], Iterable[AgentInTest]]] = []

    def watch(self, agents: Callable[[], Iterable[AgentInTest]]) -> None:
        """Tells of agents that should have ended; `agents` is asked for them each time."""
        self._agents.append(agents)

    def agents(self) -> list[AgentInTest]:
        """Returns the agents that it watches."""
        return [agent for ask in self._agents for agent in ask()]

    def left(self, at_most_s: float = PATIENCE_S) -> str:
        """Waits until nothing is left, or the time is up, and says what is left then; empty: nothing."""
        clock = MonotonicClock()
        until_s = clock.now() + at_most_s
        collected = False
        pause = threading.Event()
        while True:
            left = self._left()
            if not left or clock.now() >= until_s:
                return left
            if not collected:
                # Slow, and therefore not for tests that are clean: objects without a reference are closed.
                gc.collect()
                collected = True
                continue
            pause.wait(LOOK_S)

    def _left(self) -> str:
        threads = [thread.name for thread in threading.enumerate() if thread not in self._threads]
        actors = [address for agent in self.agents() for address in agent.left()]
        before = set(self._open)
        files = [
            f"{target} (descriptor {number})"
            for number, target in _open_descriptors()
            if (number, target) not in before
        ]
        kinds = (("threads", threads), ("actors", actors), ("sockets and files", files))
        return "; ".join(f"{kind} are left: {', '.join(names)}" for kind, names in kinds if names)


def _open_descriptors() -> list[tuple[int, str]]:
    """Returns the open file descriptors of this process, and what they lead to; nothing where Linux does not tell."""
    found = []
    try:
        numbers = sorted(int(name) for name in os.listdir(DESCRIPTORS))
    except OSError:
        return []
    for number in numbers:
        try:
            found.append((number, os.readlink(f"{DESCRIPTORS}/{number}")))
        except OSError:
            continue  # the one that the listing itself had open
    return found


@contextmanager
def no_leak(at_most_s: float = PATIENCE_S) -> Iterator[Leaks]:
    """Fails where threads, sockets or files that came to be inside of the `with` are still there shortly after it.

    Agents that the `Leaks` watches must have ended too, with all of their actors.

    Args:
        at_most_s: how long, in seconds of the host, they may take to end.

    Raises:
        AssertionError: names what is left.
    """
    leaks = Leaks()
    yield leaks
    left = leaks.left(at_most_s)
    assert not left, left


@contextmanager
def no_thread_left(at_most_s: float = PATIENCE_S) -> Iterator[None]:
    """Fails where threads that began inside of the `with` have not ended at its end, or shortly after."""
    before = threading.enumerate()
    yield
    clock = MonotonicClock()
    until_s = clock.now() + at_most_s
    left = [thread for thread in threading.enumerate() if thread not in before]
    for thread in left:
        thread.join(max(0.0, until_s - clock.now()))
    names = [thread.name for thread in left if thread.is_alive()]
    assert not names, f"threads are left: {', '.join(names)}"
