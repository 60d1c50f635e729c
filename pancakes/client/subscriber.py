"""Rows that come as agents publish: read one after the other, or given to a function."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final, Generic, TypeVar

from pancakes.client.following import Following
from pancakes.client.heard_packet import HeardPacket
from pancakes.client.mesh_client import MeshClient
from pancakes.errors import NothingCame, PancakesError, describe

Row = TypeVar("Row")

TURN_S: Final = 0.2
"""How often a thread that waits looks whether it is to end."""


class Subscriber(Generic[Row]):
    """What comes on a channel, made into rows. The methods may be called in any thread.

        with client.subscribe("agent1/system", Battery) as batteries:
            for heard in batteries:
                print(heard.source, heard.body.level)

    Args:
        client: reaches the agents.
        following: what comes.
        make: makes a row of a packet.
        name: what it is, for sentences: `agent1/system`.
        timeout_s: how long `next` and the loop wait for a row; None: without end.
        say: takes a sentence where it is too slow, or its function fails.
        ended: called once, when it ends.
    """

    def __init__(
        self,
        client: MeshClient,
        following: Following,
        make: Callable[[HeardPacket[Any]], Row],
        name: str,
        timeout_s: float | None,
        say: Callable[[str], None],
        ended: Callable[[Subscriber[Any]], None],
    ) -> None:
        self._name = name
        self._failure = ""
        self._client = client
        self._following = following
        self._make = make
        self._timeout_s = timeout_s
        self._say = say
        self._on_end = ended
        self._closed = False
        self._told_slow = False
        self._arrived: Callable[[], None] = lambda: None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Subscriber[Row]:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Row]:
        return self

    def __next__(self) -> Row:
        row = self._wait(self._timeout_s)
        if row is None:
            raise StopIteration
        return row

    def next(self, timeout_s: float | None = None) -> Row:
        """Waits for the next row.

        Args:
            timeout_s: how long at most; None: as `subscribe` was told.

        Raises:
            NothingCame: no row came in time; the sentence names the agents that are away.
            PancakesError: it has failed, or is closed.
        """
        row = self._wait(self._timeout_s if timeout_s is None else timeout_s)
        if row is None:
            raise PancakesError(f"{self._name} is closed: subscribe again")
        return row

    def _wait(self, limit_s: float | None) -> Row | None:
        """Returns the next row; None where it is closed."""
        row = self.take(math.inf if limit_s is None else limit_s)
        if row is None and not self._closed:
            raise self.nothing_came(limit_s or 0.0)
        return row

    def nothing_came(self, limit_s: float) -> NothingCame:
        """Returns the error that says that no row came within a time."""
        away = self.away()
        gone = f": {', '.join(away)} {'is' if len(away) == 1 else 'are'} away" if away else ""
        return NothingCame(f"nothing came on {self._name} within {limit_s:g} s{gone}")

    def take(self, wait_s: float = 0.0) -> Row | None:
        """Returns the next row; None where none came within `wait_s` seconds, or it is closed.

        Raises:
            PancakesError: the subscriber has failed.
        """
        until_s = self._client.now() + wait_s
        while True:
            heard = self._following.take()
            if heard is not None:
                return self._make(heard)
            if self._failure:
                raise PancakesError(self._failure)
            now_s = self._client.now()
            if self._closed or now_s >= until_s:
                return None
            try:
                self._client.wait(min(until_s, now_s + TURN_S), self._has_news)
            except PancakesError:  # the client is closed, and so is this
                if not self._closed:
                    raise

    def during(self, for_s: float) -> Iterator[Row]:
        """Yields the rows that come within a time from now, and ends then."""
        until_s = self._client.now() + for_s
        while (left_s := until_s - self._client.now()) > 0.0:
            row = self.take(left_s)
            if row is None:
                return
            yield row

    @property
    def name(self) -> str:
        """What it listens to, for sentences: `agent1/system`."""
        return self._name

    @property
    def failure(self) -> str:
        """Why no rows come any more, as a sentence; empty while they may."""
        return self._failure

    @property
    def missed(self) -> int:
        """How many packets fell out because this program was too slow for them."""
        return self._following.missed

    @property
    def closed(self) -> bool:
        """Whether it has ended, so that no row comes any more."""
        return self._closed

    def agents(self) -> list[str]:
        """Returns the names of all agents that it listens to, those too that are away."""
        return self._following.agents()

    def away(self) -> list[str]:
        """Returns the names of the agents that are away; they are listened to again when they come back."""
        return self._following.away()

    def close(self) -> None:
        """Ends it. What waits is forgotten; a function that it calls is not called any more once this returns."""
        self._end()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(self._client.timeout_s)
            if thread.is_alive():
                self._say(f"{self._name}: its function is still at work after {self._client.timeout_s:g} s")

    # For `pancakes.client.Client` ------------------------------------------------------------------------------

    def give_to(self, function: Callable[[Row], object]) -> None:
        """Gives each row to a function from now on, in a thread of its own, one after the other."""
        self._thread = threading.Thread(target=self._run, args=(function,), name=f"pancakes-{self._name}", daemon=True)
        self._thread.start()

    def tell(self, arrived: Callable[[], None]) -> None:
        """Has a function called, in other threads, whenever a packet came or it has ended."""
        self._arrived = arrived
        self._following.arrived = arrived
        arrived()

    def tend(self) -> None:
        """Sees to it that all agents are followed that are there. In one thread."""
        try:
            self._following.tend()
        except PancakesError as error:
            self.fail(str(error))
        if self._following.missed and not self._told_slow:
            self._told_slow = True
            self._say(
                f"{self._name}: this program is too slow, so that the oldest packets fall out:"
                " ask for fewer types, or read faster"
            )

    def fail(self, reason: str) -> None:
        """Ends it for a reason, which its reader is told."""
        if not self._closed:
            self._failure = f"{self._name}: {reason}"
            self._say(self._failure)
            self._end()

    def _end(self) -> None:
        if not self._closed:
            self._closed = True
            self._following.close()
            self._on_end(self)
            self._arrived()

    def _has_news(self) -> bool:
        return self._closed or self._following.waiting() > 0

    def _run(self, function: Callable[[Row], object]) -> None:
        while not self._closed:
            try:
                row = self.take(TURN_S)
            except PancakesError:  # it has ended, and its failure was said
                return
            if row is None:
                continue
            try:
                function(row)
            except Exception as error:
                self.fail(f"the function that takes what comes failed, and gets no more: {describe(error)}")
