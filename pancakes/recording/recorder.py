"""The recorder: a task of the Log Service that writes the packets on its agent's channels to MCAP files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.control import Describe, Reply
from pancakes.events import Event
from pancakes.kernel.handlers import on
from pancakes.kernel.mailbox import tell
from pancakes.packet import LOG, SYSCTRL, Packet, agent_of
from pancakes.recording.records import is_described
from pancakes.recording.settings import RecordingSettings
from pancakes.task import Task

if TYPE_CHECKING:
    from pancakes.recording.recording import Recording

DRAIN_S: Final = 0.5
"""How often, in host time, the packets that wait are written: each time wakes a thread, which costs as much as many
packets, ..."""
DRAIN_SOON_S: Final = 0.02
"""... and how often where an answer is waited for, or much comes, so that no turn is long: a control task may want the
interpreter, ..."""
MANY: Final = 1000
"""... which is more packets than this."""
PATIENCE_S: Final = 1.0
"""How long, in host time, the answer to a question about a task may take."""

ASK_AGAIN_S: Final = 0.1
"""After so long, in host time, an agent is asked again what a task is whose service was only starting, ..."""
MOST_QUESTIONS: Final = 50
"""... so often at most."""


class _TaskQuestion(msgspec.Struct, frozen=True):
    """A question of the recorder to its agent.

    Attributes:
        target: the task that it is about; empty: the running tasks.
        seen: whether the recording saw that task start.
        again: how often it is repeated if it is refused.
        asked_s: when it was asked, in host time.
    """

    target: str
    seen: bool = False
    again: int = MOST_QUESTIONS
    asked_s: float = 0.0


class RecordingBegan(msgspec.Struct, frozen=True):
    """The recorder tells the Log Service that it writes.

    Attributes:
        first: the first file of the recording.
    """

    first: Path


class Recorder(Task):
    """Write all packets that are seen on some channels of its agent, and what its tasks were.

    If the disk is full or slow, only the recording suffers, never the robot.
    """

    blocking = True  # a disk may make it wait

    Settings = RecordingSettings

    class State(msgspec.Struct):
        """The state that the recorder starts with.

        Attributes:
            goes_on: the first file of an earlier recording, which goes on; empty: a new one begins.
        """

        goes_on: str = ""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._recording: Recording | None = None
        self._ended = False
        self._asked: dict[int, _TaskQuestion] = {}
        self._first = Path()

    def on_start(self) -> None:
        from pancakes.recording.recording import Recording  # only now: most agents record nothing

        take_seq = self._actor.kernel.seq_of(self.address).take
        goes_on = Path(self.state.goes_on) if self.state.goes_on else None
        recording = Recording(self._actor.kernel, self.settings, self.log, take_seq, self.address, goes_on)
        self.state.goes_on = ""
        recording.asking = lambda: bool(self._asked)
        self._recording = recording
        self._first = recording.first
        self.event("recording_started", path=str(self._first))
        service = self._actor.kernel.registry.get(self.address.rpartition("/")[0])
        if service is not None:
            tell(service, RecordingBegan(self._first))
        self._ask(_TaskQuestion(""))
        self.after_host(DRAIN_S, self._write)

    def _write(self) -> None:
        """Write what has come since the last time."""
        assert self._recording is not None
        host = self._actor.kernel.host
        now_s = host.now()
        self._asked = {seq: asked for seq, asked in self._asked.items() if asked.asked_s > now_s - PATIENCE_S}
        soon = self._recording.waits() > MANY or bool(self._asked)
        reason = self._recording.write()
        if not reason:
            # A slow disk does not delay the next turn: the packets that arrive meanwhile are soon safe as well.
            rest_s = DRAIN_S - (host.now() - now_s)
            self.after_host(DRAIN_SOON_S if soon else max(rest_s, DRAIN_SOON_S), self._write)
        elif not self._ended:
            self._ended = True
            self.log("warning", f"the recording {self._first} ends: {reason}")
            self.event("recording_stopped", path=str(self._first), reason=reason)
            self.stop()

    def on_stop(self) -> None:
        if self._recording is not None:
            self._recording.end()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.on_stop()

    # What the tasks are ----------------------------------------------------------------------------------------

    @on(LOG, Event)
    def on_event(self, packet: Packet) -> None:
        """Ask about a task that has started: a later run may need its settings and state."""
        event: Event = packet.body
        if agent_of(packet.source) != self.agent:
            return
        target = f"{event.fields.get('service')}/{event.fields.get('task')}"
        if event.kind == "task_started":
            self._ask_about(target, seen=True)
        elif event.kind == "task_stopped" and self._recording is not None:
            self._recording.ended(f"{self.agent}/{target}")

    def _ask(self, question: _TaskQuestion) -> None:
        about = Describe(question.target, state=bool(question.target), began=question.seen)
        seq = self.publish(SYSCTRL, about).seq
        self._asked[seq] = _TaskQuestion(question.target, question.seen, question.again, self._actor.kernel.host.now())

    def _ask_about(self, target: str, seen: bool) -> None:
        if is_described(target):
            self._ask(_TaskQuestion(target, seen))

    @on(SYSCTRL, Reply, addressed=True)
    def on_reply(self, packet: Packet) -> None:
        """Take the agent's answer: its running tasks, or the description of a task."""
        if packet.cause is None or packet.cause[1] not in self._asked or self._recording is None:
            return
        question = self._asked.pop(packet.cause[1])
        reply: Reply = packet.body
        if not reply.ok:
            # Its service is only starting; or the task has ended meanwhile, and this is refused to the end.
            if question.again:
                later = _TaskQuestion(question.target, question.seen, question.again - 1)
                self.after_host(ASK_AGAIN_S, lambda: self._ask(later))
            return
        if "tasks" in reply.result:
            for row in reply.result["tasks"]:
                if row["state"] == "running":
                    self._ask_about(f"{row['service']}/{row['task']}", seen=False)
            return
        self._recording.describe(reply.result, question.seen)
