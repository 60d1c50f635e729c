"""The recording of one agent: packets are taken from its channels and written to MCAP files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import msgspec

from pancakes.errors import PancakesError, needing_extra
from pancakes.events import Event
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Backlog
from pancakes.kernel.stream import Tap
from pancakes.packet import TO_TASK, Packet, type_name
from pancakes.recording.clock_alignment import CLOCKS, row_of
from pancakes.recording.foxglove_messages import SHOWN, Viewer
from pancakes.recording.records import CHANNEL, NANOSECONDS, RecordedPacket, TaskDescription
from pancakes.recording.settings import RecordingSettings
from pancakes.recording.task_statistics import Latenesses, TaskTicks, figures_of, ticks_of
from pancakes.util.clock import day_s, wall_ns

WAITING: Final = 20_000
"""At most this many packets wait for the disk, fewer if they are large; then the oldest are dropped and counted."""
FLUSH_S: Final = 0.49
"""How often, in host time, all packets are given to the operating system: that is not lost where the agent is
killed, and half of the second is left that this may cost."""
LATEST_S: Final = 0.75
"""After this time without a flush, in host time, the recording no longer waits for answers."""
SYNC_S: Final = 4.9
"""How often, in host time, they are brought to the disk, which takes long: a power cut costs the packets since then."""
CLOCKS_S: Final = 10.0
"""How often, in host time, it is written how the clocks of peers stand; sooner at first, ..."""
CLOCKS_SOON_S: Final = 1.0
"""... after so long."""
DAY_STEP_S: Final = 1.0
"""The time of day is taken again where it is further from that of the file than this, ..."""
MOST_DAYS: Final = 20
"""... so often at most."""
SAMPLE_S: Final = 0.99
"""How often, in host time, the figures of tasks and links are sampled: once a second."""


class _Seen(msgspec.Struct, frozen=True, gc=False):
    """A packet that waits to be written, and when it was seen, in host time.

    Half a second's packets would be worth some runs of the garbage collector, if they were tuples.
    """

    host_s: float
    packet: Packet


class Recording:
    """The recording of one agent.

    Packets are taken in the publishers' threads, which costs them little more than an append to a list; all else
    happens in the one thread that calls the methods.

    Args:
        kernel: the agent's kernel.
        settings: what is recorded, and where to.
        say: takes a level and a sentence about a problem.
        take_seq: numbers the packets that the recording itself adds, under the address `source`.
        source: the source address of these packets.
        goes_on: the first file of an earlier recording, which goes on in a new file; None: a new one begins.

    Attributes:
        first: its first file.
        asking: whether a question about the only recorded task is not answered yet, so that
            packets must keep waiting.

    Raises:
        PancakesError: nothing can be written there, too little is free on the disk, mcap is not installed, ...
    """

    def __init__(
        self,
        kernel: Kernel,
        settings: RecordingSettings,
        say: Callable[[str, str], None],
        take_seq: Callable[[], int],
        source: str,
        goes_on: Path | None = None,
    ) -> None:
        # Only now: mcap is installed with an extra, and an agent that records nothing does without it.
        with needing_extra("nothing can be recorded"):
            from pancakes.recording.mcap_writer import RecordingParts
        self._kernel = kernel
        self._agent = kernel.agent
        self._settings = settings
        self._say = say
        self._take_seq = take_seq
        self._source = source
        self._everything = not (settings.channels or settings.types or settings.task)
        self._taps: dict[str, Tap] = {}
        self._now = kernel.host.now
        self._waiting: Backlog[_Seen] = Backlog(WAITING)
        self._viewer = Viewer()
        self._lost_before = 0
        self._tasks: dict[str, TaskDescription] = {}
        self._latenesses = Latenesses()
        self._ticks_number = 0
        self._days = 0
        self.asking: Callable[[], bool] = lambda: False
        # The time of day is read once: between two packets only the monotonic clock counts.
        virtual = kernel.virtual is not None
        self._epoch_ns = 0 if virtual else wall_ns() - int(kernel.host.now() * NANOSECONDS)
        self._about = {
            "agent": self._agent,
            "clock": "mission time" if virtual else "time of day",
            "speed": str(kernel.mission.speed),
            "task": settings.task,
            "life": kernel.life,
            "epoch_ns": str(self._epoch_ns),
            "host_ns": str(int(kernel.host.now() * NANOSECONDS)),
        }
        path = goes_on or Path(settings.path.replace("{agent}", self._agent))
        drop_oldest = settings.at_limit == "drop_oldest"
        limits = (settings.split_mib, settings.limit_mib, drop_oldest, settings.free_mib)
        self._parts = RecordingParts(path, self._about, *limits, goes_on=goes_on is not None)
        self.first = self._parts.first
        self._flushed_s = self._synced_s = self._sampled_s = kernel.host.now()
        # All agents in virtual time have one clock, unless theirs is skewed.
        own_clock = kernel.virtual is None or kernel.host is not kernel.virtual.clock
        self._clocks_due_s = self._flushed_s + CLOCKS_SOON_S if own_clock else math.inf
        self._tap_channels()
        kernel.stream.tap_outgoing(self._take)
        kernel.hear_ticks(self._latenesses.heard)

    # Taking: in the publishers' threads ------------------------------------------------------------------------

    def _take(self, packet: Packet) -> None:
        self._waiting.put(packet, _Seen(self._now(), packet))

    def _tap_channels(self) -> None:
        stream = self._kernel.stream
        there = stream.channels()
        for channel in [name for name in self._taps if name not in there]:
            del self._taps[channel]
        for channel in self._settings.channels or there:
            if channel in there and channel not in self._taps:
                self._taps[channel] = self._take
                stream.tap(channel, self._take)

    def _note(self, body: Any) -> None:
        """Add a packet of the recording itself."""
        self._note_at(self._now(), body)

    def _note_at(self, host_s: float, body: Any) -> None:
        stamp, seq = self._kernel.mission.now(), self._take_seq()
        packet = Packet(CHANNEL, type_name(body), self._source, "", stamp, seq, body)
        self._waiting.put(packet, _Seen(host_s, packet))

    def _note_ticks(self, host_s: float) -> None:
        """Add which ticks ran that were just taken, as of a moment before that; in virtual time all of them do."""
        if self._kernel.virtual is None:
            self._ticks_number += 1 + self._latenesses.overflowed
            self._note_at(host_s, ticks_of(self._ticks_number, self._latenesses.runs, self._settings.task))

    # What the tasks are ----------------------------------------------------------------------------------------

    def describe(self, answer: Mapping[str, Any], seen: bool) -> None:
        """Add the description of a task.

        Args:
            answer: its agent's answer to `Describe(target, state=True, began=seen)`.
            seen: whether the recording saw the task start.
        """
        described = TaskDescription.of(answer, self._time_ns, self._kernel.seed, seen)
        self._tasks[described.task_id] = described
        self._note(described)

    def ended(self, address: str) -> None:
        """Note that a task has ended; all earlier packets came while it ran."""
        self._write_waiting()
        self._tasks = {task_id: it for task_id, it in self._tasks.items() if it.address != address}

    # Writing ---------------------------------------------------------------------------------------------------

    def write(self) -> str:
        """Write what has come since the last time.

        Returns:
            Why the recording must end; empty if it may go on.
        """
        now_s = self._kernel.host.now()
        if now_s - self._sampled_s >= SAMPLE_S:
            self._sampled_s = now_s
            self._note(figures_of(self._kernel, self._latenesses.take()))
            self._note_ticks(now_s)
        since_s = now_s - self._flushed_s
        if self._settings.task and since_s < LATEST_S and self.asking():
            return ""  # what one task reads is known only once its service has said so
        try:
            self._write_waiting()
            if since_s < FLUSH_S:
                return ""
            self._flushed_s = now_s
            self._look_at_the_day()
            if now_s >= self._clocks_due_s:
                self._clocks_due_s = now_s + CLOCKS_S
                self._note_clocks()
            reason = self._parts.flush()
            while self._parts.moved:
                self._say("warning", self._parts.moved.pop(0))
            if not reason and now_s - self._synced_s >= SYNC_S:
                self._synced_s = now_s
                reason = self._parts.sync()
        except OSError as error:
            reason = f"its disk failed: {error.strerror or error}"
        if not reason:
            self._tap_channels()
            self._tell_lost()
        return reason

    def waits(self) -> int:
        """Return how many packets wait to be written."""
        return len(self._waiting)

    def end(self) -> None:
        """Stop taking packets, write what has come, and close the file."""
        self._kernel.unhear_ticks(self._latenesses.heard)
        for channel, tap in self._taps.items():
            self._kernel.stream.untap(channel, tap)
        self._kernel.stream.untap_outgoing(self._take)
        now_s = self._now()
        self._latenesses.take()
        self._note_ticks(now_s)  # the last entry: it tells that no tick ran later
        try:
            self._write_waiting()
            if self._clocks_due_s < math.inf:
                self._note_clocks()
            self._parts.close()
        except OSError as error:
            self._say("warning", f"the recording {self.first} could not be closed: {error.strerror or error}")

    def _write_waiting(self) -> None:
        for _ in range(len(self._waiting)):
            seen = self._waiting.take()
            if seen is None:  # old ones fell out just now
                return
            if self._everything or self._wanted(seen.packet):
                self._put(RecordedPacket(self._time_ns(seen.host_s), self._agent, seen.packet))

    def _look_at_the_day(self) -> None:
        """Continue in a new file if the machine got the time of day: the dates of this file are wrong.

        A reader of both files corrects the times of the first. A board without a battery for its clock starts in
        1970, or when it was last switched off.
        """
        day = day_s(self._kernel.host) if self._kernel.virtual is None else None
        if day is None or abs(day * NANOSECONDS - self._epoch_ns) <= DAY_STEP_S * NANOSECONDS:
            return
        if self._days >= MOST_DAYS:
            return  # a clock that is set again and again is no better than one that is not
        self._days += 1
        epoch_ns, host_ns = int(day * NANOSECONDS), int(self._now() * NANOSECONDS)
        about = {**self._about, "epoch_ns": str(epoch_ns), "host_ns": str(host_ns)}
        path = self._parts.begin_again(about)
        self._about, self._epoch_ns = about, epoch_ns
        self._say("warning", f"the clock of this machine was set: the recording goes on in {path} with the right time")

    def _note_clocks(self) -> None:
        """Write how the clocks of peers compare to this one, so that their recordings can be merged with it."""
        row = row_of(self._kernel.host.now(), self._kernel.links())
        if row:
            self._parts.note(CLOCKS, row)

    def _time_ns(self, host_s: float) -> int:
        return self._epoch_ns + int(host_s * NANOSECONDS)

    def _put(self, entry: RecordedPacket) -> None:
        try:
            self._parts.write(entry)
        except PancakesError as error:
            self._say("warning", str(error))
            return
        if self._settings.viewer and entry.packet.type in SHOWN:
            with suppress(TypeError, ValueError, AttributeError):  # its fields are not what its class says
                for message in self._viewer.messages(entry):
                    self._parts.add(*message)

    def _wanted(self, packet: Packet) -> bool:
        settings = self._settings
        if settings.channels and packet.channel not in settings.channels:
            return False
        if settings.types and packet.type not in settings.types:
            return False
        if not settings.task:
            return True
        if packet.fence is not None and packet.fence.task_id == settings.task:
            return True
        body = packet.body
        if isinstance(body, TaskTicks):
            return True
        if getattr(body, "task_id", "") == settings.task or packet.destination == TO_TASK + settings.task:
            return True  # what it was, and what is addressed to it wherever it is
        if isinstance(body, Event) and body.kind == "recording_started":
            return True
        reader = self._tasks.get(settings.task)
        if reader is None:
            return False
        if isinstance(body, Event) and f"{packet.source}/{body.fields.get('task')}" == reader.address:
            return True  # what its service says of it, such as that its rate was changed
        return reader.reads_packet(packet.channel, packet.type)

    def _tell_lost(self) -> None:
        lost = self._waiting.dropped
        if lost > self._lost_before:
            self._say("warning", f"the recording lacks {lost - self._lost_before} packets: the disk is too slow")
            self._lost_before = lost
