"""Subscribe to a channel of one agent, of several or of all, and read what they publish.

- `SubscriptionSpec` is what to subscribe to.
- `Subscription` keeps it alive: agents that restart, or come back at another address, are asked again.
- `Subscriber` makes rows of the packets. A program reads them one by one, or passes a function that is called for each.
- `KeepAlive` is the thread that keeps the subscribers of a program alive while it does something else.

A reader that is too slow loses the oldest packets; they are counted as `missed`.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, TypeVar

from pancakes.client.rows import ReceivedPacket
from pancakes.client.session import LOOK_S, FleetSession, Listener, Session
from pancakes.control import Follow, Reply
from pancakes.errors import ControlRefusedError, NoPacketError, PancakesError, UnreachableError, describe
from pancakes.kernel.mailbox import Backlog
from pancakes.packet import Packet, agent_of

SEARCH_S: Final = 0.5
"""How often to look for agents that are away or new."""
REPEAT_S: Final = 0.5
"""After how long to ask an agent that refused again: its Network Service may still be starting."""
ANSWER_S: Final = 3.0
"""After how long to ask an agent that did not answer again: it may have been starting."""
QUIET_S: Final = 5.0
"""After how long without a packet to ask an agent again: a failed Network Service has forgotten us."""
MAX_UNREADABLE: Final = 20
"""Unreadable packets are reported for at most this many types."""
MAX_WAITING: Final = 100_000
"""At most this many packets wait for a slow reader, fewer if they are large. Then the oldest are dropped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SubscriptionSpec:
    """What to subscribe to.

    Attributes:
        channel: the channel.
        types: only packets of these types; none: all.
        agents: the agents' names; none: all, including those that come later.
        include_remote: also packets that other agents sent to the channel.
        max_hz: at most this many packets a second of each source and type, the newest ones; 0: all.
        max_waiting: at most this many packets wait for the reader, fewer if they are large; then the oldest are
            dropped.
        accepts: only packets for which it returns True wait; called in the transport's thread.
        on_resubscribe: takes the name of an agent that is subscribed to again, or late; earlier packets may have been
            missed.
    """

    channel: str
    types: tuple[str, ...] = ()
    agents: tuple[str, ...] = ()
    include_remote: bool = False
    max_hz: float = 0.0
    max_waiting: int = MAX_WAITING
    accepts: Callable[[Packet], bool] = lambda packet: True
    on_resubscribe: Callable[[str], None] = lambda agent: None


@dataclass(slots=True)
class _SubscribedAgent:
    """The state of a subscription at one agent.

    Attributes:
        session: the session in its fleet.
        agent: its name.
        link: the link when it was asked last; an agreement over an earlier link does not count.
        request: the number of the request that it has not answered; None: it has answered all.
        asked_s: when it was asked last, in host time.
        subscribed: whether it agreed.
        lapsed: whether packets may be missed until it agrees again.
        away: whether to report when it is connected (again).
        received_s: when it sent the last packet, in host time.
        refusal: why it refused last.
    """

    session: FleetSession
    agent: str
    link: int = 0
    request: int | None = None
    asked_s: float = -math.inf
    subscribed: bool = False
    lapsed: bool = False
    away: bool = False
    received_s: float = -math.inf
    refusal: str = ""


class Subscription:
    """Receive the packets of one channel of one agent, of several or of all.

    `keep_alive`, which `next` calls, asks an agent that went away and came back again, also at another address. A
    program that does not wait in `next` calls `keep_alive` now and then in one thread, and `take` in another.

        with Subscription(session, SubscriptionSpec(channel="system", agents=("agent1",)), print) as subscription:
            received = subscription.next(session.now() + 1.0)

    Args:
        session: reaches the agents.
        spec: what to subscribe to.
        say: takes a sentence about agents that go and come back, and about packets that cannot be read here.

    Attributes:
        channel: the channel.
        on_packet: called when a packet has come and waits, in the transport's thread.

    Raises:
        UnreachableError: there is no such agent, or none at all, or none answers in time.
        ControlRefusedError: the agents have no such channel; the message is their reason.
    """

    def __init__(
        self, session: Session, spec: SubscriptionSpec, say: Callable[[str], None] = lambda text: None
    ) -> None:
        self._session = session
        self._spec = spec
        self._say = say
        self.channel = spec.channel
        self.on_packet: Callable[[], None] = lambda: None
        self._lock = threading.RLock()  # held in `keep_alive` and `close`; `say` may call `close`
        self._request = Follow(spec.channel, spec.types, spec.include_remote, spec.max_hz)
        self._agents: dict[tuple[str, str], _SubscribedAgent] = {}  # by fleet and name
        self._waiting: Backlog[ReceivedPacket[Any]] = Backlog(spec.max_waiting)
        self._unreadable: dict[str, str] = {}  # reasons by type
        self._reported = 0  # of `_unreadable`
        self._listeners: list[tuple[FleetSession, Listener]] = []
        self._ended = False
        self._searched_s = session.now()
        self._kept_s = -math.inf
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Unsubscribe at the agents, and drop what waits. Any thread."""
        with self._lock:
            self._ended = True
            agents, self._agents = self._agents, {}
            for fleet, listener in self._listeners:
                fleet.unlisten(listener)
        for it in agents.values():
            self._session.subscriptions.remove(self, it.session, it.agent, self.channel)
        self._waiting.clear()

    def next(self, until_s: float) -> ReceivedPacket[Any] | None:
        """Return the next packet; None if none comes before `until_s`, in host time."""
        while True:
            self.keep_alive()
            received = self.take()
            if received is not None:
                return received
            now_s = self._session.now()
            if now_s >= until_s:
                return None
            self._session.wait(min(until_s, now_s + LOOK_S), lambda: len(self._waiting) > 0)

    def take(self) -> ReceivedPacket[Any] | None:
        """Return the next packet that waits; None if none does. Any thread."""
        return self._waiting.take()

    def waiting(self) -> int:
        """Return how many packets wait for the reader. Any thread."""
        return len(self._waiting)

    @property
    def missed(self) -> int:
        """How many packets were dropped because the caller was too slow."""
        return self._waiting.dropped

    def agents(self) -> list[str]:
        """Return the names of all agents that are subscribed to, including those that are away."""
        return sorted({*self._spec.agents, *(it.agent for it in list(self._agents.values()))})

    def away(self) -> list[str]:
        """Return the names of the agents that are away."""
        here = {it.agent for it in list(self._agents.values()) if it.subscribed}
        return [name for name in self.agents() if name not in here]

    # Beginning -------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        found = self._session.describe(*self._spec.agents)
        for sentence in found.silent:
            self._say(sentence)
        self._add_agents()
        for it in self._agents.values():
            self._ask(it, self._session.now())
        keys = [(row["fleet"], row["agent"]) for row in found.agents]
        answered = [self._agents[key] for key in keys if key in self._agents]

        def settled() -> bool:
            for it in answered:
                self._take_answer(it)
            return all(it.request is None for it in answered)

        self._session.wait(self._session.until_s(None), settled)
        refusals = list(dict.fromkeys(it.refusal for it in answered if it.refusal))
        if not any(it.subscribed for it in answered):
            if refusals:
                raise ControlRefusedError("\n".join(refusals))
            names = ", ".join(row["agent"] for row in found.agents)
            raise UnreachableError(f"{names} did not answer: {self._session.too_late(None)}")
        for refusal in refusals:
            self._say(refusal)

    def _add_agents(self) -> list[_SubscribedAgent]:
        """Add the agents that are connected and not known yet; return them."""
        new = []
        for fleet in self._session.fleets():
            for hello in fleet.agents():
                key = (fleet.fleet, hello.name)
                if key in self._agents or (self._spec.agents and hello.name not in self._spec.agents):
                    continue
                if all(known is not fleet for known, _ in self._listeners):
                    listener = partial(self._receive, fleet.fleet)
                    self._listeners.append((fleet, listener))
                    fleet.listen(listener, partial(self._note_unreadable, fleet.fleet))
                self._agents[key] = _SubscribedAgent(fleet, hello.name)
                new.append(self._agents[key])
        return new

    # Going on --------------------------------------------------------------------------------------------------

    def keep_alive(self) -> None:
        """Subscribe at all agents that are there and have not agreed; does nothing if called again within `LOOK_S`.

        Raises:
            PancakesError: the runtime directory cannot be used.
        """
        with self._lock:
            if not self._ended:
                self._keep_alive(self._session.now())

    def _keep_alive(self, now_s: float) -> None:
        if now_s - self._kept_s < LOOK_S:
            return
        self._kept_s = now_s
        reasons = list(self._unreadable.values())
        for reason in reasons[self._reported :]:
            self._say(f"some packets cannot be read here: {reason}")
        self._reported = len(reasons)
        for it in self._add_agents():
            it.lapsed = it.away = True
        for it in self._agents.values():
            self._check(it, now_s)
        if now_s - self._searched_s >= SEARCH_S and (not self._spec.agents or self.away()):
            self._searched_s = now_s
            self._session.refresh()

    def _check(self, it: _SubscribedAgent, now_s: float) -> None:
        self._take_answer(it)
        link = it.session.link(it.agent)
        if link != it.link:
            it.subscribed, it.lapsed, it.request, it.link = False, True, None, 0
            if not link and not it.away:
                it.away = True
                self._say(f"{it.agent} is away: waiting for it to come back")
        if not link:
            return
        asked_before_s = now_s - it.asked_s
        if it.request is not None:
            due = asked_before_s >= ANSWER_S
        elif it.subscribed:
            due = asked_before_s >= QUIET_S and now_s - it.received_s >= QUIET_S
        else:
            due = link != it.link or asked_before_s >= REPEAT_S
        if due:
            self._ask(it, now_s)

    def _ask(self, it: _SubscribedAgent, now_s: float) -> None:
        if it.request is not None:
            it.session.forget(it.request)
        it.asked_s = now_s
        it.link = it.session.link(it.agent)
        it.request = self._session.subscriptions.add(self, it.session, it.agent, self._request)

    def _take_answer(self, it: _SubscribedAgent) -> None:
        answer = it.session.answer(it.request) if it.request is not None else None
        if it.request is None or answer is None:
            return
        it.session.forget(it.request)
        it.request = None
        if not isinstance(answer, Reply) or not answer.ok:
            it.subscribed = False
            it.refusal = answer.reason if isinstance(answer, Reply) else ""
            return
        it.subscribed, it.refusal = True, ""
        if it.away:
            it.away = False
            self._say(f"{it.agent} is here")
        if it.lapsed:
            it.lapsed = False
            self._spec.on_resubscribe(it.agent)

    def _receive(self, fleet: str, agent: str, packet: Packet) -> None:
        """Take a packet. In the transport's thread."""
        it = self._agents.get((fleet, agent))
        if it is None or packet.channel != self.channel:
            return
        it.received_s = self._session.now()
        spec = self._spec
        # Packets for other subscribers of this program come over the same subscription.
        ours = (not spec.types or packet.type in spec.types) and (
            spec.include_remote or agent_of(packet.source) == agent
        )
        if ours and spec.accepts(packet):
            self._waiting.put(packet, ReceivedPacket(agent, packet, it.received_s))
            self.on_packet()

    def _note_unreadable(self, fleet: str, agent: str, packet: Packet, reason: str) -> None:
        """Note the first packet of a type that cannot be read. In the transport's thread."""
        it = self._agents.get((fleet, agent))
        if it is None or packet.channel != self.channel:
            return
        it.received_s = self._session.now()
        if self._spec.types and packet.type not in self._spec.types:
            return
        if len(self._unreadable) < MAX_UNREADABLE:
            self._unreadable.setdefault(packet.type, reason)


Row = TypeVar("Row")

TURN_S: Final = 0.2
"""How often a waiting thread checks whether it must end."""


class Subscriber(Generic[Row]):
    """Read what comes on a channel, as rows. Its methods may be called in any thread.

        with client.subscribe("agent1/system", Battery) as batteries:
            for received in batteries:
                print(received.source, received.body.level)

    Args:
        session: reaches the agents.
        subscription: what comes.
        make: makes a row of a packet.
        name: what it reads, for sentences: `agent1/system`.
        timeout_s: how long `next` and the loop wait for a row; None: no limit.
        say: takes a sentence if it is too slow, or its callback fails.
        on_end: called once, when it ends.
    """

    def __init__(
        self,
        session: Session,
        subscription: Subscription,
        make: Callable[[ReceivedPacket[Any]], Row],
        name: str,
        timeout_s: float | None,
        say: Callable[[str], None],
        on_end: Callable[[Subscriber[Any]], None],
    ) -> None:
        self._name = name
        self._failure = ""
        self._session = session
        self._subscription = subscription
        self._make = make
        self._timeout_s = timeout_s
        self._say = say
        self._on_end = on_end
        self._closed = False
        self._slow_reported = False
        self._on_news: Callable[[], None] = lambda: None
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
        """Wait for the next row.

        Args:
            timeout_s: how long at most; None: the limit given to `subscribe`.

        Raises:
            NoPacketError: no row came in time; the message names the agents that are away.
            PancakesError: it has failed, or is closed.
        """
        row = self._wait(self._timeout_s if timeout_s is None else timeout_s)
        if row is None:
            raise PancakesError(f"{self._name} is closed: subscribe again")
        return row

    def _wait(self, limit_s: float | None) -> Row | None:
        """Return the next row; None if it is closed."""
        row = self.take(math.inf if limit_s is None else limit_s)
        if row is None and not self._closed:
            raise self.nothing_came(limit_s or 0.0)
        return row

    def nothing_came(self, limit_s: float) -> NoPacketError:
        """Return the error that says that no row came in time."""
        away = self.away()
        gone = f": {', '.join(away)} {'is' if len(away) == 1 else 'are'} away" if away else ""
        return NoPacketError(f"nothing came on {self._name} within {limit_s:g} s{gone}")

    def take(self, wait_s: float = 0.0) -> Row | None:
        """Return the next row; None if none came within `wait_s` seconds, or it is closed.

        Raises:
            PancakesError: the subscriber has failed.
        """
        until_s = self._session.now() + wait_s
        while True:
            received = self._subscription.take()
            if received is not None:
                return self._make(received)
            if self._failure:
                raise PancakesError(self._failure)
            now_s = self._session.now()
            if self._closed or now_s >= until_s:
                return None
            try:
                self._session.wait(min(until_s, now_s + TURN_S), self._has_news)
            except PancakesError:  # the client is closed, and this subscriber with it
                if not self._closed:
                    raise

    def during(self, for_s: float) -> Iterator[Row]:
        """Yield the rows that come within this time from now."""
        until_s = self._session.now() + for_s
        while (left_s := until_s - self._session.now()) > 0.0:
            row = self.take(left_s)
            if row is None:
                return
            yield row

    @property
    def name(self) -> str:
        """What it reads, for sentences: `agent1/system`."""
        return self._name

    @property
    def failure(self) -> str:
        """Why it failed, as a sentence; empty if it has not."""
        return self._failure

    @property
    def missed(self) -> int:
        """How many packets were dropped because this program was too slow."""
        return self._subscription.missed

    @property
    def closed(self) -> bool:
        """Whether it has ended: no more rows come."""
        return self._closed

    def agents(self) -> list[str]:
        """Return the names of all agents that it is subscribed to, including those that are away."""
        return self._subscription.agents()

    def away(self) -> list[str]:
        """Return the names of the agents that are away; it subscribes again when they come back."""
        return self._subscription.away()

    def close(self) -> None:
        """End it and drop what waits. Its callback is not called again once this returns."""
        self._end()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(self._session.timeout_s)
            if thread.is_alive():
                self._say(f"{self._name}: its callback is still running after {self._session.timeout_s:g} s")

    # For the client -------------------------------------------------------------------------------------------

    def call_for_each(self, function: Callable[[Row], object]) -> None:
        """Call a function for each row from now on, in a thread of its own, one at a time."""
        self._thread = threading.Thread(target=self._run, args=(function,), name=f"pancakes-{self._name}", daemon=True)
        self._thread.start()

    def on_news(self, callback: Callable[[], None]) -> None:
        """Register a function that is called, in other threads, when a packet comes or the subscriber ends."""
        self._on_news = callback
        self._subscription.on_packet = callback
        callback()

    def keep_alive(self) -> None:
        """Stay subscribed at all connected agents. In one thread."""
        try:
            self._subscription.keep_alive()
        except PancakesError as error:
            self.fail(str(error))
        if self._subscription.missed and not self._slow_reported:
            self._slow_reported = True
            self._say(
                f"{self._name}: this program is too slow, so the oldest packets are dropped:"
                " ask for fewer types, or read faster"
            )

    def fail(self, reason: str) -> None:
        """End it; its reader gets the reason as an error."""
        if not self._closed:
            self._failure = f"{self._name}: {reason}"
            self._say(self._failure)
            self._end()

    def _end(self) -> None:
        if not self._closed:
            self._closed = True
            self._subscription.close()
            self._on_end(self)
            self._on_news()

    def _has_news(self) -> bool:
        return self._closed or self._subscription.waiting() > 0

    def _run(self, function: Callable[[Row], object]) -> None:
        while not self._closed:
            try:
                row = self.take(TURN_S)
            except PancakesError:  # it has failed, which was reported
                return
            if row is None:
                continue
            try:
                function(row)
            except Exception as error:
                self.fail(callback_failed(error))


def callback_failed(error: Exception) -> str:
    """Return why a subscriber ends whose callback raised an exception."""
    return f"the callback failed, and is not called again: {describe(error)}"


class KeepAlive:
    """Keep subscribers alive in a thread of its own. Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: list[Subscriber[Any]] = []
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, subscriber: Subscriber[Any]) -> None:
        """Keep a subscriber alive from now on; the first one starts the thread."""
        with self._lock:
            self._subscribers.append(subscriber)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="pancakes-subscribers", daemon=True)
                self._thread.start()

    def remove(self, subscriber: Subscriber[Any]) -> None:
        """Stop keeping a subscriber alive."""
        with self._lock:
            self._subscribers = [it for it in self._subscribers if it is not subscriber]

    def close(self) -> None:
        """End all subscribers, and the thread."""
        for subscriber in self._all():
            subscriber.close()
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _all(self) -> list[Subscriber[Any]]:
        with self._lock:
            return list(self._subscribers)

    def _run(self) -> None:
        while not self._stop.wait(LOOK_S):
            for subscriber in self._all():
                subscriber.keep_alive()
