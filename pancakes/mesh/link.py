"""The state machine of one link to another agent: bytes and host time go in, actions come out. Pure.

    GREETING --hello--> MET --welcome--> UP --refuse, goodbye, silence, broken protocol--> OVER

The side that dialled says hello first. The other side tells a stranger nothing about itself: it answers with its own
hello only after it has accepted that one. A refusal or a goodbye before any hello only ends the attempt, because any
program may be listening there.

Two agents may have several connections for a moment: both dialled, or one came back before the other noticed that it
had gone. The agent with the lower name chooses. It sends `Welcome` on the connection that stays, and only then do
packets flow, on either side. So no packet is lost or overtaken when a connection is given up for another. The caller
(`Mesh`) sends the bytes and supplies the time.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

import msgspec

from pancakes.errors import RemoteProtocolError
from pancakes.mesh.codec import (
    FrameReader,
    PacketRun,
    Unfit,
    encode_link_message,
    foreign_version,
    messages_from_payload,
    packets_of,
)
from pancakes.mesh.messages import (
    Goodbye,
    Gossip,
    Hello,
    LinkMessage,
    LinkNews,
    Ping,
    Pong,
    Refusal,
    RefuseLink,
    Welcome,
    fault_of_gossip,
    fault_of_hello,
)
from pancakes.packet import Packet

PATIENCE: Final = 1.2
"""How much longer than `LinkTimes.heartbeat_s` the agent with the higher name waits before a heartbeat."""
PACE: Final = 1.5
"""The factor by which the pause between the first pings grows."""
MOST_UNANSWERED: Final = 8
"""An answer to an older ping says nothing about the link now."""
RESTED: Final = 40
"""The factor by which heartbeats are rarer if the transport reports the deaths of peers."""
_RTT_WEIGHT: Final = 1 / 8  # of a new measurement in the average, as in TCP (RFC 6298)


class LinkTimes(msgspec.Struct, frozen=True):
    """All times of links and membership, in seconds of the host clock.

    Attributes:
        hello_s: how long a peer may take for its hello.
        heartbeat_s: a ping is sent after this time without other bytes.
        missed: after this many heartbeats without a byte the peer counts as gone: after `heartbeat_s * missed`, 2.0 s.
        measure_s: even a busy link sends a ping this often, to measure the round trip and the peer's clock.
        first_s: the first ping is sent once the link is up, the second this much later, the others at growing
            intervals.
        stuck_s: the link ends if the peer takes none of the waiting bytes for this time.
        hold_s: how long a connection dialled by the higher name waits for our own dial to the same agent.
        retry_first_s: an address is dialled again after a random time up to this, which doubles with each failure.
        retry_longest_s: the largest bound of that time.
    """

    hello_s: float = 2.0
    heartbeat_s: float = 0.5
    missed: int = 4
    measure_s: float = 5.0
    first_s: float = 0.1
    stuck_s: float = 5.0
    hold_s: float = 0.5
    retry_first_s: float = 0.1
    retry_longest_s: float = 10.0

    @property
    def gone_s(self) -> float:
        """How long a peer may be silent before it counts as gone."""
        return self.heartbeat_s * self.missed

    def rested(self) -> LinkTimes:
        """Return the times for a transport that reports deaths: heartbeats are rare."""
        heartbeat_s = self.heartbeat_s * RESTED
        return msgspec.structs.replace(self, heartbeat_s=heartbeat_s, measure_s=max(self.measure_s, heartbeat_s))


class LinkState(Enum):
    """The state of a link; see the module's docstring."""

    GREETING = "greeting"
    MET = "met"
    UP = "up"
    OVER = "over"


class SendMessage(msgspec.Struct, frozen=True):
    """Send this message, before any packet that waits."""

    message: bytes


class Greeted(msgspec.Struct, frozen=True):
    """The peer said hello; call `Link.answer`, then `Link.admit` (the lower name, once), or else `Link.refuse`."""

    hello: Hello


class Up(msgspec.Struct, frozen=True):
    """The link is up: packets may flow."""


class PacketsReceived(msgspec.Struct, frozen=True):
    """Packets came in, in this order: with one channel, type, source and destination.

    Attributes:
        packets: the packets.
        size: their size in bytes, without the head of their run.
    """

    packets: list[Packet]
    size: int


class Measured(msgspec.Struct, frozen=True):
    """A ping came back.

    Attributes:
        sent_s: when it was sent, in host time.
        peer_s: when the peer answered it, in the peer's host time.
        back_s: when the answer came, in host time.
    """

    sent_s: float
    peer_s: float
    back_s: float


class Heard(msgspec.Struct, frozen=True):
    """The peer sent news of the fleet: agents, its clocks, or its roster."""

    message: LinkNews


class Over(msgspec.Struct, frozen=True):
    """The link has ended: close the connection once everything is sent. Always the last action.

    Attributes:
        reason: a sentence for people.
        refused: the peer's refusal of us, if that ended it and the peer had said hello.
        refusing: our refusal of the peer, if that ended it.
        goodbye: the peer's goodbye, if that ended it.
        broken: whether the peer broke the protocol.
        turned_away: whether the other side refused us before it said hello.
    """

    reason: str
    refused: Refusal | None = None
    refusing: Refusal | None = None
    goodbye: Goodbye | None = None
    broken: bool = False
    turned_away: bool = False


Action = SendMessage | Greeted | Up | PacketsReceived | Unfit | Measured | Heard | Over


class Link:
    """One link.

    Args:
        own: our own hello.
        times: its times.
        now_s: host time at which the connection was opened.
        answers: whether the other side dialled, so that it says hello first.

    Attributes:
        state: its state.
        peer: what the peer said about itself, once it has.
        rtt_s: smoothed round trip time, once measured.
        sent_s: when something was last sent, so that no heartbeat is needed; set by each thread that sends packets.
        pace_s: how long after a ping the next one is sent, also if the link is busy; it grows to `measure_s`.
    """

    def __init__(self, own: Hello, times: LinkTimes, now_s: float, answers: bool = False) -> None:
        self.state = LinkState.GREETING
        self.peer: Hello | None = None
        self.rtt_s: float | None = None
        self.pace_s = times.first_s / PACE
        self._own = own
        self._times = times
        self._answers = answers
        self._quiet_s = times.heartbeat_s  # after this silence of ours a ping is sent
        self._opened_s = now_s
        self._heard_s = now_s
        self.sent_s = now_s
        self._pinged_s = now_s
        self._pings = 0
        self._excused_s = float("-inf")
        self._patient_until_s = float("-inf")
        self._unanswered: dict[int, float] = {}
        self._reader = FrameReader()

    def open(self, now_s: float) -> list[Action]:
        """Begin. Call it once, when the connection is open."""
        return [] if self._answers else [self._send(self._own, now_s)]

    def due_s(self) -> float:
        """Return the host time at which `tick` has something to do, unless bytes come in earlier."""
        if self.state is LinkState.OVER:
            return float("inf")
        if self.state is LinkState.GREETING:
            return self._end_s()
        return min(self.sent_s + self._quiet_s, self._pinged_s + self._measure_s(), self._end_s())

    def _measure_s(self) -> float:
        return self.pace_s if self.state is LinkState.UP else self._times.measure_s

    def _set_quiet(self) -> None:
        """Set after how long a silence of ours a ping is sent.

        Of two silent agents, the one with the lower name pings first, and the other's answer is its sign of life:
        half as many heartbeats.
        """
        # A side that waits for the other's pings measures nothing: the round trip must be known first.
        patient = self.peer is not None and self.rtt_s is not None and self._own.name > self.peer.name
        self._quiet_s = self._times.heartbeat_s * (PATIENCE if patient else 1.0)

    def tick(self, now_s: float) -> list[Action]:
        """Do what is due: send a heartbeat, or end a silent link."""
        if self.state is LinkState.OVER:
            return []
        end_s = self._end_s()
        if now_s >= end_s:
            is_late = now_s - end_s > self._times.heartbeat_s
            if self._excused_s > self._heard_s or not (is_late or self.state is LinkState.UP):
                return self._over(self._silence())
            self._excused_s = now_s
            if not is_late:
                # Perhaps this thread was delayed since it last read: it must read again first.
                return []
            # We are late for lack of processor time, and perhaps the peer's bytes are, too.
            self._patient_until_s = now_s + self._times.heartbeat_s
        if self.state is LinkState.GREETING:  # a heartbeat would reveal to a stranger what listens here
            return []
        quiet = now_s >= self.sent_s + self._quiet_s
        if quiet or now_s >= self._pinged_s + self._measure_s():
            self._pings += 1
            if self.state is LinkState.UP:
                self.pace_s = min(PACE * self.pace_s, self._times.measure_s)
            self._pinged_s = now_s
            self._unanswered[self._pings] = now_s
            while len(self._unanswered) > MOST_UNANSWERED:
                del self._unanswered[next(iter(self._unanswered))]
            return [self._send(Ping(self._pings), now_s)]
        return []

    def receive(self, data: bytes, now_s: float) -> list[Action]:
        """Take bytes that came in. If they break the protocol, the last action is `Over`."""
        if self.state is LinkState.OVER:
            return []
        self._heard_s = now_s  # any byte counts as life
        actions: list[Action] = []
        try:
            for payload in self._reader.feed(data):
                self._payload(payload, now_s, actions)
                if self.state is LinkState.OVER:
                    break
        except RemoteProtocolError as error:
            actions.append(self._send(RefuseLink("protocol", str(error)[:1000]), now_s))
            actions.extend(self._over(f"{self._who()} broke the protocol: {error}", broken=True))
        return actions

    def answer(self, now_s: float) -> list[Action]:
        """Say hello, after `Greeted`, if the other side dialled and its hello is accepted."""
        if self.state is not LinkState.MET or not self._answers:
            return []
        self._answers = False
        return [self._send(self._own, now_s)]

    def admit(self, now_s: float) -> list[Action]:
        """Make this the link that stays. Only the lower name does so, after `Greeted`."""
        if self.state is not LinkState.MET:
            return []
        return [self._send(Welcome(), now_s), self._up(now_s)]

    def refuse(self, code: Refusal, reason: str, now_s: float, told: str = "") -> list[Action]:
        """Tell the peer why it is refused, and end the link.

        Args:
            code: why, for programs.
            reason: why, for people here.
            now_s: host time.
            told: the reason that the peer gets if it is a stranger, without facts on this agent; empty: `reason`.
        """
        if self.state is LinkState.OVER:
            return []
        return [self._send(RefuseLink(code, (told or reason)[:1000]), now_s), *self._over(reason, refusing=code)]

    def leave(self, goodbye: Goodbye, now_s: float) -> list[Action]:
        """Say goodbye, and end the link."""
        if self.state is LinkState.OVER:
            return []
        return [self._send(goodbye, now_s), *self._over("this agent said goodbye")]

    def rest(self, goodbye: Goodbye, now_s: float) -> list[Action]:
        """Say goodbye as the last message, and still read what the peer sent before it got that."""
        return [self._send(goodbye, now_s)]

    def hurry(self) -> None:
        """Send the next pings as fast as the first ones: nothing is known of the peer's clock any more."""
        self.pace_s = self._times.first_s

    def tell(self, message: LinkNews, now_s: float) -> list[Action]:
        """Send the peer news of the fleet, if the link is up."""
        return [self._send(message, now_s)] if self.state is LinkState.UP else []

    def _up(self, now_s: float) -> Up:
        self.state = LinkState.UP
        self._pinged_s = now_s - self.pace_s  # the first ping is due
        return Up()

    def _who(self) -> str:
        return self.peer.name if self.peer is not None else "the other side"

    def _end_s(self) -> float:
        """Return when the link ends if nothing comes in."""
        end_s = self._heard_s + self._times.gone_s
        if self.state is LinkState.GREETING:
            end_s = self._opened_s + self._times.hello_s
        elif self.state is LinkState.MET:
            end_s = min(end_s, self._no_welcome_s())
        return max(end_s, self._patient_until_s)

    def _no_welcome_s(self) -> float:
        # The agent with the lower name may first have to notice that an older link has died.
        return self._opened_s + self._times.hello_s + self._times.gone_s

    def _silence(self) -> str:
        """Return why the link ends if nothing comes in."""
        times = self._times
        if self.state is LinkState.GREETING:
            return f"no hello came within {times.hello_s:g} s"
        if self.state is LinkState.MET and self._no_welcome_s() < self._heard_s + times.gone_s:
            return f"{self._who()} did not say welcome in {times.hello_s + times.gone_s:g} s"
        return f"nothing was heard from {self._who()} for {times.gone_s:g} s"

    def _send(self, message: LinkMessage, now_s: float) -> SendMessage:
        self.sent_s = now_s
        return SendMessage(encode_link_message(message))

    def _over(
        self,
        reason: str,
        refused: Refusal | None = None,
        refusing: Refusal | None = None,
        goodbye: Goodbye | None = None,
        broken: bool = False,
        turned_away: bool = False,
    ) -> list[Action]:
        self.state = LinkState.OVER
        return [Over(reason, refused, refusing, goodbye, broken, turned_away)]

    def _payload(self, payload: memoryview, now_s: float, actions: list[Action]) -> None:
        try:
            messages = messages_from_payload(payload)
        except RemoteProtocolError:
            theirs = foreign_version(payload, self._own.version) if self.state is LinkState.GREETING else None
            if theirs is None:
                raise
            actions.extend(self._other_version(theirs, now_s))
            return
        for message in messages:
            if isinstance(message, PacketRun):
                if self.state is not LinkState.UP:
                    raise RemoteProtocolError("a packet came before the link was up")
                packets, unfit = packets_of(message)
                if packets:
                    actions.append(PacketsReceived(packets, memoryview(message.rows).nbytes))
                actions.extend(unfit)
                continue
            actions.extend(self._message(message, now_s))
            if self.state is LinkState.OVER:
                return

    def _other_version(self, theirs: object, now_s: float) -> list[Action]:
        own = self._own.version
        told = f"it speaks version {own} of the protocol and is spoken to in version {theirs}"
        reason = f"{self._own.name} speaks version {own} of the protocol and the other side version {theirs}"
        return self.refuse("version", reason, now_s, told)

    def _from_stranger(self, message: LinkMessage, now_s: float) -> list[Action]:
        match message:
            case Hello():
                return self._hello(message, now_s)
            case RefuseLink(_, reason):
                one_line = " ".join(reason.split())
                return self._over(f"what listens there refused the link: {one_line}", turned_away=True)
            case Goodbye():
                return self._over("what listens there left before it said hello")
        raise RemoteProtocolError(f"{type(message).__name__} came before the hello")

    def _hello(self, hello: Hello, now_s: float) -> list[Action]:
        own = self._own
        if hello.version != own.version:
            return self._other_version(hello.version, now_s)
        if fault := fault_of_hello(hello):
            raise RemoteProtocolError(f"its hello cannot be taken: {fault}")
        if hello.fleet != own.fleet:
            told = f"it is not of the fleet {hello.fleet!r}"
            if hello.role == "client":
                told += "; --fleet names another"
            reason = f"{own.name} is of the fleet {own.fleet!r} and {hello.name} of {hello.fleet!r}"
            return self.refuse("fleet", reason, now_s, told)
        self.peer = hello
        self._set_quiet()
        self.state = LinkState.MET
        return [Greeted(hello)]

    def _message(self, message: LinkMessage, now_s: float) -> list[Action]:
        if self.state is LinkState.GREETING:
            return self._from_stranger(message, now_s)
        match message:
            case Ping(token):
                return [self._send(Pong(token, now_s), now_s)]
            case Pong(token, at_s):
                return self._pong(token, at_s, now_s)
            case Hello():
                raise RemoteProtocolError("a second hello came")
            case RefuseLink(code, reason):
                return self._over(f"{self._who()} refused the link: {reason}", refused=code)
            case Goodbye(why, for_s):
                until = "" if for_s is None else f" for {for_s:g} s"
                did = {"sleep": f"sleeps{until}", "stop": "stopped", "rest": "has no use for it now"}
                return self._over(f"{self._who()} {did[why]}", goodbye=message)
        if isinstance(message, Welcome):
            if self.state is not LinkState.MET or self.peer is None or self._own.name < self.peer.name:
                raise RemoteProtocolError("a welcome came that was not the peer's to send")
            return [self._up(now_s)]
        if self.state is not LinkState.UP:
            raise RemoteProtocolError(f"{type(message).__name__} came before the link was up")
        if isinstance(message, Gossip) and (fault := fault_of_gossip(message)):
            raise RemoteProtocolError(fault)
        return [Heard(message)]

    def _pong(self, token: int, at_s: float, now_s: float) -> list[Action]:
        pinged_s = self._unanswered.pop(token, None)
        if pinged_s is None:
            return []  # an old one, which says nothing about the link now
        measured_s = now_s - pinged_s
        if self.rtt_s is None:
            self.rtt_s = measured_s
            self._set_quiet()
        else:
            self.rtt_s += _RTT_WEIGHT * (measured_s - self.rtt_s)
        return [Measured(pinged_s, at_s, now_s)]
