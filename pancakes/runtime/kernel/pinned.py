"""A thread for one component, pykka's own way: for a driver or task that must wait for something."""

from __future__ import annotations

import threading
from queue import SimpleQueue

from pancakes.runtime.kernel.dispatch import Dispatcher
from pancakes.runtime.kernel.mailbox import Mailbox, Runnable

STOP_S = 0.3
"""How long, in all, a stop waits for threads whose components do not come back."""


class PinnedDispatcher(Dispatcher):
    """Gives each of its components a thread of its own, which ends with the component.

    Args:
        name: for the names of the threads.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._wakes: dict[int, SimpleQueue[bool]] = {}
        self._threads: dict[int, threading.Thread] = {}

    def attach(self, component: Runnable) -> None:
        mailbox = component.actor_inbox
        wake: SimpleQueue[bool] = SimpleQueue()
        name = component.address.rpartition("/")[2]
        thread = threading.Thread(target=self._run, args=(component, wake), name=f"{self._name}-{name}", daemon=True)
        with self._lock:
            self._wakes[id(mailbox)] = wake
            self._threads[id(component)] = thread
        thread.start()
        super().attach(component)

    def ready(self, mailbox: Mailbox) -> None:
        with self._lock:
            wake = self._wakes.get(id(mailbox))
        # Where there is none its thread has ended with the dispatcher: no thread will read this mailbox again.
        if wake is not None:
            wake.put(True)

    def _run(self, component: Runnable, wake: SimpleQueue[bool]) -> None:
        mailbox = component.actor_inbox
        while not component.actor_stopped.is_set() and wake.get():
            self.give_turn(mailbox)
        with self._lock:
            self._threads.pop(id(component), None)
            if self._wakes.get(id(mailbox)) is wake:
                del self._wakes[id(mailbox)]

    def stop(self) -> None:
        with self._lock:
            threads = list(self._threads.values())
            for wake in self._wakes.values():
                wake.put(False)
        for thread in threads:
            # However many are stuck: the agent has to be gone within two seconds.
            thread.join(timeout=STOP_S / len(threads))
