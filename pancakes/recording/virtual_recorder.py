"""Record an agent in virtual time from outside: it sends no packets to the agent, so the run stays the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from pancakes.control import Describe
from pancakes.errors import ControlRefusedError
from pancakes.events import Event
from pancakes.kernel.kernel import Counter, Kernel
from pancakes.packet import LOG, Packet, agent_of, join
from pancakes.recording.recording import Recording
from pancakes.recording.records import is_described
from pancakes.recording.settings import RecordingSettings
from pancakes.supervision.lifecycle import State
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot
from pancakes.supervision.task_core import TaskCore

WRITE_S: Final = 0.25
"""How often, in virtual time, the packets that wait are written."""


class VirtualRecorder:
    """Record one agent in virtual time.

    What the agent publishes is tapped, and what its tasks are is read between two turns. So no actor gets a turn that
    it would not have otherwise: a run that is recorded is the same run to the byte. In the thread in which the agent
    runs.

    Args:
        kernel: the agent's kernel; best before anything has run on it.
        settings: what is recorded, and where to.
        say: takes a sentence about a problem.

    Raises:
        PancakesError: nothing can be written there, ...
    """

    def __init__(self, kernel: Kernel, settings: RecordingSettings, say: Callable[[str], None]) -> None:
        assert kernel.virtual is not None, f"{kernel.agent} does not run in virtual time"
        self._kernel = kernel
        self._dispatcher = kernel.virtual
        self._say = say
        self._over = False
        source = join(kernel.agent, "log", "Recorder")
        self._recording = Recording(kernel, settings, lambda level, text: say(text), Counter(1).take, source)
        kernel.stream.tap(LOG, self._hear)
        for component in kernel.registry.components():
            if isinstance(component, ServiceCore):
                for slot in component.slots.values():
                    self._describe(component, slot, seen=False)
        self._write_later()

    def end(self) -> None:
        """Write what has come, and close the file. A second call does nothing."""
        if not self._over:
            self._over = True
            self._kernel.stream.untap(LOG, self._hear)
            self._recording.end()

    def _hear(self, packet: Packet) -> None:
        """Note that a task has started or ended. In its service's turn, so the task itself gets no turn."""
        event = packet.body
        if not isinstance(event, Event) or agent_of(packet.source) != self._kernel.agent:
            return
        name = str(event.fields.get("task"))
        service = self._kernel.actor(str(event.fields.get("service")))
        if not isinstance(service, ServiceCore) or name not in service.slots:
            return
        if event.kind == "task_started":
            self._describe(service, service.slots[name], seen=True)
        elif event.kind == "task_stopped":
            self._recording.ended(service.slots[name].address)

    def _describe(self, service: ServiceCore, slot: Slot, seen: bool) -> None:
        task = slot.task
        described_as = f"{service.name}/{slot.name}"
        if not isinstance(task, TaskCore) or slot.life.state is not State.RUNNING or not is_described(described_as):
            return
        try:
            asked = Describe(slot.name, state=True, began=seen)
            described = {**service.describe_in_detail(slot), **task.describe_state(asked)}
            self._recording.describe(described, seen)
        except ControlRefusedError as error:
            self._say(str(error))

    def _write_later(self) -> None:
        self._dispatcher.call_at(self._kernel.host.now() + WRITE_S, self._write)

    def _write(self) -> None:
        if self._over:
            return
        reason = self._recording.write()
        if reason:
            self._say(f"the recording {self._recording.first} ends: {reason}")
            self.end()
        else:
            self._write_later()
