"""What is published on a channel of agents, as it happens."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from pancakes.client.door import Door, Listener
from pancakes.client.heard_packet import HeardPacket
from pancakes.client.mesh_client import MeshClient
from pancakes.client.waits import LOOK_S
from pancakes.control import Follow, Reply
from pancakes.errors import ControlRefused, Unreachable
from pancakes.packet import Packet, agent_of
from pancakes.runtime.kernel.backlog import Backlog

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
