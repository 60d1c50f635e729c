"""The recorder: a task of the Log Service that writes what is said on its agent's channels into MCAP files."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from pancakes.clock import wall_ns
from pancakes.control import Describe, Reply
from pancakes.errors import PancakesError
from pancakes.events import Event
from pancakes.kernel.counter import Counter
from pancakes.kernel.handlers import on
from pancakes.kernel.stream import Tap
from pancakes.migration.record import TaskId
from pancakes.packet import LOG, SYSCTRL, TO_TASK, Packet, agent_of, type_name
from pancakes.recording.description import CHANNEL, TaskDescription
from pancakes.recording.entry import NANOSECONDS, Entry
from pancakes.recording.figures import figures_of
from pancakes.recording.viewing import SHOWN, Viewer
from pancakes.task import Task

WAITING: Final = 20_000
"""So many packets wait for the disk; of more, the oldest are left out and counted."""
DRAIN_S: Final = 0.25
"""How often, in host time, what waits is written: each time wakes a thread, which costs more than packets do, ..."""
DRAIN_SOON_S: Final = 0.02
"""... and how often where much comes, so that no turn is long, ..."""
MANY: Final = 100
"""... which is more packets than this."""
FLUSH_S: Final = 0.74
"""How often, in host time, what was written is brought to the disk: with the time between two turns less than a second,
which is what a crash may cost."""
SAMPLE_S: Final = 0.99
"""How often, in host time, it is noted how tasks and links fare: once a second."""
PATIENCE_S: Final = 1.0
"""How long, in host time, the answer to what a task is may take."""

ASK_AGAIN_S: Final = 0.1
"""After so long, in host time, an agent is asked again what a task is whose service was only starting, ..."""
MOST_QUESTIONS: Final = 50
"""... so often at most."""

Size = Annotated[float, Meta(ge=0, le=1e9)]


class _Question(msgspec.Struct, frozen=True):
    """What the recorder has asked its agent.

    Attributes:
        target: the task that it is about; empty: what runs.
        seen: whether the recording saw that task start.
        again: how often it is asked again where that is refused.
        asked_s: when it was asked, in host time.
    """

    target: str
    seen: bool = False
    again: int = MOST_QUESTIONS
    asked_s: float = 0.0


class Recorder(Task):
    """Writes all packets that are seen on some channels of its agent, and what its tasks were.

    It takes packets in the publishers' threads, which costs them an append to a list, and writes them in a thread of
    its own. Where the disk is full or slow it is the recording that suffers: never the robot.
    """

    blocking = True  # a disk may make it wait

    @dataclass
    class Settings:
        """What is recorded, and where to.

        Attributes:
            path: the file; one that is there already is left alone, and a number added to the name. `{agent}` stands
                for the agent's name.
            channels: the channels to record; empty: all, those too that are added later.
            types: the packet types to record; empty: all.
            task: record only what this task (`birthplace/name`) reads and publishes, on whatever agent it is; empty:
                everything.
            split_mib: a new file begins where one has grown this large.
            limit_mib: how large the recording may become; 0 for no limit.
            at_limit: what happens then: it ends (`stop`), or its oldest file is removed (`drop_oldest`).
            free_mib: the recording ends before less than this is free on the disk.
            viewer: whether poses are written in the schemas of Foxglove as well.
        """

        path: str = "recordings/{agent}.mcap"
        channels: tuple[str, ...] = ()
        types: tuple[str, ...] = ()
        task: str = ""
        split_mib: Annotated[float, Meta(gt=0, le=1e6)] = 256.0
        limit_mib: Size = 0.0
        at_limit: Literal["stop", "drop_oldest"] = "stop"
        free_mib: Size = 64.0
        viewer: bool = True

    def on_start(self) -> None:
        # Only now: mcap is installed with an extra, and an agent that records nothing does without it.
        try:
            from pancakes.recording.parts import Parts
        except ModuleNotFoundError as error:
            raise PancakesError(
                f"nothing can be recorded without {error.name}: pip install 'pancakes-agents[record]'"
            ) from None
        if self.settings.task:
            TaskId.parse(self.settings.task)  # a bare name would fit nothing, and nobody would be told
        self._taps: dict[str, Tap] = {}
        self._waiting: deque[tuple[float, Packet]] = deque(maxlen=WAITING)
        self._viewer = Viewer()
        self._taken = Counter()
        self._written = 0
        self._lost_before = 0
        self._ended = False
        self._tasks: dict[str, TaskDescription] = {}
        self._asked: dict[int, _Question] = {}
        # One look at the time of day: between two packets only the monotonic clock counts.
        virtual = self.kernel.virtual is not None
        self._epoch_ns = 0 if virtual else wall_ns() - int(self.kernel.host.now() * NANOSECONDS)
        settings = self.settings
        about = {
            "agent": self.agent,
            "clock": "mission time" if virtual else "time of day",
            "speed": str(self.kernel.mission.speed),
            "task": settings.task,
        }
        self._everything = not (settings.channels or settings.types or settings.task)
        path = Path(settings.path.replace("{agent}", self.agent))
        self._parts = Parts(
            path, about, settings.split_mib, settings.limit_mib, settings.at_limit == "drop_oldest", settings.free_mib
        )
        self._tap_channels()
        self.kernel.stream.tap_outgoing(self._take)
        self.event("recording_started", path=str(self._parts.first))
        self._ask(_Question(""))
        self._flushed_s = self._sampled_s = self.kernel.host.now()
        self.after_host(DRAIN_S, self._write)

    # Taking: in the publishers' threads ------------------------------------------------------------------------

    def _take(self, packet: Packet) -> None:
        self._taken.take()
        self._waiting.append((self.kernel.host.now(), packet))

    def _tap_channels(self) -> None:
        stream = self.kernel.stream
        there = stream.channels()
        for channel in [name for name in self._taps if name not in there]:
            del self._taps[channel]
        for channel in self.settings.channels or there:
            if channel in there and channel not in self._taps:
                self._taps[channel] = self._take
                stream.tap(channel, self._take)

    def _note(self, body: Any) -> None:
        """Takes something that nobody published."""
        seq = self.kernel.seq_of(self.address).take()
        self._take(Packet(CHANNEL, type_name(body), self.address, "", self.now(), seq, body))

    # Writing: in this actor's own thread -----------------------------------------------------------------------

    def _write(self) -> None:
        """Writes what has come since the last time. Little at a time: a control task may want the interpreter."""
        now_s = self.kernel.host.now()
        self._asked = {seq: asked for seq, asked in self._asked.items() if asked.asked_s > now_s - PATIENCE_S}
        many = len(self._waiting) > MANY
        if now_s - self._sampled_s >= SAMPLE_S:
            self._sampled_s = now_s
            self._note(figures_of(self.kernel))
        if not (self.settings.task and self._asked):
            # What one task reads is known only once its service has said so.
            self._write_waiting()
        if now_s - self._flushed_s < FLUSH_S or self._flush(now_s):
            self.after_host(DRAIN_SOON_S if many else DRAIN_S, self._write)

    def _write_waiting(self) -> None:
        waiting = self._waiting
        try:
            for _ in range(len(waiting)):
                host_s, packet = waiting.popleft()
                self._written += 1
                if self._wanted(packet):
                    self._put(Entry(self._time_ns(host_s), self.agent, packet))
        except IndexError:  # an old one fell out just now
            pass
        except OSError as error:
            self._end(f"its disk failed: {error.strerror or error}")

    def _time_ns(self, host_s: float) -> int:
        return self._epoch_ns + int(host_s * NANOSECONDS)

    def _put(self, entry: Entry) -> None:
        try:
            self._parts.write(entry)
        except PancakesError as error:
            self.log("warning", str(error))
            return
        if self.settings.viewer and entry.packet.type in SHOWN:
            for message in self._viewer.messages(entry):
                self._parts.add(*message)

    def _wanted(self, packet: Packet) -> bool:
        settings = self.settings
        if self._everything:
            return True
        if settings.channels and packet.channel not in settings.channels:
            return False
        if settings.types and packet.type not in settings.types:
            return False
        if not settings.task:
            return True
        if packet.fence is not None and packet.fence.task_id == settings.task:
            return True
        body = packet.body
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

    def _flush(self, now_s: float) -> bool:
        """Brings everything to the disk; returns whether the recording goes on."""
        self._flushed_s = now_s
        try:
            self._write_waiting()
            reason = self._parts.flush()
        except OSError as error:
            reason = f"its disk failed: {error.strerror or error}"
        if reason:
            self._end(reason)
            return False
        self._tap_channels()
        lost = self._taken.value - self._written - len(self._waiting)
        if lost > self._lost_before:
            self.log("warning", f"the recording lacks {lost - self._lost_before} packets: the disk is too slow")
            self._lost_before = lost
        return True

    def _end(self, reason: str) -> None:
        if self._ended:
            return
        self._ended = True
        self.log("warning", f"the recording {self._parts.first} ends: {reason}")
        self.event("recording_stopped", path=str(self._parts.first), reason=reason)
        self.stop()

    def on_stop(self) -> None:
        for channel, tap in self._taps.items():
            self.kernel.stream.untap(channel, tap)
        self.kernel.stream.untap_outgoing(self._take)
        try:
            self._write_waiting()
            self._parts.close()
        except OSError as error:
            self.log("warning", f"the recording {self._parts.first} could not be closed: {error.strerror or error}")

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        if hasattr(self, "_parts"):
            self.on_stop()

    # What the tasks are ----------------------------------------------------------------------------------------

    @on(LOG, Event)
    def on_event(self, packet: Packet) -> None:
        """A task has come to run, with settings and a state that a later run may need."""
        event: Event = packet.body
        if agent_of(packet.source) == self.agent and event.kind == "task_started":
            self._ask_about(f"{event.fields['service']}/{event.fields['task']}", seen=True)
        elif event.kind == "task_stopped" and agent_of(packet.source) == self.agent:
            # What has come until now came while it ran.
            self._write_waiting()
            self._tasks = {
                task_id: told
                for task_id, told in self._tasks.items()
                if told.address != f"{self.agent}/{event.fields['service']}/{event.fields['task']}"
            }

    def _ask(self, question: _Question) -> None:
        seq = self.publish(SYSCTRL, Describe(question.target, state=bool(question.target))).seq
        self._asked[seq] = _Question(question.target, question.seen, question.again, self.kernel.host.now())

    def _ask_about(self, target: str, seen: bool) -> None:
        if not target.startswith(("log/", "network/", "device/")):
            self._ask(_Question(target, seen))

    @on(SYSCTRL, Reply, addressed=True)
    def on_reply(self, packet: Packet) -> None:
        """The agent has told what it runs, or what a task is."""
        if packet.cause is None or packet.cause[1] not in self._asked:
            return
        question = self._asked.pop(packet.cause[1])
        reply: Reply = packet.body
        if not reply.ok:
            # Its service is only starting; or the task has ended meanwhile, and this is refused to the end.
            if question.again:
                later = _Question(question.target, question.seen, question.again - 1)
                self.after_host(ASK_AGAIN_S, lambda: self._ask(later))
            return
        if "tasks" in reply.result:
            for row in reply.result["tasks"]:
                if row["state"] == "running":
                    self._ask_about(f"{row['service']}/{row['task']}", seen=False)
            return
        told = TaskDescription.of(reply.result, self._time_ns, self.kernel.seed, question.seen)
        self._tasks[told.task_id] = told
        self._note(told)
