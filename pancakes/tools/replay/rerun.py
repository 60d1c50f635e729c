"""Runs one task's present code in virtual time on what it got in a recording."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from msgspec.structs import replace

from pancakes.errors import PancakesError, PluginError, describe
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.net.memory import MemoryNetwork
from pancakes.packet import Fence, Packet, agent_of
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.registry import DeviceEntry
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.kernel.virtual import VirtualDispatcher
from pancakes.runtime.plugins import Plugins
from pancakes.runtime.supervision.task_messages import Carried, GoOn, StandStill
from pancakes.settings import change_plain
from pancakes.task import Task
from pancakes.tools.recording.recorded_packet import RecordingError
from pancakes.tools.replay.comparison import StreamKey, key_of
from pancakes.tools.replay.late_timer import ROUNDING_S, LateTimer
from pancakes.tools.replay.script import Script
from pancakes.tools.replay.stays import STOPPED, Stay
from pancakes.tools.replay.steps import Change, Given


@dataclass
class Outcome:
    """What a task did when it was run again.

    Attributes:
        outputs: the packets that it published, in order.
        failed: why it failed; empty where it did not.
        failed_s: when, in mission time.
        notes: sentences on what could not be done as it was.
    """

    outputs: list[Packet] = field(default_factory=list)
    failed: str = ""
    failed_s: float = 0.0
    notes: list[str] = field(default_factory=list)


_Said = tuple[StreamKey, str]
"""The body of a packet, and what it is compared by."""


def _said(packet: Packet) -> _Said:
    return key_of(packet), repr(packet.body)


def class_of(stay: Stay, plugins: Plugins) -> type[Task]:
    """Returns the present class of a recorded task.

    Raises:
        RecordingError: it is not installed, cannot be imported, or is one that its service made.
    """
    try:
        found: type[Task] = plugins.get("pancakes.tasks", stay.task.type)
    except PluginError as error:
        raise RecordingError(f"{stay.task_id} cannot be run again: {error}") from None
    return found


class Rerun:
    """One task, alone on an agent that has nothing else, from the beginning of a stay to its end.

    Args:
        stay: the stay.
        script: what the task got, and gave.
        cls: its present class.
        settings: settings that shall differ from the recorded ones, as plain values.

    Raises:
        SettingsError: they do not fit.
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
            stay.agent, self._kernel.mission, self._dispatcher, script.spoken_s, script.speed, script.ticks
        )
        # A task that listens or dials finds a network without other agents.
        network = MemoryNetwork(self._dispatcher.call_at, self._dispatcher.clock.now, random.Random("network"))
        self._kernel.transport = network.transport(stay.agent)
        self._tapped: dict[str, None] = {}
        self._now_of: dict[_Said, list[int]] = {}
        self._carried, self._rate_hz = self._beginning()
        change_plain(cls.Settings, self._carried.settings, self._settings)
        # What answers the task names one of its packets; where it publishes others now, the number is another.
        self._place_of: dict[int, tuple[_Said, int]] = {}
        counts: dict[_Said, int] = {}
        for packet in script.outputs:
            said = _said(packet)
            self._place_of[packet.seq] = (said, counts.get(said, 0))
            counts[said] = counts.get(said, 0) + 1

    def run(self) -> Outcome:
        """Runs the task; once.

        Raises:
            RecordingError: it cannot begin, for instance because its class has changed too much.
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
            # It has begun long ago: what it says at its start was said then.
            outcome.outputs.clear()
            self._now_of.clear()
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
        self._kernel.stop()
        return outcome

    def _run_until(self, time_s: float) -> None:
        dispatcher = self._dispatcher
        dispatcher.run_until(max(dispatcher.clock.now(), time_s))
        while dispatcher.next_s() <= time_s + ROUNDING_S:
            dispatcher.step()
        dispatcher.settle()

    def _beginning(self) -> tuple[Carried, float | None]:
        told = self._stay.task
        if told.began is not None:
            began = told.began
            periods_s = {name: float(period) for name, period in began["periods_s"].items()}
            settings = {**began["settings"], **self._settings}
            return Carried(settings, began["state"], periods_s), began["rate_hz"]
        rates = {timer["timer"]: timer["rate_hz"] for timer in told.timers}
        periods_s = {name: 1.0 / rate_hz if rate_hz else float("inf") for name, rate_hz in rates.items()}
        return Carried({**told.settings, **self._settings}, told.state, periods_s), None

    def _spawn(self) -> Task:
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
        except Exception as error:  # what a task's author wrote in __init__ may raise anything
            why = describe(error, self._cls)
            raise RecordingError(f"{stay.task_id} cannot begin with what was recorded: {why}") from None
        self._dispatcher.settle()
        return task

    def _ended(self, component: Component, error: BaseException | None) -> None:
        if error is not None:
            self._outcome.failed = describe(error, self._cls)
            self._outcome.failed_s = self._kernel.mission.now()

    # What it publishes -----------------------------------------------------------------------------------------

    def _tap(self) -> None:
        for channel in self._kernel.stream.channels():
            if channel not in self._tapped:
                self._tapped[channel] = None
                self._kernel.stream.tap(channel, self._take)

    def _take(self, packet: Packet) -> None:
        if packet.source == self._address:
            self._outcome.outputs.append(packet)
            self._now_of.setdefault(_said(packet), []).append(packet.seq)

    # What it gets ----------------------------------------------------------------------------------------------

    def _give(self, task: Task, given: Given) -> None:
        packet = given.packet
        cause = packet.cause
        if cause is not None and cause[0] == self._address:
            packet = replace(packet, cause=(self._address, self._seq_now(cause[1])))
        if given.letter:
            task.call(lambda: task.run_handlers(packet))
        elif agent_of(packet.source) == self._stay.agent:
            self._kernel.stream.publish(packet)
        else:
            self._kernel.stream.inject(packet)

    def _seq_now(self, seq: int) -> int:
        """Returns the number that a packet of the task's bears in this run, given the one that it bore."""
        place = self._place_of.get(seq)
        if place is None:
            return seq
        said, number = place
        now = self._now_of.get(said, [])
        return now[number] if number < len(now) else seq

    def _change(self, task: Task, change: Change) -> None:
        event = change.event

        def make() -> None:
            if event.kind == "rate_changed":
                task.reschedule(event.fields["rate_hz"], event.fields["timer"])
            else:
                told = event.fields["settings"]
                task.change_settings({name: told[name] for name in told if name not in self._settings})

        def try_it() -> None:
            try:
                make()
            except (PancakesError, ValueError) as error:
                self._outcome.notes.append(f"at {change.time_s:.3f} s what was changed then cannot be: {error}")

        if event.kind == "task_frozen":
            tell(task, StandStill(Epoch(0, "")))
        elif event.kind == "task_resumed":
            tell(task, GoOn())
        else:
            task.call(try_it)
