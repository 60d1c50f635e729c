"""The Traces Service: sends sampled traces, from a reading to its command, to a collector of OpenTelemetry.

[service.traces]
type = "traces"
settings = { endpoint = "http://127.0.0.1:4318/v1/traces", ratio = 0.01 }
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Annotated, Any, Final
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta

from pancakes.errors import PancakesError, needing_extra
from pancakes.kernel.handlers import on
from pancakes.packet import LOG, NETWORK, SYSCTRL, Cause, Packet, agent_of, packet_type
from pancakes.service import Service
from pancakes.tools.traces.spans import Heard, RootNote, SpanMaker
from pancakes.util.clock import wall_ns

if TYPE_CHECKING:
    from pancakes.tools.traces.otlp import SpanExport

DRAIN_S: Final = 0.25
"""How often it takes the packets that were seen, in seconds of the host."""
MOST_HEARD: Final = 20_000
"""The most packets that wait for that; further ones are lost and counted."""
A_TURN: Final = 2_000
"""The limit of those taken in one turn, which takes some milliseconds of the interpreter."""
REPORT_S: Final = 10.0
"""Losses are logged at most this often, in seconds of the host."""
CLOSE_S: Final = 1.0
"""How long the last spans may take at a stop, in seconds of the host."""
MOST_NOTES: Final = 256
"""The most notes in one packet."""
NOT_TRACED: Final = (SYSCTRL, LOG)
"""Channels whose packets are no spans: what people ask for, and what is said."""

_Address = Annotated[str, Meta(max_length=256)]
_Number = Annotated[int, Meta(ge=0)]
_Name = tuple[_Address, _Number]


@packet_type("trace_roots")
class TraceRoots(msgspec.Struct, frozen=True):
    """The first causes of packets that were sent to another agent, for the traces there.

    Attributes:
        roots: source and number of each packet, and of its first cause.
    """

    roots: Annotated[tuple[tuple[_Name, _Name], ...], Meta(max_length=MOST_NOTES)]


class TracesService(Service):
    """Make spans of what this agent publishes, and send them to a collector from a thread of its own."""

    blocking = True  # its turns compute for milliseconds, and its stop waits for the last spans

    @dataclass
    class Settings:
        """The settings of traces.

        Attributes:
            endpoint: where the collector takes OTLP over HTTP, such as `http://127.0.0.1:4318/v1/traces`.
            ratio: the share of traces that is sent, from 0 to 1. All agents of a fleet should have the same: then each
                trace is sent by all of its agents, or by none.
            timeout_s: how long the collector may take for a batch of spans, with all retries, in seconds of the host.
                Then the batch is lost.
            queue: how many spans may wait for the collector; further ones are lost.
        """

        endpoint: Annotated[str, Meta(max_length=2048)] = "http://127.0.0.1:4318/v1/traces"
        ratio: Annotated[float, Meta(ge=0, le=1)] = 0.01
        timeout_s: Annotated[float, Meta(ge=0.1, le=60)] = 5.0
        queue: Annotated[int, Meta(ge=1, le=100_000)] = 4096

        def __post_init__(self) -> None:
            parts = urlsplit(self.endpoint)
            if parts.scheme not in ("http", "https") or not parts.hostname or parts.path in ("", "/"):
                raise ValueError(
                    f"endpoint: {self.endpoint!r} is no URL of a collector: write it as http://HOST:4318/v1/traces"
                )

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._export: SpanExport | None = None
        self._heard: deque[Heard] = deque()
        self._losses = count(1)
        self._unseen = 0  # packets that found no room
        self._taps: dict[str, Callable[[Packet], None]] = {}
        self._reported = 0
        self._report_s = 0.0

    def on_start(self) -> None:
        kernel = self._actor.kernel
        if kernel.virtual is not None:
            raise PancakesError(f"{self.address} sends no traces in virtual time: a collector needs real seconds")
        with needing_extra("no traces are sent"):
            from pancakes.tools.traces.otlp import SpanExport

        given, now = self.settings, kernel.host.now
        self._makes = SpanMaker(self.agent, given.ratio)
        self._export = SpanExport(
            self.agent, given.endpoint, given.timeout_s, given.queue, lambda: wall_ns() - int(now() * 1e9)
        )
        kernel.stream.tap_outgoing(self._hear)
        self._drain()
        self.log("info", f"sends {given.ratio:.3g} of all traces to {given.endpoint}")

    def on_stop(self) -> None:
        stream, export = self._actor.kernel.stream, self._export
        stream.untap_outgoing(self._hear)
        for channel, tap in self._taps.items():
            stream.untap(channel, tap)
        self._taps = {}
        if export is None:
            return
        self._export = None
        while self._heard:
            self._take()
        now_s = self._actor.kernel.host.now()
        self._tell(self._makes.take_notes(now_s))
        export.put(self._makes.take_spans(now_s, all_=True))
        export.close(CLOSE_S)

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self.on_stop()

    def _hear(self, packet: Packet) -> None:
        """Note a packet. In any thread, and of little cost: everything that is published comes."""
        if packet.channel in NOT_TRACED or packet.type == "trace_roots":
            return
        if len(self._heard) >= MOST_HEARD:
            self._unseen = next(self._losses)
            return
        fence = packet.fence
        heard = Heard(
            self._actor.kernel.host.now(),
            packet.channel,
            packet.type,
            packet.source,
            packet.destination,
            packet.seq,
            packet.cause,
            packet.stamp_s,
            fence.task_id if fence is not None else "",
        )
        self._heard.append(heard)

    @on(NETWORK, TraceRoots, queue=1024)
    def on_roots(self, packet: Packet[TraceRoots]) -> None:
        """Take what another agent knows of packets that it sent here."""
        sender = agent_of(packet.source)
        for key, root in packet.body.roots:
            if agent_of(key[0]) == sender != self.agent:
                self._makes.hear_root((key[0], key[1]), (root[0], root[1]))

    def _drain(self) -> None:
        export = self._export
        if export is None:
            return
        self._tap_channels()
        self._take()
        now_s = self._actor.kernel.host.now()
        self._tell(self._makes.take_notes(now_s))
        if spans := self._makes.take_spans(now_s):
            export.put(spans)
        self._report(export, now_s)
        self.after_host(0.0 if len(self._heard) >= A_TURN else DRAIN_S, self._drain)

    def _take(self) -> None:
        """Take what was heard, up to `A_TURN` packets."""
        for _ in range(min(A_TURN, len(self._heard))):
            self._makes.hear(self._heard.popleft())

    def _tell(self, notes: list[RootNote]) -> None:
        to: dict[str, list[tuple[Cause, Cause]]] = {}
        for it in notes:
            to.setdefault(it.to, []).append((it.packet, it.root))
        for name, roots in to.items():
            for first in range(0, len(roots), MOST_NOTES):
                self.publish(NETWORK, TraceRoots(tuple(roots[first : first + MOST_NOTES])), to=name)

    def _report(self, export: SpanExport, now_s: float) -> None:
        """Say what was lost, if that has grown; the event is counted by the metrics."""
        _, lost, why = export.counts()
        total = lost + self._unseen
        if total > self._reported and now_s >= self._report_s:
            fresh, self._reported, self._report_s = total - self._reported, total, now_s + REPORT_S
            if not lost or not why:
                why = f"more than {MOST_HEARD} packets came within {DRAIN_S:g} s"
            self.log("warning", f"{fresh} spans were lost: {why}")
            self.event("spans_lost", count=fresh)

    def _tap_channels(self) -> None:
        """Hear channels that were added since."""
        stream = self._actor.kernel.stream
        there = [name for name in stream.channels() if name not in NOT_TRACED]
        self._taps = {channel: tap for channel, tap in self._taps.items() if channel in there}
        for channel in there:
            if channel not in self._taps:
                self._taps[channel] = tap = partial(self._hear)
                stream.tap(channel, tap)
