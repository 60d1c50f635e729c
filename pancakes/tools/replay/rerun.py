"""Run one task's present code in virtual time on the recorded input.

`LateTimer` gives it the ticks that ran then, as late as they were.
"""

from __future__ import annotations

import random
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, cast

from msgspec.structs import replace

from pancakes.errors import PancakesError, PluginError, describe
from pancakes.kernel.actor import Component, core_of
from pancakes.kernel.handlers import Tick
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import REQUEST_TYPES, Call, tell
from pancakes.kernel.registry import DeviceEntry
from pancakes.kernel.timer import TaskTimer, Ticking, VirtualTimer
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.memory_network import MemoryNetwork
from pancakes.packet import Fence, Packet, agent_of
from pancakes.recording.records import RecordingError
from pancakes.settings import change_plain
from pancakes.supervision.messages import Carried, GoOn, StandStill
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task
from pancakes.tools.replay.comparison import StreamKey, key_of
from pancakes.tools.replay.recorded_run import STOPPED, Change, Given, RanTicks, Script, Stay
from pancakes.util.clock import MissionClock
from pancakes.util.plugins import Plugins

LATEST_S: Final = 0.5
"""How long a tick may be delayed, in seconds of mission time."""
TURN_S: Final = 0.0002
"""The typical time from the beginning of a tick to the first packet of the task, in seconds of host time."""
ROUNDING_S: Final = 1e-9


class LateTimer(VirtualTimer):
    """Ticks in virtual time, as late as they were in the recording.

    In a live run, a tick comes later than it is due, and the task may have handled packets in between. If the lateness
    is unknown, the tick is delayed to the time of the next packet without a cause, if that came before the next tick.

    Args:
        name: the agent's name.
        mission: the mission clock, with the dispatcher's time.
        dispatcher: runs everything.
        spontaneous_s: see `Script.spontaneous_s`.
        speed: mission seconds per second of host time then.
        ran: which ticks ran, by the method that they call; None: all.
    """

    def __init__(
        self,
        name: str,
        mission: MissionClock,
        dispatcher: VirtualDispatcher,
        spontaneous_s: Sequence[tuple[float, float]],
        speed: float,
        ran: Mapping[str, RanTicks] | None = None,
    ) -> None:
        super().__init__(name, mission, dispatcher)
        self._turn_s = TURN_S * speed
        self._spontaneous_s = spontaneous_s
        self._ran = ran or {}
        self._held: dict[int, _Held] = {}

    def every(self, target: Ticking, period_s: float) -> None:
        self.cancel(target)
        ran = self._ran.get(target.method) if isinstance(target, TaskTimer) else None
        held = self._held[id(target)] = _Held(self, target, period_s, ran)
        super().every(held, period_s)

    def cancel(self, target: Ticking) -> None:
        held = self._held.pop(id(target), None)
        if held is not None:
            held.ended = True
            super().cancel(held)

    def hold_back(self, held: _Held, tick: Tick) -> None:
        """Deliver a tick that is due: now, or as late as it was then; `tick` has its lateness if that is known."""
        deadline_s = tick.time_s
        if tick.lateness_s:
            self._dispatcher.call_at(deadline_s + tick.lateness_s, lambda: held.tick(tick))
            return
        place = bisect_left(self._spontaneous_s, (deadline_s - ROUNDING_S, 0.0))
        spontaneous_s, before_s = self._spontaneous_s[place] if place < len(self._spontaneous_s) else (deadline_s, 0.0)
        if not ROUNDING_S < spontaneous_s - deadline_s < held.most_s:
            held.tick(tick)
            return
        # The packet before it was published before the tick.
        begun_s = max(spontaneous_s - self._turn_s, before_s + 10 * ROUNDING_S)
        self._dispatcher.call_at(begun_s, lambda: held.tick(tick))


class _Held:
    """Take the ticks in place of a task's timer, and pass them on later."""

    def __init__(self, timer: LateTimer, target: Ticking, period_s: float, ran: RanTicks | None) -> None:
        self._timer = timer
        self._target = target
        self._period_s = period_s
        self._ran = ran
        self.most_s = min(0.9 * period_s, LATEST_S)
        self.ended = False

    def fire(self, deadline_s: float, missed: int) -> None:
        if self._ran is None:
            self._timer.hold_back(self, Tick(deadline_s, missed))
        elif (tick := self._ran.tick_at(deadline_s, self._period_s)) is not None:
            self._timer.hold_back(self, tick)

    def tick(self, tick: Tick) -> None:
        if not self.ended:
            self._target.fire(tick.time_s, tick.missed)


@dataclass
class Outcome:
    """The result of a rerun.

    Attributes:
        outputs: the packets that the task published, in order.
        failed: why it failed; empty if it did not.
        failed_s: when it failed, in mission time.
        notes: sentences about recorded changes that could not be repeated.
    """

    outputs: list[Packet] = field(default_factory=list)
    failed: str = ""
    failed_s: float = 0.0
    notes: list[str] = field(default_factory=list)


_Content = tuple[StreamKey, str]
"""The stream of a packet, and its body as text."""


def _content(packet: Packet) -> _Content:
    return key_of(packet), repr(packet.body)


def class_of(stay: Stay, plugins: Plugins) -> type[Task]:
    """Return the present class of a recorded task.

    Raises:
        RecordingError: the class is not installed, cannot be imported, or is internal to a service.
    """
    try:
        found: type[Task] = plugins.get("pancakes.tasks", stay.task.type)
    except PluginError as error:
        raise RecordingError(f"{stay.task_id} cannot be rerun: {error}") from None
    return found


class Rerun:
    """Run one task on an otherwise empty agent, from the beginning of a stay to its end.

    Args:
        stay: the stay.
        script: what the task received and published then.
        cls: its present class.
        settings: settings that replace the recorded ones, as plain values.

    Raises:
        SettingsError: the settings are invalid.
    """

    def __init__(self, stay: Stay, script: Script, cls: type[Task], settings: Mapping[str, Any]) -> None:
        self._stay = stay
        self._script = script
        self._cls = cls
        self._settings = dict(settings)
        self._address = stay.task.address
        self._outcome = Outcome()
        self._dispatcher = VirtualDispatcher()
        self._kernel = Kernel(stay.agent, seed=stay.task.seed, virtual=self._dispatcher)
        self._kernel.timer.halt()
        self._kernel.timer = LateTimer(
            stay.agent, self._kernel.mission, self._dispatcher, script.spontaneous_s, script.speed, script.ticks
        )
        # A task that listens or dials finds a network without other agents.
        network = MemoryNetwork(self._dispatcher.call_at, self._dispatcher.clock.now, random.Random("network"))
        self._kernel.transport = network.transport(stay.agent)
        self._tapped: dict[str, None] = {}
        self._is_over = False
        self._seqs_now: dict[_Content, list[int]] = {}
        self._carried, self._rate_hz = self._beginning()
        change_plain(cls.Settings, self._carried.settings, self._settings)
        # An answer to the task names the number of its packet. In this run the packet may have another number, so find
        # it by its content, and its place among packets with the same content.
        self._place_of: dict[int, tuple[_Content, int]] = {}
        counts: dict[_Content, int] = {}
        for packet in script.outputs:
            content = _content(packet)
            self._place_of[packet.seq] = (content, counts.get(content, 0))
            counts[content] = counts.get(content, 0) + 1

    def run(self) -> Outcome:
        """Run the task. Call this once.

        Raises:
            RecordingError: the task cannot start, for instance because its class has changed too much.
        """
        stay, script, outcome = self._stay, self._script, self._outcome
        for channel in script.channels:
            self._kernel.stream.open(channel)
        self._tap()
        self._kernel.stream.tap_outgoing(self._take)
        for device in dict.fromkeys([*stay.task.requires, *self._cls.requires]):
            self._kernel.registry.add_device(DeviceEntry(device, device))
        if script.outputs:
            self._kernel.continue_seq(self._address, script.outputs[0].seq)
        self._dispatcher.run_until(stay.begins_s)
        task = self._spawn()
        if not stay.whole:
            # Then, the task had started before the recording: ignore the packets of its start.
            outcome.outputs.clear()
            self._seqs_now.clear()
        for step in script.steps:
            self._run_until(step.time_s)
            if outcome.failed:
                break
            if isinstance(step, Given):
                self._give(task, step)
            else:
                self._change(task, step)
            self._dispatcher.settle()
            self._tap()
        if not outcome.failed:
            self._run_until(script.end_s)
            if stay.end == STOPPED and not task.actor_stopped.is_set():
                task.stop()
                self._dispatcher.settle()
        self._is_over = True
        if task.loop is not None and not task.actor_stopped.is_set():
            task.loop.close()  # it awaits something still
        self._kernel.stop()
        return outcome

    def _run_until(self, time_s: float) -> None:
        dispatcher = self._dispatcher
        dispatcher.run_until(max(dispatcher.clock.now(), time_s))
        while dispatcher.next_s() <= time_s + ROUNDING_S:
            dispatcher.step()
        dispatcher.settle()

    def _beginning(self) -> tuple[Carried, float | None]:
        task = self._stay.task
        if task.began is not None:
            began = task.began
            periods_s = {name: float(period) for name, period in began["periods_s"].items()}
            settings = {**began["settings"], **self._settings}
            return Carried(settings, began["state"], periods_s), began["rate_hz"]
        rates = {timer["timer"]: timer["rate_hz"] for timer in task.timers}
        periods_s = {name: 1.0 / rate_hz if rate_hz else float("inf") for name, rate_hz in rates.items()}
        return Carried({**task.settings, **self._settings}, task.state, periods_s), None

    def _spawn(self) -> TaskCore:
        stay = self._stay
        fence = Fence(stay.task.task_id, (stay.task.epoch, stay.agent)) if stay.task.task_id else None
        try:
            task = self._kernel.spawn(
                self._cls,
                self._address,
                exited=self._ended,
                carried=self._carried,
                rate_hz=self._rate_hz,
                fence=fence,
            )
        except Exception as error:  # the user's __init__ may raise anything
            why = describe(error, self._cls)
            raise RecordingError(f"{stay.task_id} cannot start with the recorded settings and state: {why}") from None
        self._dispatcher.settle()
        return cast("TaskCore", core_of(task))

    def _ended(self, component: Component, error: BaseException | None) -> None:
        if error is not None:
            self._outcome.failed = describe(error, self._cls)
            self._outcome.failed_s = self._kernel.mission.now()

    # Packets of the task ---------------------------------------------------------------------------------------

    def _tap(self) -> None:
        for channel in self._kernel.stream.channels():
            if channel not in self._tapped:
                self._tapped[channel] = None
                self._kernel.stream.tap(channel, self._take)

    def _take(self, packet: Packet) -> None:
        if packet.source == self._address and not self._is_over:
            self._outcome.outputs.append(packet)
            self._seqs_now.setdefault(_content(packet), []).append(packet.seq)

    # Packets and changes for the task --------------------------------------------------------------------------

    def _give(self, task: TaskCore, given: Given) -> None:
        packet = given.packet
        cause = packet.cause
        if cause is not None and cause[0] == self._address:
            packet = replace(packet, cause=(self._address, self._seq_now(cause[1])))
        if packet.type in REQUEST_TYPES:
            asked = self._renumbered(packet)
            # Its own, as it is taken also while the task awaits: that may be this answer.
            task.actor_inbox.put(Call(task, lambda: task.requests.take(asked), is_own=True))
        elif given.letter:
            task.call(lambda: task.run_handlers(packet))
        elif agent_of(packet.source) == self._stay.agent:
            self._kernel.stream.publish(packet)
        else:
            self._kernel.stream.inject(packet)

    def _renumbered(self, packet: Packet) -> Packet:
        """Return a packet of requests with the number that the task's request has in this run."""
        from pancakes.kernel.request_packets import Answered, Feedback, read

        body = read(packet)
        if isinstance(body, Answered | Feedback) and body.source == self._address:
            body = replace(body, seq=self._seq_now(body.seq))
        return replace(packet, body=body)

    def _seq_now(self, seq: int) -> int:
        """Return the number in this run of a packet of the task, given its recorded number."""
        place = self._place_of.get(seq)
        if place is None:
            return seq
        content, number = place
        now = self._seqs_now.get(content, [])
        return now[number] if number < len(now) else seq

    def _change(self, task: TaskCore, change: Change) -> None:
        event = change.event

        def make() -> None:
            if event.kind == "rate_changed":
                task.reschedule(event.fields["rate_hz"], event.fields["timer"])
            else:
                settings = event.fields["settings"]
                task.change_settings({name: settings[name] for name in settings if name not in self._settings})

        def try_it() -> None:
            try:
                make()
            except (PancakesError, ValueError) as error:
                self._outcome.notes.append(f"the change at {change.time_s:.3f} s cannot be repeated: {error}")

        if event.kind == "task_frozen":
            tell(task, StandStill(0))
        elif event.kind == "task_resumed":
            tell(task, GoOn())
        else:
            task.call(try_it)
