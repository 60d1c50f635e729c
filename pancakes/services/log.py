"""The Log Service: what is said on `log`, to the console and a file; and recordings of channels (paper §3.3).

Each source has a quota of bytes per second (`Shares`); what goes beyond it is counted and not written. If standard
error leads to the journal of systemd, each line has its level. Recordings that a control packet began are kept on
disk, and go on when the agent comes back from a crash.
"""

from __future__ import annotations

import math
import os
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from pancakes.control import History, Start, Traces
from pancakes.events import LEVELS, Event, LogLine, level_of, line_of, record_of
from pancakes.journal import Disk, RecordTable
from pancakes.kernel.handlers import drop_oldest, on
from pancakes.kernel.payload_size import weigh
from pancakes.packet import LOG, Packet
from pancakes.recording.recorder import Recorder, RecordingBegan
from pancakes.service import Service
from pancakes.services.log_writer import LogWriter
from pancakes.settings import FilePath
from pancakes.supervision.lifecycle import Answer, Finished, Request, State, Written
from pancakes.supervision.messages import Carried
from pancakes.supervision.restart import RestartSpec
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot
from pancakes.supervision.supervisor import ANSWERED_S
from pancakes.task import TaskSpec
from pancakes.util import codecs
from pancakes.util.arrays import without_arrays
from pancakes.util.text import printable, printable_line

if TYPE_CHECKING:
    from pancakes.services.traces import Tracing


_PRIORITIES: Final = {"debug": 7, "info": 6, "warning": 4, "error": 3}
_STANDARD_ERROR: Final = 2


@cache
def leads_to_journal() -> bool:
    """Return whether standard error leads to the journal, as `JOURNAL_STREAM` tells."""
    try:
        status = os.fstat(_STANDARD_ERROR)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def for_standard_error(text: str, level: str) -> str:
    """Return text as it is, or each of its lines behind its level as the journal reads it, such as `<4>`."""
    if not leads_to_journal():
        return text
    return "\n".join(f"<{_PRIORITIES.get(level, 6)}>{line}" for line in text.split("\n"))


KIND = "recording"


class WantedRecording(msgspec.Struct, frozen=True):
    """A recording that must continue.

    Attributes:
        first: the path of its first file; empty: there is no recording.
        settings: the recorder's settings, as plain values.
    """

    first: str = ""
    settings: Mapping[str, Any] = msgspec.field(default_factory=dict)


NOTHING: Final = WantedRecording()
"""There is no recording."""


def wanted_recordings(disk: Disk) -> RecordTable[WantedRecording]:
    """Return which recordings must continue, by the path of the recorder (`log/Recorder`)."""

    def malformed(path: str, why: str) -> None:
        disk.unread.append(f"the journal has lost which recording must continue: {why}")

    return RecordTable(disk, KIND, codecs.decoder(WantedRecording), malformed)


RECORDER = "Recorder"
KEEP = drop_oldest(4096)
"""A file or terminal that is slow for a moment loses nothing; one that is stuck loses the oldest."""


class Console(LogWriter):
    """Shows lines and events on the terminal."""

    class Settings(msgspec.Struct):
        """What is shown: lines of this level and above; see `LogService.Settings`."""

        level: Literal["debug", "info", "warning", "error"]
        traceback: bool
        share_kib_s: Annotated[float, Meta(ge=0.0)]

    @on(LOG, None, queue=KEEP)
    def show(self, packet: Packet) -> None:
        """Write one line, or count it."""
        level = level_of(packet.body)
        if level not in LEVELS or LEVELS.index(level) >= LEVELS.index(self.settings.level):
            self.write_some(packet)

    def put(self, packet: Packet) -> int:
        body = packet.body
        if isinstance(body, LogLine):
            text = body.text
        elif isinstance(body, Event):
            fields = without_arrays(body.fields).items()
            text = " ".join([body.kind, *(f"{key}={value}" for key, value in fields if value not in (None, ""))])
        else:
            text = f"{packet.type} {body}"
        line = printable_line(f"{packet.stamp_s:9.3f} {level_of(body):<7} {packet.source}: {text}")
        if self.settings.traceback and isinstance(body, LogLine):
            line = "\n".join([line, *(printable(f"          {row}") for row in body.traceback.splitlines())])
        try:
            print(for_standard_error(line, level_of(body)), file=sys.stderr, flush=True)
        except (OSError, ValueError):
            # The reader of this terminal or pipe has gone; an agent does not stop for that.
            self.stop()
        return len(line)


REMEMBERED = 2000
"""The number of lines and events of `log` that are remembered for clients, unless it is configured."""
REMEMBERED_BYTES = 4 * 1024 * 1024
"""What is remembered of `log` takes about this much memory at most; the last line is always remembered."""
PAGE = 60_000
"""At most this many characters of it go into one answer; at four bytes each, that still fits a frame."""
LONGEST = 20_000
"""A longer line is cut to this many characters."""


class LogService(ServiceCore, Service):
    """Listens to `log` (paper §3.3), and records what is said on all channels where that is asked for.

    A recording that a control packet began goes on in a further file when its agent comes back from a crash or a
    reboot, until it is stopped or ends by itself.

    Args:
        record: the table `[record]`: the recorder's settings, and whether it is to `start`; None: no such table.
        wanted: which recordings must continue, by the paths of their recorders.
    """

    class Settings(msgspec.Struct):
        """What becomes of what is said on `log`.

        Attributes:
            console: whether it is shown on standard error.
            level: the lowest level that is shown there; an event counts as `info`, or as `debug` if a line says the
                same.
            traceback: whether a failure is shown there with its whole traceback.
            file: path of a JSON lines file that everything is appended to; empty: none.
            file_limit_mib: the size at which it becomes FILE.1, FILE.1 becomes FILE.2, and a new file begins.
            files: how many of them are kept; the oldest is removed.
            share_kib_s: how many KiB a second of host time one source may write to the file, and as much to the
                console, counted over 5 s; its warnings and errors have as much again. The rest is left out, and a line
                reports how much that was. 0: no limit.
            remembered: how many of the newest lines and events are kept for clients that ask, at most 2000; fewer if
                they are large.
        """

        console: bool = True
        level: Literal["debug", "info", "warning", "error"] = "info"
        traceback: bool = False
        file: FilePath = ""
        file_limit_mib: Annotated[float, Meta(gt=0.0)] = 4.0
        files: Annotated[int, Meta(ge=2, le=1000)] = 5
        share_kib_s: Annotated[float, Meta(ge=0.0)] = 16.0
        remembered: Annotated[int, Meta(ge=1, le=REMEMBERED)] = REMEMBERED

    def __init__(
        self,
        *args: Any,
        wanted: RecordTable[WantedRecording],
        record: Mapping[str, Any] | None = None,
        **others: Any,
    ) -> None:
        super().__init__(*args, **others)
        self._wanted = wanted
        self._recorder = f"{self.name}/{RECORDER}"
        self._records = record is not None and record["start"]
        self._record = {key: value for key, value in (record or {}).items() if key != "start"}
        # A recording that begins with the agent begins again with each start.
        self._goes_on = NOTHING if self._records else wanted.newest.get(self._recorder, NOTHING)
        self._newest: deque[tuple[int, int, Packet]] = deque()  # number, bytes, and what was said
        self._recording = Path()  # the first file of what is recorded now
        self._newest_bytes = 0
        self._entries = 0
        self._tracing: Tracing | None = None

    def close(self, for_s: float | None = None) -> None:
        self._end_tracing()
        super().close(for_s)

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self._end_tracing()
        super().on_failure(exception_type, exception_value, traceback)

    def take_message(self, message: Any) -> Any:
        if not isinstance(message, RecordingBegan):
            return super().take_message(message)
        self._recording = message.first
        return None

    def _begin_tracing(self) -> Tracing:
        from pancakes.services.traces import Tracing  # only now: most agents are never asked

        self._tracing = self._tracing or Tracing(self)
        return self._tracing

    def _end_tracing(self) -> None:
        if self._tracing is not None:
            self._tracing.end()

    @on(LOG, None, queue=KEEP)
    def remember(self, packet: Packet) -> None:
        """Keep one line, for questions that come later."""
        self._entries += 1
        size_bytes = weigh(packet.body)
        self._newest.append((self._entries, size_bytes, packet))
        self._newest_bytes += size_bytes
        most = self.settings.remembered
        while len(self._newest) > (most if self._newest_bytes <= REMEMBERED_BYTES else 1):
            self._newest_bytes -= self._newest.popleft()[1]

    def command_waits(self, slot: Slot, request: Request) -> None:
        if slot.name == RECORDER:
            why = f"{slot.address} waits for the disk; what was asked for is done as soon as that can write"
            self.after_host(ANSWERED_S, lambda: self.put_off(request, why))

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if isinstance(body, History):
            self.reply(request, result=self._page(body))
        elif isinstance(body, Traces):
            self._begin_tracing().answer(body, request.by, lambda told: self.reply(request, result=told))
        else:
            if isinstance(body, Start) and slot is not None and slot.name == RECORDER and slot.life.at_rest:
                slot.carried = None  # what is not said now is as the configuration says, not as it was said last time
            super().carry_out_command(body, slot, request)

    def _page(self, body: History) -> list[dict[str, Any]]:
        """Return what was asked for, as far as it fits a packet."""
        import json

        # What was said before the question belongs to the answer, even if it waits behind it.
        for packet in self.actor_inbox.queues[LOG].drain():
            self.remember(packet)
        since_s = -math.inf if body.since_s is None else self.now() - body.since_s
        page: list[dict[str, Any]] = []
        size = 0
        for entry, _, packet in self._newest:
            if entry <= body.after or packet.stamp_s < since_s:
                continue
            line = line_of(record_of(packet))
            if len(line) > LONGEST:
                line = line_of(record_of(replace(packet, body=LogLine("warning", f"{len(line)} characters left out"))))
            size += len(line)
            if page and size > PAGE:
                break
            # By way of its line: so it has nothing that cannot travel.
            page.append({**json.loads(line), "entry": entry})
        return page

    def own_tasks(self) -> Sequence[TaskSpec]:
        asked = self.settings
        share = {"share_kib_s": asked.share_kib_s}
        tasks = []
        if asked.console:
            shown = {"level": asked.level, "traceback": asked.traceback, **share}
            tasks.append(TaskSpec("Console", Console, settings=shown))
        if asked.file:
            from pancakes.services.log_file import LogFile  # only now: most agents have none

            kept = {"path": asked.file, "limit_mib": asked.file_limit_mib, "files": asked.files, **share}
            tasks.append(TaskSpec("File", LogFile, settings=kept))
        # What has made it stop, such as a full disk, has not changed a moment later.
        never = RestartSpec("no")
        start = self._records or bool(self._goes_on.first)
        tasks.append(TaskSpec(RECORDER, Recorder, settings=self._record, start=start, restart=never))
        return tasks

    # A recording that goes on ----------------------------------------------------------------------------------

    def after_start(self) -> None:
        super().after_start()
        if self._records:
            self._want(NOTHING, lambda why_not: None)

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        super().take_up(slot, kept)
        if slot.name == RECORDER and self._goes_on.first:
            slot.carried = Carried({**self._record, **self._goes_on.settings}, {"goes_on": self._goes_on.first})

    def feed(self, slot: Slot, event: Any) -> None:
        life = slot.life
        if slot.name == RECORDER and life.state is State.STARTING and life.asker and isinstance(event, Finished):
            # The one who asked gets the reason. This is not a failure: it did not record before, and does not now.
            event = replace(event, failed=False)
        super().feed(slot, event)

    def answer(self, slot: Slot, effect: Answer) -> None:
        if effect.reason or slot.name != RECORDER or slot.life.state is not State.RUNNING:
            super().answer(slot, effect)
            return
        wanted = WantedRecording(str(self._recording.absolute()), self.describe_in_detail(slot)["settings"])
        answer = super().answer
        self._want(wanted, lambda why_not: answer(slot, effect))

    def write_rest(self, slot: Slot) -> None:
        if slot.name != RECORDER or self.closing:
            super().write_rest(slot)
            return

        def forgotten(why_not: str) -> None:
            lasts_not = f"{slot.address} is stopped, but may record again after a crash: {why_not}"
            self.feed(slot, Written(lasts_not if why_not else ""))

        self._want(NOTHING, forgotten)
        self.rested(slot)

    def _want(self, wanted: WantedRecording, then: Callable[[str], None]) -> None:
        """Write down which recording must continue; `then` is called in this actor, with the reason if that failed."""
        newest = self._wanted.newest.get(self._recorder, NOTHING)
        on_disk = self._wanted.on_disk.get(self._recorder, NOTHING)
        if wanted == newest == on_disk == NOTHING:
            then("")
            return

        def failed(reason: str) -> None:
            what = f"the recording {wanted.first} will not go on" if wanted.first else "a recording may go on"
            self.log("warning", f"{what} when {self.agent} is started again: {reason}")
            self.call(lambda: then(reason))

        self._wanted.write(self._recorder, wanted, lambda: self.call(lambda: then("")), failed)
