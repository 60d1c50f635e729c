"""Subscribe to a channel of one agent, of several or of all, and read what they publish.

- `Following` keeps the subscription alive: agents that restart or move to another address are followed again.
- `Subscriber` makes rows of the packets. A program reads them one by one, or has a function called for each.
- `Tender` is the thread that keeps the subscribers of a program alive while it does something else.

A reader that is too slow loses the oldest packets; they are counted as `missed`.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, TypeVar

from pancakes.client.mesh_client import MeshClient
from pancakes.client.rows import HeardPacket
from pancakes.client.session import LOOK_S, Door, Listener
from pancakes.control import Follow, Reply
from pancakes.errors import ControlRefused, NothingCame, PancakesError, Unreachable, describe
from pancakes.kernel.mailbox import Backlog
from pancakes.packet import Packet, agent_of

SEARCH_S: Final = 0.5
"""How often agents are looked for that are away or new."""
REPEAT_S: Final = 0.5
"""When an agent is asked again that refused: its Network Service may only be starting."""
ANSWER_S: Final = 3.0
"""When an agent is asked again that did not answer: it may have been starting when it was asked."""
QUIET_S: Final = 5.0
"""After so long without a packet an agent is asked again, as its Network Service may have failed and forgotten us."""
MOST_UNREAD: Final = 20
"""Of so many types at most it is said that their packets cannot be read."""
MOST_WAITING: Final = 100_000
"""So many packets wait for a reader that is slow, of large ones fewer; after that the oldest fall out."""


@dataclass(slots=True)
class _Followed:
    """What is known of one agent that is followed.

    Attributes:
        door: leads to it.
        agent: its name.
        link: the link that stood when it was asked last; what it agreed to over an earlier one does not count.
        request: the number of what it was asked and has not answered.
        asked_s: when that was, in host time.
        follows: whether it agreed.
        lapsed: whether what it published may have been missed, before it follows again.
        away: whether it has to be told when it is here (again).
        heard_s: when it sent the last packet, in host time.
        refusal: why it refused last.
    """

    door: Door
    agent: str
    link: int = 0
    request: int | None = None
    asked_s: float = -math.inf
    follows: bool = False
    lapsed: bool = False
    away: bool = False
    heard_s: float = -math.inf
    refusal: str = ""


class Following:
    """The packets of one channel of one agent, of several or of all.

    An agent that goes away is followed again when it comes back, also under another address: `tend` sees to that, which
    `next` calls. A program that does not wait in `next` has one thread call `tend` now and then, and another `take`.

        with Following(client, "system", agents=("agent1",), say=print) as following:
            heard = following.next(client.now() + 1.0)

    Args:
        client: reaches the agents.
        channel: the channel.
        types: only packets of these types; none: all.
        foreign: whether packets count that came to the channel from other agents.
        agents: the agents' names; none: all, those too that come later.
        fleet: only agents of this fleet; empty: of any.
        say: takes a sentence about agents that go and come back, and about packets that cannot be read here.
        followed_anew: called with the name of an agent that is followed again, or only now, in `tend`.
        most_hz: at most so many packets a second of each source and type, the newest ones; 0: all.
        most_waiting: so many packets wait for the reader, of large ones fewer; after that the oldest fall out.
        wants: of what comes, only packets for which it returns True wait; called in the transport's thread.

    Attributes:
        channel: the channel.
        arrived: called after a packet came that waits now, in the transport's thread.

    Raises:
        Unreachable: there is no such agent, or none at all, or none answers in time.
        ControlRefused: the agents have no such channel; the message is their reason.
    """

    def __init__(
        self,
        client: MeshClient,
        channel: str,
        types: Sequence[str] = (),
        foreign: bool = False,
        agents: Sequence[str] = (),
        say: Callable[[str], None] = lambda text: None,
        followed_anew: Callable[[str], None] = lambda agent: None,
        fleet: str = "",
        most_hz: float = 0.0,
        most_waiting: int = MOST_WAITING,
        wants: Callable[[Packet], bool] = lambda packet: True,
    ) -> None:
        self._client = client
        self.channel = channel
        self.arrived: Callable[[], None] = lambda: None
        self._wants = wants
        self._lock = threading.RLock()  # held while it is tended, or ends; `say` may end it
        self._request = Follow(channel, tuple(types), foreign, most_hz)
        self._names = tuple(agents)
        self._fleet = fleet
        self._say = say
        self._followed: dict[tuple[str, str], _Followed] = {}
        self._waiting: Backlog[HeardPacket[Any]] = Backlog(most_waiting)
        self._unread: dict[str, str] = {}  # the reasons, by type
        self._unread_said = 0
        self._listened: list[tuple[Door, Listener]] = []
        self._ended = False
        self._searched_s = client.now()
        self._tended_s = -math.inf
        self._followed_anew = followed_anew
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Following:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Tells the agents that it is over, and forgets what waits. Any thread."""
        with self._lock:
            self._ended = True
            followed, self._followed = self._followed, {}
            for door, listener in self._listened:
                door.unlisten(listener)
        for it in followed.values():
            self._client.wishes.drop(self, it.door, it.agent, self.channel)
        self._waiting.clear()

    def next(self, until_s: float) -> HeardPacket[Any] | None:
        """Returns the next packet, or None where none has come until then, in host time."""
        while True:
            self.tend()
            heard = self.take()
            if heard is not None:
                return heard
            now_s = self._client.now()
            if now_s >= until_s:
                return None
            self._client.wait(min(until_s, now_s + LOOK_S), lambda: len(self._waiting) > 0)

    def take(self) -> HeardPacket[Any] | None:
        """Returns the next packet that waits, or None where none does. Any thread."""
        return self._waiting.take()

    def waiting(self) -> int:
        """Returns how many packets wait for the reader. Any thread."""
        return len(self._waiting)

    @property
    def missed(self) -> int:
        """How many packets fell out because the caller was too slow."""
        return self._waiting.dropped

    def agents(self) -> list[str]:
        """Returns the names of all agents that are followed, those too that are away."""
        return sorted({*self._names, *(it.agent for it in list(self._followed.values()))})

    def away(self) -> list[str]:
        """Returns the names of the agents that are away."""
        here = {it.agent for it in list(self._followed.values()) if it.follows}
        return [name for name in self.agents() if name not in here]

    # Beginning -------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        found = self._client.survey(*self._names)
        for sentence in found.silent:
            self._say(sentence)
        self._meet()
        for it in self._followed.values():
            self._ask(it, self._client.now())
        keys = [(row["fleet"], row["agent"]) for row in found.agents]
        answered = [self._followed[key] for key in keys if key in self._followed]

        def settled() -> bool:
            for it in answered:
                self._take_answer(it)
            return all(it.request is None for it in answered)

        self._client.wait(self._client.now() + self._client.timeout_s, settled)
        refusals = list(dict.fromkeys(it.refusal for it in answered if it.refusal))
        if not any(it.follows for it in answered):
            if refusals:
                raise ControlRefused("\n".join(refusals))
            names = ", ".join(row["agent"] for row in found.agents)
            raise Unreachable(f"{names} did not answer: nothing came within {self._client.timeout_s:g} s")
        for refusal in refusals:
            self._say(refusal)

    def _meet(self) -> list[_Followed]:
        """Takes up agents that are connected and not yet known; returns them."""
        new = []
        for door in self._client.doors():
            if self._fleet not in ("", door.fleet):
                continue
            for hello in door.agents():
                key = (door.fleet, hello.name)
                if key in self._followed or (self._names and hello.name not in self._names):
                    continue
                if all(known is not door for known, _ in self._listened):
                    listener = partial(self._hear, door.fleet)
                    self._listened.append((door, listener))
                    door.listen(listener, partial(self._leave_out, door.fleet))
                self._followed[key] = _Followed(door, hello.name)
                new.append(self._followed[key])
        return new

    # Going on --------------------------------------------------------------------------------------------------

    def tend(self) -> None:
        """Sees to it that all agents are followed that are there, at most every `LOOK_S`.

        Raises:
            PancakesError: the runtime directory cannot be used.
        """
        with self._lock:
            if not self._ended:
                self._tend(self._client.now())

    def _tend(self, now_s: float) -> None:
        if now_s - self._tended_s < LOOK_S:
            return
        self._tended_s = now_s
        unread = list(self._unread.values())
        for reason in unread[self._unread_said :]:
            self._say(f"some packets cannot be read here: {reason}")
        self._unread_said = len(unread)
        for it in self._meet():
            it.lapsed = it.away = True
        for it in self._followed.values():
            self._look_after(it, now_s)
        if now_s - self._searched_s >= SEARCH_S and (not self._names or self.away()):
            self._searched_s = now_s
            self._client.look_again()

    def _look_after(self, it: _Followed, now_s: float) -> None:
        self._take_answer(it)
        link = it.door.link(it.agent)
        if link != it.link:
            it.follows, it.lapsed, it.request, it.link = False, True, None, 0
            if not link and not it.away:
                it.away = True
                self._say(f"{it.agent} is away: waiting for it to come back")
        if not link:
            return
        asked_before_s = now_s - it.asked_s
        if it.request is not None:
            due = asked_before_s >= ANSWER_S
        elif it.follows:
            due = asked_before_s >= QUIET_S and now_s - it.heard_s >= QUIET_S
        else:
            due = link != it.link or asked_before_s >= REPEAT_S
        if due:
            self._ask(it, now_s)

    def _ask(self, it: _Followed, now_s: float) -> None:
        if it.request is not None:
            it.door.forget(it.request)
        it.asked_s = now_s
        it.link = it.door.link(it.agent)
        it.request = self._client.wishes.ask(self, it.door, it.agent, self._request)

    def _take_answer(self, it: _Followed) -> None:
        answer = it.door.answer(it.request) if it.request is not None else None
        if it.request is None or answer is None:
            return
        it.door.forget(it.request)
        it.request = None
        if not isinstance(answer, Reply) or not answer.ok:
            it.follows = False
            it.refusal = answer.reason if isinstance(answer, Reply) else ""
            return
        it.follows, it.refusal = True, ""
        if it.away:
            it.away = False
            self._say(f"{it.agent} is here")
        if it.lapsed:
            it.lapsed = False
            self._followed_anew(it.agent)

    def _hear(self, fleet: str, agent: str, packet: Packet) -> None:
        """Takes a packet. In the transport's thread."""
        it = self._followed.get((fleet, agent))
        if it is None or packet.channel != self.channel:
            return
        it.heard_s = self._client.now()
        wish = self._request
        # What others in this program wish to hear on the channel comes as well.
        ours = (not wish.types or packet.type in wish.types) and (wish.foreign or agent_of(packet.source) == agent)
        if ours and self._wants(packet):
            self._waiting.put(packet, HeardPacket(agent, packet, it.heard_s))
            self.arrived()

    def _leave_out(self, fleet: str, agent: str, packet: Packet, reason: str) -> None:
        """Notes the first packet of a type that cannot be read. In the transport's thread."""
        it = self._followed.get((fleet, agent))
        if it is None or packet.channel != self.channel:
            return
        it.heard_s = self._client.now()
        if self._request.types and packet.type not in self._request.types:
            return
        if len(self._unread) < MOST_UNREAD:
            self._unread.setdefault(packet.type, reason)


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
