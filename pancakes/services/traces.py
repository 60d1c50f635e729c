"""Trace what led to the commands of an agent's actuators, while a client asks for it.

An answer takes some milliseconds of a busy agent, so it is found in several turns. Imported only when asked for.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from operator import itemgetter
from typing import Any, Final

import msgspec

from pancakes.control import Traces
from pancakes.errors import ControlRefusedError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.payload_size import weight_of
from pancakes.packet import LOG, SYSCTRL, Cause, Packet, agent_of
from pancakes.recording.causal_chains import LONGEST, body_text, is_command
from pancakes.util import codecs
from pancakes.util.clock import wall_ns

LEASE_S: Final = 10.0
"""So long after a client asked last, in host time, packets are noted: it may have gone without a word."""
LOOK_LATER_S: Final = 0.1
WAITING: Final = 20_000
"""The limit of packets that are noted between two questions; of more, the oldest are forgotten."""
KEPT_NS: Final = 8_000_000_000
"""A packet is remembered this long; what it led to elsewhere may be asked about seconds later."""
MOST_KEPT: Final = 20_000
MOST_ROWS: Final = 600
"""At most this many packets go into one answer."""
STEP: Final = 100
"""In one turn at most this many packets are taken or forgotten. It takes about 0.1 ms, which delays ticks, ..."""
CHAINS_STEP: Final = 25
"""... this many commands are followed back to what led to them, ..."""
ROWS_STEP: Final = 25
"""... and rows are made of this many packets."""
MOST_QUESTIONS: Final = 64
"""At most this many questions wait for their answers; further ones are refused, ..."""
MOST_ASKERS: Final = 16
"""... and those of further askers of one agent."""
LARGE_BYTES: Final = 4096
"""What packets say is not kept of types whose packets are larger: images would fill the memory."""

Told = Callable[[dict[str, Any] | None], None]
"""Takes the answer to a question; None: it has none."""

_TIME: Final = itemgetter(0)
_JSON: Final = codecs.json_encoder(lambda value: value.tolist() if hasattr(value, "tolist") else str(value))


class TracedPackets:
    """The newest packets, and which of them led to commands. Pure.

    Args:
        agent: the agent's name.
    """

    def __init__(self, agent: str) -> None:
        self._agent = agent
        self._waiting: deque[tuple[int, Packet]] = deque(maxlen=WAITING)
        self._known: OrderedDict[Cause, tuple[int, Packet]] = OrderedDict()
        self._commands: deque[tuple[int, Cause]] = deque(maxlen=MOST_KEPT)
        self._large: frozenset[str] = frozenset()

    def hear(self, time_ns: int, packet: Packet) -> None:
        """Take a packet that was seen here. In any thread, and of little cost: everything that is published comes."""
        if packet.type in self._large or weight_of(packet.body) > LARGE_BYTES:
            packet = msgspec.structs.replace(packet, body=None)
        self._waiting.append((time_ns, packet))

    def answer(self, asked: Traces, now_ns: int) -> dict[str, Any]:
        """Return the answer to a question, see `Traces`. In one thread."""
        steps = self.answering(asked, now_ns)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                answer: dict[str, Any] = end.value
                return answer

    def answering(self, asked: Traces, now_ns: int) -> Generator[None, None, dict[str, Any]]:
        """Find the answer in steps, which are short so that others may have a turn between them.

        No other answer may be begun before its end. In one thread.

        Returns:
            The answer, see `Traces`.
        """
        yield from self._take(now_ns)
        known = self._known
        given = [(time_ns, key) for time_ns, key in self._commands if time_ns > asked.since_ns]
        stride = max(1, -(-len(given) // max(1, asked.most)))
        chosen = given[::-1][::stride][::-1]  # the newest is always among them
        seen: dict[Cause, tuple[int, Packet]] = {}
        left_out = len(given) - len(chosen)
        for number, key in enumerate((*asked.packets, *(key for _, key in chosen))):
            if number % CHAINS_STEP == CHAINS_STEP - 1:
                yield
            if len(seen) >= MOST_ROWS:
                left_out += 1
                continue
            chain: list[Cause] = []
            found: Cause | None = key
            # A packet that is reported already was reported with all that led to it.
            while found is not None and found in known and found not in seen and len(chain) < LONGEST:
                chain.append(found)
                cause = known[found][1].cause
                found = (cause[0], cause[1]) if cause is not None else None
            for found in reversed(chain):
                seen[found] = known[found]
        rows: list[list[Any]] = []
        for time_ns, packet in sorted(seen.values(), key=_TIME):
            if len(rows) % ROWS_STEP == 0:
                yield
            rows.append(_row(time_ns, packet))
        yield  # the answer itself still has to be sent
        return {
            "now_ns": now_ns,
            "until_ns": given[-1][0] if given else max(asked.since_ns, 0),
            "left_out": left_out,
            "rows": rows,
        }

    def _take(self, now_ns: int) -> Iterator[None]:
        """Find a place for what has come since the last time."""
        waiting, known = self._waiting, self._known
        fresh: dict[str, Packet] = {}
        for number in range(len(waiting)):
            if number % STEP == STEP - 1:
                yield
            try:
                it = waiting.popleft()
            except IndexError:  # an old one fell out just now
                break
            packet = it[1]
            key = (packet.source, packet.seq)
            if key in known:
                continue
            known[key] = it
            fresh[packet.type] = packet
            if is_command(self._agent, packet):
                self._commands.append((it[0], key))
        yield
        count = 0
        while known and (len(known) > MOST_KEPT or next(iter(known.values()))[0] < now_ns - KEPT_NS):
            known.popitem(last=False)
            count += 1
            if count % STEP == 0:
                yield
        while self._commands and self._commands[0][1] not in known:
            self._commands.popleft()
        yield
        self._weigh(fresh.values())
        yield

    def _weigh(self, packets: Iterable[Packet]) -> None:
        """Find out of which types packets are large."""
        large = {packet.type for packet in packets if packet.body is not None and _size(packet.body) > LARGE_BYTES}
        if not large <= self._large:
            self._large |= large


class Tracing:
    """Notes the packets of an agent for as long as a client asks what led to its commands.

    An answer takes some milliseconds of a busy agent, so it is found in several of the owner's turns.

    Args:
        owner: the component in whose turns questions are answered.
    """

    def __init__(self, owner: ActorCore) -> None:
        self._owner = owner
        self._packets: TracedPackets | None = None
        self._taps: dict[str, Callable[[Packet], None]] = {}
        self._asked_s: dict[str, float] = {}
        self._questions: deque[tuple[Traces, Told]] = deque()
        self._steps: Generator[None, None, dict[str, Any]] | None = None

    def answer(self, asked: Traces, by: str, told: Told) -> None:
        """Answer a question; the first one begins it all. In the owner's turn.

        Args:
            asked: the question; with `most` 0 it is the last one, and has no answer.
            by: the address of the asker.
            told: called with the answer, in this turn or a later one.

        Raises:
            ControlRefusedError: too many questions wait already.
        """
        now_s = self._owner.kernel.host.now()
        if asked.most <= 0:
            self._asked_s.pop(by, None)
            if not self._asked_s:
                self.end()
            told(None)
            return
        if len(self._questions) >= MOST_QUESTIONS:
            raise ControlRefusedError(
                f"{MOST_QUESTIONS} questions for what led to commands wait for their answers already", "busy"
            )
        askers = [it for it in self._asked_s if agent_of(it) == agent_of(by)]
        if by not in askers and len(askers) >= MOST_ASKERS:
            raise ControlRefusedError(
                f"{MOST_ASKERS} components of {agent_of(by)} ask for what led to commands already", "busy"
            )
        if self._packets is None:
            self._begin(now_s)
        self._asked_s[by] = now_s
        self._tap_channels()
        self._questions.append((asked, told))
        if len(self._questions) == 1:
            self._owner.call(self._go_on)

    def end(self) -> None:
        """Note nothing any more, and tell now what is still to be answered."""
        while self._questions:
            self._step()
        if self._packets is None:
            return
        self._packets = None
        stream = self._owner.kernel.stream
        for channel, tap in self._taps.items():
            stream.untap(channel, tap)
        stream.untap_outgoing(self._tap)
        self._taps = {}

    def _go_on(self) -> None:
        """Do one step now, and the others in later turns."""
        self._step()
        if self._questions:
            self._owner.call(self._go_on)

    def _step(self) -> None:
        """Do one step for the question that came first."""
        if self._packets is None or not self._questions:
            return
        asked, told = self._questions[0]
        if self._steps is None:
            self._steps = self._packets.answering(asked, self._ns(self._owner.kernel.host.now()))
        try:
            next(self._steps)
        except StopIteration as end:
            self._steps = None
            self._questions.popleft()
            told(end.value)

    def _begin(self, now_s: float) -> None:
        kernel = self._owner.kernel
        # As recordings have it: the agents of one machine, and those whose clocks agree, can be compared.
        self._epoch_ns = 0 if kernel.virtual is not None else wall_ns() - int(now_s * 1e9)
        packets = self._packets = TracedPackets(self._owner.agent)
        hear, now, epoch_ns = packets.hear, kernel.host.now, self._epoch_ns

        def tap(packet: Packet) -> None:
            if packet.channel not in (SYSCTRL, LOG):
                hear(epoch_ns + int(now() * 1e9), packet)

        self._tap = tap
        kernel.stream.tap_outgoing(tap)
        self._owner.after_host(LEASE_S, self._look)

    def _look(self) -> None:
        if self._packets is None:
            return
        until_s = self._owner.kernel.host.now() - LEASE_S
        self._asked_s = {by: asked_s for by, asked_s in self._asked_s.items() if asked_s > until_s}
        if self._asked_s:
            # Not the instant itself: a sum of floating-point numbers may fall short of it for ever.
            self._owner.after_host(min(self._asked_s.values()) - until_s + LOOK_LATER_S, self._look)
        else:
            self.end()

    def _tap_channels(self) -> None:
        """Take channels that were added since."""
        stream = self._owner.kernel.stream
        there = [name for name in stream.channels() if name not in (SYSCTRL, LOG)]
        self._taps = {channel: tap for channel, tap in self._taps.items() if channel in there}
        for channel in there:
            if channel not in self._taps:
                self._taps[channel] = self._tap
                stream.tap(channel, self._tap)

    def _ns(self, now_s: float) -> int:
        return self._epoch_ns + int(now_s * 1e9)


def _row(time_ns: int, packet: Packet) -> list[Any]:
    try:
        said = "" if packet.body is None else body_text(packet.body)
    except Exception:  # what the author of a packet's type wrote may raise anything
        said = "it cannot be shown"
    # A flat row of plain values: what is nested is looked through value by value before it travels.
    cause, number = packet.cause or ("", 0)
    return [time_ns, packet.channel, packet.type, packet.source, packet.seq, packet.stamp_s, cause, number, said]


def _size(body: Any) -> int:
    try:
        return len(_JSON(body))
    except Exception:  # as in `_row`
        return LARGE_BYTES + 1
