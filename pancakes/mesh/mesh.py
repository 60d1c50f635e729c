"""The mesh: this agent's links to all others, without a broker (paper §3.5).

`Mesh` opens and closes connections, executes what `Peers` (which connections) and `Link` (what goes over them) decide,
and delivers packets. Nothing here blocks. Methods for any thread post their work to the transport's thread.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from pancakes.errors import LocalProtocolError, PancakesError, PeerLostError
from pancakes.mesh.address import reachable_from
from pancakes.mesh.codec import Unfit
from pancakes.mesh.gossip import Gossiper
from pancakes.mesh.link import (
    Action,
    Greeted,
    Heard,
    Link,
    LinkTimes,
    Measured,
    Over,
    PacketsReceived,
    SendMessage,
    Up,
)
from pancakes.mesh.links import Alarm, LinkLog, Links
from pancakes.mesh.messages import AgentSeen, Goodbye, Gossip, Hello, Identity, LinkNews, Refusal
from pancakes.mesh.partial_mesh import DropWaiting, FewLinks
from pancakes.mesh.peer_clocks import PeerClocks
from pancakes.mesh.peers import RESTS_S, Admit, Decision, Dial, Peers, Rest, is_namesake
from pancakes.mesh.sending import Sending
from pancakes.mesh.session import OPEN, Gate, Session, Unwanted
from pancakes.mesh.sockets import why_near_only
from pancakes.mesh.transport import ConnectionHandler, Transport
from pancakes.mesh.trust import Trust
from pancakes.packet import Packet, agent_of
from pancakes.util.clock import Clock
from pancakes.util.timebase import Timebase

if TYPE_CHECKING:
    from pancakes.mesh.trust import RosterFault
    from pancakes.security.access import Access
    from pancakes.security.keys import Keys


def why_lost(
    packet: Packet, own: str, sleeps: bool, asleep: Mapping[str, float], there: Sequence[str]
) -> PancakesError:
    """Return the error for a packet that cannot go to its agent.

    Args:
        packet: the packet.
        own: the name of this agent.
        sleeps: whether its network sleeps.
        asleep: the peers that sleep, and for how many more seconds.
        there: the linked peers.
    """
    name = agent_of(packet.destination)
    what = f"the packet {packet.type!r} of {packet.source}"
    if name == own or not name:
        return LocalProtocolError(f"{what} is not for another agent, so the mesh cannot send it")
    if sleeps:
        return PeerLostError(f"{what} cannot go to {name}: the network of {own} sleeps")
    if name in asleep:
        return PeerLostError(f"{what} cannot go to {name}: it sleeps for another {asleep[name]:.1f} s")
    linked = ", ".join(there) or "no other agent"
    return PeerLostError(f"{what} cannot go to {name}: {own} has no link to it (it is connected to {linked})")


MAX_HANDSHAKES: Final = 256
"""Most incoming connections that are not links yet. A further one replaces the oldest without a hello."""


def handshake_to_end(sessions: Iterable[Session]) -> Session | None:
    """Return the connection that must end to make room for a new one: the least likely to become a link.

    It is the oldest that has not said hello, or else the oldest of all. None: there is room already.

    Args:
        sessions: all connections, the oldest first.
    """
    waiting = [session for session in sessions if not session.is_up and not session.address]
    if len(waiting) < MAX_HANDSHAKES:
        return None
    mute = [session for session in waiting if session.link is None or session.link.peer is None]
    return (mute or waiting)[0]


DRAINED_S: Final = 5.0
"""A draining link is closed after this time, if the peer does not close it."""
TOGETHER: Final = 0.1
"""Links are checked up to this share of a heartbeat late, so that one wake-up of the thread serves many."""


class Mesh:
    """The links of one agent.

    All callbacks run in the transport's thread and must not block. `send`, `announce`, `learn`, `redial`, `sleep`,
    `wake`, `stop` and all methods that only return something may be called from any thread.

    Args:
        identity: name, journal, fleet and role of this agent.
        transport: how bytes travel.
        listen: addresses to listen at, the best first; none for a client.
        peers: addresses that are always dialled.
        source: random numbers, which spread the retries.
        host_clock: the clock of hand-shakes and heartbeats.
        on_packets: takes (peer's name, packets, their bytes on the wire): all of one channel, type, source and
            destination, in their order.
        on_unfit: takes (peer's name, packet, reason) for a packet that does not fit its type or exceeds a limit of
            requests.
        on_peer_up: takes the peer's hello when a link is up.
        on_peer_down: takes (name, reason, seconds it sleeps): None if it does not sleep on purpose, infinity if it
            gave no time.
        on_log: takes (level, text).
        defer: runs a function at the end of the calling actor's turn, in the same thread and even if the turn
            fails, or at once outside of one; so several packets of a turn leave with one system call.
        gate: decides whether packets of guarded tasks may still leave.
        times: the times of links and membership.
        access: the rights of its peers; None: it is a terminal, which takes packets of any source on any channel.
        keys: the certificate of this agent or person, and the authorities that it trusts; None: no keys.
        timebase: returns its mission time and time of day; None: it is a terminal, which sends none.
        links: the number of links that it keeps; others are made while there is something to send. None: links to all.

    Attributes:
        clocks: the clocks of its peers.
        near_only: for each address that only this machine reaches against intention, the reason as a clause.
    """

    def __init__(
        self,
        identity: Identity,
        transport: Transport,
        listen: Sequence[str],
        peers: Sequence[str],
        source: random.Random,
        host_clock: Clock,
        on_packets: Callable[[str, list[Packet], int], None],
        on_unfit: Callable[[str, Packet, str], None],
        on_peer_up: Callable[[Hello], None],
        on_peer_down: Callable[[str, str, float | None], None],
        on_log: Callable[[str, str], None] = lambda level, text: None,
        defer: Callable[[Callable[[], None]], None] = lambda function: function(),
        gate: Gate = OPEN,
        times: LinkTimes | None = None,
        access: Access | None = None,
        keys: Keys | None = None,
        timebase: Callable[[], Timebase] | None = None,
        links: int | None = None,
    ) -> None:
        self.identity = identity
        self._gate = gate
        self._transport = transport
        self._listen_at, self._static = tuple(listen), tuple(peers)
        self.near_only: tuple[str, ...] = ()
        self._random = source
        self._now = host_clock.now
        self._on_packets, self._on_unfit = on_packets, on_unfit
        self._on_peer_up, self._on_peer_down = on_peer_up, on_peer_down
        self._times = times or LinkTimes()
        self._own = identity.hello()
        self._peers: Peers | None = None
        self._sessions: dict[int, Session] = {}
        self._draining: dict[int, Session] = {}  # ended here, still read until the peer acknowledges the goodbye
        self._sending = Sending(self._lost, defer, self.seek)
        self._links = Links(self._sending.change)
        self._log = LinkLog(on_log, peers)
        self._state = "new"
        self._asleep_until_s = 0.0
        self._few = FewLinks(links, source, host_clock.now()) if links is not None else None
        self._gossip = Gossiper(identity.role, self._links, self._tell, transport, self._few)
        later, now = transport.call_later, host_clock.now
        self._trust = Trust(identity.role, keys, access, self._links, self._tell, self._refuse, later, now, on_log)
        self.clocks = PeerClocks(timebase, now, self._links, self._tell)
        self._peers_alarm = Alarm(transport, self._now, self._run_peers)
        self._links_alarm = Alarm(transport, self._now, self._tick_links, TOGETHER * self._times.heartbeat_s)

    # From any thread

    @property
    def listen(self) -> tuple[str, ...]:
        """The addresses that it listens at, the best first; none if it does not listen, or not yet."""
        return self._own.listen

    def start(self) -> None:
        """Listen, and begin to dial.

        Raises:
            PancakesError: it cannot listen at one of its addresses; the sentence says why.
        """
        if self._state != "new":
            raise PancakesError(f"the mesh of {self.identity.name} was started before")
        found = [self._transport.listen(at, self._accept) for at in self._listen_at]
        self._own = self.identity.hello(found)
        self.near_only = tuple(filter(None, map(why_near_only, self._listen_at, found)))
        self._post(self._begin)

    def send(self, packet: Packet, retry: bool = False) -> int:
        """Send a packet to the agent in its destination; `*`: to all neighbours.

        Args:
            packet: what to send.
            retry: whether it was sent before; it then does not count as a mission packet again.

        Returns:
            To how many peers it was given. Neighbours that are too slow for it (destination `*`) do not get it; that is
                counted and logged.

        Raises:
            LocalProtocolError: it cannot be encoded, or is too large.
            PeerLostError: the agent is not connected; the sentence says whether it sleeps.
            PeerBusy: the agent is connected but too slow, and the channel may not lose packets.
        """
        return self._sending.send(packet, retry)

    def seek(self, agent: str) -> bool:
        """Have a link made to an agent that is known but not linked; return whether one is being made."""
        peers = self._peers
        if peers is None or self._state != "running" or not peers.knows(agent) or agent in peers.asleep(self._now()):
            return False
        self._post(self._seek, agent)
        return True

    def announce(self) -> None:
        """Send each peer the beacon of discovery: which agents are known here. It counts as a mission packet."""
        self._post(self._beacon)

    def mission_changed(self) -> None:
        """Tell all peers that the mission of this agent has begun."""
        self._post(self.clocks.on_mission_changed)

    def learn(self, addresses: Sequence[str]) -> None:
        """Dial these addresses as well, as if a peer had named them."""
        self._post(self._learn, tuple(addresses))

    def hear_of(self, agents: Sequence[AgentSeen], by: str) -> None:
        """Dial these agents as well, as if a peer had named them.

        Args:
            agents: the agents, each at an address that this machine can dial.
            by: who names them: the bounds for what one peer names hold for it. No name of an agent.
        """
        self._post(self._hear_of, tuple(agents), by)

    def redial(self) -> None:
        """Dial all known addresses without a connected agent now, instead of at their next attempt."""
        self._post(self._redial)

    def sleep(self, for_s: float | None = None) -> None:
        """Say goodbye for `for_s` seconds of host time (None: for an unknown time), and close all links.

        An agent that dials meanwhile gets the same goodbye. The sleep lasts until `wake`.
        """
        self._post(self._sleep, for_s)

    def wake(self) -> None:
        """Dial again after `sleep`."""
        self._post(self._wake)

    def reload_keys(self, dry_run: bool = False) -> bool:
        """See `Trust.reload_keys`."""
        return self._trust.reload_keys(dry_run)

    @property
    def roster_fault(self) -> RosterFault | None:
        """See `Trust.roster_fault`."""
        return self._trust.roster_fault

    def stop(self) -> None:
        """Say goodbye for good, and close all links. Close the transport afterwards."""
        self._post(self._stop)

    def neighbours(self) -> list[str]:
        """Return the names of the connected peers in the role `agent`, sorted."""
        return [session.peer for session in self._links.neighbours()]

    def connected(self) -> Mapping[str, Hello]:
        """Return what all connected peers said about themselves, by name, in the order of their names."""
        return self._links.connected()

    def rtt_s(self, peer: str) -> float | None:
        """Return the smoothed round trip time to a peer, or None if it is not known yet."""
        return self._links.rtt_s(peer)

    def mission_packets_sent(self) -> int:
        """Return how many packets and announcements went out, one for each peer; no heartbeats, no retries."""
        return self._links.mission_packets_sent()

    def describe(self) -> dict[str, Any]:
        """Return the state of the mesh as plain values, for the command line."""
        now_s = self._now()
        asleep = self._peers.asleep(now_s) if self._peers is not None else {}
        return {
            "name": self.identity.name,
            "role": self.identity.role,
            "fleet": self.identity.fleet,
            "listen": self.listen,
            "near_only": self.near_only,
            "ways": [{"address": it, **self._transport.facts(it).plain()} for it in self.listen],
            "state": self._state,
            "peers": self.links(),
            "asleep": [{"name": name, "for_s": None if for_s == math.inf else for_s} for name, for_s in asleep.items()],
            "addresses": self._peers.book.describe() if self._peers is not None else [],
            "few": self._few.describe() if self._few is not None else None,
            "mission_packets_sent": self.mission_packets_sent(),
        }

    def links(self) -> list[dict[str, Any]]:
        """Return the state of the links that are up, by the names of their peers. Any thread."""
        facts, clock = self._transport.facts, self.clocks.describe
        return [{**row, **facts(row["remote"]).plain(), "clock": clock(row["name"])} for row in self._links.describe()]

    def awaits_peers(self) -> bool:
        """See `AddressBook.are_awaited`. Any thread."""
        return self._peers.book.are_awaited() if self._peers is not None else bool(self._static)

    def _lost(self, packet: Packet) -> PancakesError:
        """Return the error for a packet that cannot go to its agent."""
        asleep = self._peers.asleep(self._now()) if self._peers is not None else {}
        return why_lost(packet, self.identity.name, self._state == "asleep", asleep, [it.peer for it in self._links])

    def _post(self, function: Callable[..., None], *arguments: Any) -> None:
        """Run a function in the transport's thread."""
        self._transport.call_later(0.0, partial(function, *arguments))

    # In the transport's thread from here on

    def _begin(self) -> None:
        if self._state != "new":
            return
        times, ways = self._times, (self._transport.may_be_named, self._transport.reach)
        self._peers = Peers(self._own, self._static, self._random, times, self._now(), self._quiet_s, *ways, self._few)
        self._state = "running"  # from now on `describe` is complete
        self._trust.begin()
        self._run_peers()

    def _learn(self, addresses: tuple[str, ...]) -> None:
        if self._peers is not None and self._state == "running":
            self._carry_out(self._peers.on_addresses(addresses, self._now()))

    def _hear_of(self, agents: tuple[AgentSeen, ...], by: str) -> None:
        if self._peers is not None and self._state == "running":
            for it in agents:
                self._carry_out(self._peers.on_gossip((it,), self._now(), by, it.address))

    def _seek(self, agent: str) -> None:
        if self._peers is not None and self._state == "running":
            self._carry_out(self._peers.seek(agent, self._now()))
        else:  # it has just gone to sleep
            self._log.given_up(agent, self._sending.give_up(agent))

    def _redial(self) -> None:
        if self._peers is not None and self._state == "running":
            self._peers.redial(self._now())
            self._run_peers()

    def _sleep(self, for_s: float | None) -> None:
        if self._state == "running":
            self._state = "asleep"
            self._asleep_until_s = math.inf if for_s is None else self._now() + for_s
            self._leave()

    def _wake(self) -> None:
        if self._state == "asleep" and self._peers is not None:
            self._state = "running"
            self._redial()

    def _stop(self) -> None:
        if self._state != "stopped":
            self._state = "stopped"
            self._leave()

    def _leave(self) -> None:
        for session in list(self._draining.values()):
            self._end_draining(session, "this agent left the mesh")
        for session in list(self._sessions.values()):
            if session.link is not None:
                self._act(session, session.link.leave(self._goodbye(), self._now()))
            else:
                self._over(session, Over("this agent left the mesh"))
        self._arm()

    def _goodbye(self) -> Goodbye:
        if self._state == "stopped":
            return Goodbye("stop")
        left_s = self._asleep_until_s - self._now()
        return Goodbye("sleep", None if left_s == math.inf else max(0.0, left_s))

    def _beacon(self) -> None:
        if self._peers is not None:
            self._gossip.beacon(self._own, self._peers, self._now())

    def _accept(self) -> ConnectionHandler:
        if self._peers is None or self._state == "stopped":
            return Unwanted()
        if (oldest := handshake_to_end(self._sessions.values())) is not None:
            full = f"is full: {MAX_HANDSHAKES} connections have not become links, and this is the oldest"
            self._refuse(oldest, "full", f"{self.identity.name} {full}", f"it {full}")
        session = Session(self, self._peers.new_link(), "", self._now, self._gate)
        self._sessions[session.number] = session
        return session

    def _quiet_s(self, link: int, now_s: float) -> float:
        return self._sessions[link].quiet_s(now_s)

    def session_opened(self, session: Session) -> None:
        """See `Owner`."""
        if session.number not in self._sessions:  # ended while it was being dialled
            session.end("it is no longer wanted")
            return
        now_s = self._now()
        own = replace(self._own, listen=reachable_from(session.remote, self._own.listen, self._transport.reach))
        rests = self._transport.facts(session.remote).tells_deaths
        session.link = Link(own, self._times.rested() if rests else self._times, now_s, answers=not session.address)
        self._act(session, session.link.open(now_s))
        self._watch(session)

    def session_received(self, session: Session, data: bytes) -> None:
        """See `Owner`."""
        if session.link is None:
            return
        now_s = self._now()
        if session.number in self._draining:
            for action in session.link.receive(data, now_s):
                if isinstance(action, PacketsReceived):
                    self._deliver(session, action)
            return
        was_up = session.is_up
        actions = session.link.receive(data, now_s)
        # If all sessions are up, as most of the time, this link cannot make another one needless.
        if was_up and self._peers is not None and len(self._sessions) > len(self._links):
            rivals = self._peers.on_bytes(session.number)
            if rivals:
                self._carry_out(rivals)
        self._act(session, actions)

    def session_closed(self, session: Session, reason: str) -> None:
        """See `Owner`."""
        if session.number in self._sessions:
            self._over(session, Over(reason))
        self._end_draining(session, reason)

    def _act(self, session: Session, actions: Sequence[Action]) -> None:
        """Execute the actions of a link."""
        for action in actions:
            if session.number not in self._sessions or self._peers is None:
                return  # an earlier action ended it
            if isinstance(action, PacketsReceived):
                self._deliver(session, action)
            elif isinstance(action, SendMessage):
                session.send_link(action.message)
            elif isinstance(action, Unfit):
                self._deliver_unfit(session, action)
            elif isinstance(action, Measured):
                self.clocks.on_answer(session, action)
                self._watch(session)
            elif isinstance(action, Heard):
                self._on_news(session, action.message, self._peers)
            elif isinstance(action, Greeted):
                self._on_hello(session, action.hello)
            elif isinstance(action, Up):
                self._on_link_up(session)
            else:
                self._over(session, action)

    def _deliver(self, session: Session, came: PacketsReceived) -> None:
        """Pass on packets with one head, if the peer may send them."""
        first, number = came.packets[0], len(came.packets)
        session.counters.packets_in += number
        if not self._may_send(session, first, number):
            return
        if too_much := self._trust.asks_too_much(session, first, number):
            for packet in came.packets:
                self._log.attempt(self._on_unfit, session.peer, packet, too_much)
        else:
            self._log.attempt(self._on_packets, session.peer, came.packets, came.size)

    def _deliver_unfit(self, session: Session, came: Unfit) -> None:
        """Pass on a packet whose body does not fit its type."""
        session.counters.packets_in += 1
        if self._may_send(session, came.packet, 1):
            self._log.attempt(self._on_unfit, session.peer, came.packet, came.reason)

    def _may_send(self, session: Session, first: Packet, number: int) -> bool:
        """Return whether the peer may send packets with this head; if not, count and log them."""
        if not (fault := self._trust.fault_of_packet(session, first)):
            return True
        self._log.false_source(session, fault, number, self._now())
        return False

    def _end_draining(self, session: Session, reason: str) -> None:
        """Close the connection of a draining link; leave any other open."""
        if self._draining.pop(session.number, None) is not None:
            session.end(reason)

    def _on_news(self, session: Session, news: LinkNews, peers: Peers) -> None:
        """Take news of the fleet from a peer."""
        if isinstance(news, Gossip):
            self._carry_out(peers.on_gossip(news.agents, self._now(), session.peer, session.remote))
        elif isinstance(news, Timebase):
            self.clocks.on_answer(session, news)
            self._watch(session)
        else:
            self._trust.on_roster(session, news)

    def _on_hello(self, session: Session, hello: Hello) -> None:
        assert session.link is not None and self._peers is not None
        now_s = self._now()
        if fault := self._trust.fault_of_hello(session, hello):
            self._refuse(session, "name", fault)
            return
        decisions = self._peers.on_hello(session.number, hello, session.remote, now_s)
        if not is_namesake(session.number, decisions):
            self._act(session, session.link.answer(now_s))
        if self._state == "running":
            self._carry_out(decisions)
        else:
            self._act(session, session.link.leave(self._goodbye(), now_s))
        self._watch(session)  # from now on it sends heartbeats

    def _refuse(self, session: Session, code: Refusal, reason: str, told: str = "") -> None:
        """End a link, if it has not ended, and tell the peer why; `told`: see `Link.refuse`."""
        if session.link is None:
            self._over(session, Over(reason))
        elif session.number in self._sessions:
            self._act(session, session.link.refuse(code, reason, self._now(), told))

    def _on_link_up(self, session: Session) -> None:
        assert session.link is not None and session.link.peer is not None and self._peers is not None
        self._carry_out(self._peers.on_link_up(session.number, self._now()))
        if session.number not in self._sessions:
            return
        hello = next(peer for peer in self._peers.connected() if peer.name == session.link.peer.name)
        self._links.add(session, hello)
        self.clocks.on_link_up(session)
        self._watch(session)
        self._log.on_link_up(session, hello)
        self._log.attempt(self._on_peer_up, hello)
        self._gossip.on_link_up(session, self._peers, self._now())
        self._trust.on_link_up(session)

    def _over(self, session: Session, over: Over) -> None:
        assert self._peers is not None
        del self._sessions[session.number]
        if session.number not in self._draining:
            session.end(over.reason)
        why = over.refused or over.refusing
        refusal = over.reason if over.refused is not None or over.turned_away else ""
        decisions = self._peers.on_link_over(session.number, self._now(), why, over.goodbye, over.broken, refusal)
        if session.is_up:
            self._links.remove(session)
            asleep_s = None
            if over.goodbye is not None and over.goodbye.why == "sleep":
                asleep_s = math.inf if over.goodbye.for_s is None else over.goodbye.for_s
            self.clocks.on_link_ended(session)
            self._log.on_link_ended(session, over)
            self._log.attempt(self._on_peer_down, session.peer, over.reason, asleep_s)
        elif self._state == "running":
            self._log.not_made(session, over, self._now())
        if self._state == "running":
            self._carry_out(decisions)

    def _carry_out(self, decisions: Sequence[Decision]) -> None:
        """Execute the decisions of membership."""
        for decision in decisions:
            if isinstance(decision, Dial):
                session = Session(self, decision.link, decision.address, self._now, self._gate)
                self._sessions[session.number] = session
                self._transport.dial(decision.address, session)
                continue
            if isinstance(decision, DropWaiting):
                self._log.given_up(decision.name, self._sending.give_up(decision.name))
                continue
            found = self._sessions.get(decision.link)
            if found is None or found.link is None:
                continue
            if isinstance(decision, Admit):
                self._act(found, found.link.admit(self._now()))
            elif isinstance(decision, Rest):
                self._act(found, found.link.rest(Goodbye("rest", RESTS_S), self._now()))
                self._draining[found.number] = found
                self._transport.call_later(DRAINED_S, partial(self._end_draining, found, "it rests"))
                self._over(found, Over(f"{self.identity.name} has no use for it now"))
            else:
                self._refuse(found, decision.code, decision.reason)
        self._arm()

    def _arm(self) -> None:
        """Set the alarm for `_run_peers` to when membership has something to do."""
        due_s = self._peers.due_s() if self._peers is not None and self._state == "running" else math.inf
        self._peers_alarm.set(due_s)

    def _run_peers(self) -> None:
        if self._peers is not None and self._state == "running":
            self._carry_out(self._peers.tick(self._now()))

    def _tell(self, session: Session, message: LinkNews) -> None:
        if session.link is not None:
            self._act(session, session.link.tell(message, self._now()))

    def _watch(self, session: Session) -> None:
        """Set the alarm so that a link is checked when its next heartbeat or time-out is due."""
        if session.link is not None and session.number in self._sessions:
            session.due_s = session.link.due_s()
            if session.due_s < self._links_alarm.due_s:
                self._links_alarm.set(session.due_s)

    def _tick_links(self) -> None:
        self._links_alarm.due_s = -math.inf  # so that it is not set for each link
        now_s = self._now()
        try:
            for session in list(self._sessions.values()):
                if session.due_s <= now_s:
                    self._tick_link(session, now_s)
        finally:
            self._links_alarm.set(min([session.due_s for session in self._sessions.values()], default=math.inf))

    def _tick_link(self, session: Session, now_s: float) -> None:
        """Send a heartbeat that is due, and end a link whose peer takes no more bytes."""
        link = session.link
        if link is None or session.number not in self._sessions:
            return
        if session.is_up:
            if session.stuck_s(now_s) >= (limit_s := self._times.stuck_s):
                self._over(session, Over(f"{session.peer} took none of the waiting bytes for {limit_s:g} s"))
                return
            session.quiet_s(now_s)
            if session.counters.dropped:
                self._log.drops(session, now_s)
        due_s = link.due_s()
        if due_s > now_s:  # usually something was sent meanwhile, and nothing is due
            session.due_s = due_s
            return
        self._act(session, link.tick(now_s))
        self._watch(session)
