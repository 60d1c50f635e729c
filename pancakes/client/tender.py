"""The thread that keeps a program's subscribers alive while the program does something else."""

from __future__ import annotations

import threading
from typing import Any

from pancakes.client.subscriber import Subscriber
from pancakes.client.waits import LOOK_S


class Tender:
    """Tends subscribers, every `LOOK_S`, as long as there are any. Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: list[Subscriber[Any]] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, subscriber: Subscriber[Any]) -> None:
        """Tends a subscriber from now on; the first one begins the thread."""
        with self._lock:
            self._subscribers.append(subscriber)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="pancakes-subscribers", daemon=True)
                self._thread.start()

    def remove(self, subscriber: Subscriber[Any]) -> None:
        """Tends a subscriber no more."""
        with self._lock:
            self._subscribers = [it for it in self._subscribers if it is not subscriber]

    def all(self) -> list[Subscriber[Any]]:
        """Returns those that it tends."""
        with self._lock:
            return list(self._subscribers)

    def close(self) -> None:
        """Ends all subscribers, and the thread."""
        for subscriber in self.all():
            subscriber.close()
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(LOOK_S):
            for subscriber in self.all():
                subscriber.tend()
