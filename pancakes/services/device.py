"""The Device Service: one task for each sensor and actuator of the agent (paper §3.3)."""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.control import Drive, EndDrive, Hold, SetFence
from pancakes.devices.driver import Actuator, Driver, Sensor
from pancakes.devices.health import ROUNDING_S, Line, MissRule, Readings
from pancakes.devices.validation import fault_of_command, reading_check
from pancakes.durable.messages import Known
from pancakes.errors import MailboxFullError, NoPermitError, PancakesError, describe
from pancakes.events import Log
from pancakes.filters.chain import SETTING, FilterChain, FilterSpec, settings_with_filters
from pancakes.filters.filter import Held
from pancakes.kernel.handlers import Tick, every, on
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.registry import DeviceEntry
from pancakes.mesh.transport import Transport
from pancakes.packet import CTRL, NETWORK, SYSTEM, Fence, Packet, agent_of, body_class, is_of_type
from pancakes.service import Service
from pancakes.services.fence import ActuatorFence, FencesOfAgent
from pancakes.settings import plain_settings
from pancakes.supervision.messages import ChangeTask
from pancakes.supervision.restart import RestartSpec
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, TaskSpec

if TYPE_CHECKING:
    from concurrent.futures import Future

    from pancakes.kernel.kernel import Kernel
    from pancakes.kernel.timer import OneShot
    from pancakes.services.driving import Driving
    from pancakes.supervision.lifecycle import Request


_Class = type
"""A field of `DeviceSpec` is called `type`."""
MOST_REFUSED: Final = 256
"""For at most this many sources, the reason why their commands were refused is remembered."""


class DeviceSpec(msgspec.Struct, frozen=True):
    """A device as data, from `[device.NAME]`.

    Attributes:
        name: its name.
        cls: the class of its driver.
        type: name of the driver's entry point.
        settings: the driver's settings, as plain values.
        rate_hz: how often it is sampled; None: whenever the driver has something.
        hold_after_s: an actuator goes to its safe hold after this mission time without a fresh command.
        restart: what happens when the driver fails.
        missed: when readings or commands that fail are too many, so that the device fails.
        silent_s: after this time without a reading, in mission seconds, a sensor is silent; None: as its driver says.
        filters: what a command to an actuator passes, in this order, before its driver gets it.
        drive_stop_s: an actuator that is driven by hand stops after this host time without a word of its driver.
    """

    name: str
    cls: type[Driver]
    type: str
    settings: Mapping[str, Any]
    rate_hz: float | None
    hold_after_s: float
    restart: RestartSpec
    missed: MissRule = MissRule()
    silent_s: float | None = None
    filters: tuple[FilterSpec, ...] = ()
    drive_stop_s: float = 0.5

    @property
    def settings_class(self) -> _Class:
        """The class of the device's settings: those of its driver, and those of its filters."""
        return settings_with_filters(self.cls.Settings, tuple((it.name, it.cls.Settings) for it in self.filters))

    @property
    def all_settings(self) -> Mapping[str, Any]:
        """The device's settings as plain values."""
        if not self.filters:
            return self.settings
        return {**self.settings, SETTING: {it.name: dict(it.settings) for it in self.filters}}


class SharedThings:
    """What the drivers of one agent share, such as the connection to a bus. Any thread.

    Attributes:
        kept: what each filter keeps while its device is restarted, by device and filter. The device's actor uses it.
    """

    def __init__(self) -> None:
        self.kept: dict[tuple[str, str], dict[str, Any]] = {}
        self._lock = threading.Lock()
        self._things: dict[str, Future[Any]] = {}

    def get(self, key: str, make: Callable[[], Any]) -> Any:
        """Return the thing under `key`, making it first if it is not there.

        A driver that opens while another makes the thing waits for that.
        """
        from concurrent.futures import Future  # only now: most drivers share nothing

        made: Future[Any] = Future()
        with self._lock:
            thing = self._things.setdefault(key, made)
        if thing is made:
            try:
                made.set_result(make())
            except BaseException as error:
                with self._lock:
                    del self._things[key]
                made.set_exception(error)
        return thing.result()

    def close(self) -> None:
        """Close all of them."""
        with self._lock:
            things = list(self._things.values())
            self._things.clear()
        for thing in things:
            thing.result().close()


class TaskContext:
    """What a driver gets of its agent: see `pancakes.devices.driver.DeviceContext`."""

    def __init__(self, task: DeviceTask, shared: SharedThings) -> None:
        self._task = task
        self._shared = shared
        self.agent = task.agent
        self.device = task.name
        self.random: random.Random = task.random
        self.transport: Transport = task.kernel.transport
        self.virtual = task.kernel.virtual is not None
        self.deliver = task.deliver  # not wrapped: a driver's thread calls it with each reading

    def now(self) -> float:
        return self._task.now()

    def missed(self, why: str) -> None:
        self._task.missed(why)

    def alive(self) -> None:
        self._task.alive()

    def send(self, channel: str, body: Any, to: str) -> None:
        self._task.publish(channel, body, to)

    def call(self, function: Callable[[], None]) -> None:
        self._task.call(function)

    def after(self, delay_s: float, function: Callable[[], None]) -> None:
        self._task.after(delay_s, function)

    @cached_property
    def log(self) -> Log:
        task, head = self._task, f"{self.device}: "
        return Log(lambda level, text, traceback: task.log(level, head + text, traceback))

    def mission_packets_sent(self) -> int:
        return self._task.kernel.mission_packets_sent()

    def network_awake(self) -> bool:
        return self._task.kernel.stream.gateway is not None

    def shared(self, key: str, make: Callable[[], Any]) -> Any:
        return self._shared.get(key, make)


class DeviceTask(TaskCore, Task):
    """One device: samples a sensor at its rate, or carries out what an actuator's holder commands.

    A reading that fails, or whose numbers are none, is missed and counted; so is a command that the hardware does not
    take. Too many of them fail the device.

    An actuator obeys the task that holds it (the kernel's registry says which) and, of that task, no epoch lower than
    the highest it has seen. A new epoch is on disk before it is obeyed; the newest command waits that long. Without a
    fresh command it goes to its safe hold. What it obeys passes its filters before the driver gets it.
    """

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        mailbox: Mailbox | None = None,
        *,
        device: DeviceSpec,
        shared: SharedThings,
        fences: FencesOfAgent,
        **others: Any,
    ) -> None:
        # The settings of a device are those of its driver and of its filters.
        self.Settings = device.settings_class  # type: ignore[misc]
        super().__init__(kernel, address, mailbox, **others)
        self.device = device
        self.blocking = device.cls.blocking
        self._shared = shared
        self._fence = ActuatorFence(self, fences, device.hold_after_s, self.command, self._refuse, self._hold)
        self.driver: Driver | None = None
        self._sensor: Sensor | None = None
        self._actuator: Actuator | None = None
        self._good_until_s = 0.0
        self._guard_shot: OneShot | None = None
        self._guard_s = math.inf
        self._holding = True
        self._chain: FilterChain | None = None
        self._filtered: Any = None  # what the filters have made of the newest command: a command, or `Held`
        self._opened_with: Mapping[str, Any] | None = None
        self._check_shot: OneShot | None = None
        self._checked: Packet | None = None  # the command that is looked at again
        self._crowded = False
        self._checks: dict[type, Callable[[Any], str]] = {}  # of readings, by the classes that have come
        self._refused: dict[str, str] = {}
        self.readings = Readings(device.missed, "reading", None, 0.0)

    @property
    def author_class(self) -> type:
        return self.device.cls

    def on_start(self) -> None:
        driver_class = self.device.cls
        self._context = TaskContext(self, self._shared)
        if self.device.filters:
            filters, kept = self.device.filters, self._shared.kept
            self._chain = FilterChain(self, driver_class.type, filters, self.settings, kept)
            self.kernel.registry.set_filters(self.name, self._chain.accounts)
            self._chain.open()
        self._open_driver()
        actuator = isinstance(self.driver, Actuator)
        if actuator:
            self.subscribe(CTRL, driver_class.type, self.command)
            self.subscribe(NETWORK, Known, self._told_where)
        alone_s = self._actuator.watchdog_s(self.device.hold_after_s) if self._actuator is not None else None
        self.kernel.registry.add_device(
            DeviceEntry(self.name, driver_class.type, actuator, driver_class.networked, self.address, alone_s)
        )

    def on_settings(self) -> None:
        if self._chain is not None:
            self._chain.take_settings(self.settings)
            if self._settings_of_driver() == self._opened_with:
                return  # the wheels need not stop because a filter has changed
        # A driver reads its settings when it is opened, so it is opened again.
        self._close_driver()
        self._open_driver()

    def _settings_of_driver(self) -> Mapping[str, Any]:
        return {key: value for key, value in plain_settings(self.settings).items() if key != SETTING}

    def on_stop(self) -> None:
        self.kernel.registry.remove_device(self.name)
        try:
            self._close_driver()
        finally:
            chain, self._chain = self._chain, None
            if chain is not None:
                chain.close()

    def _open_driver(self) -> None:
        if self._chain is not None:
            self._opened_with = self._settings_of_driver()
        self.driver = driver = self.device.cls(self._context, self.settings)
        # Which of the two it is, is asked for each reading and each command.
        self._sensor = driver if isinstance(driver, Sensor) else None
        self._actuator = driver if isinstance(driver, Actuator) else None
        silent_s = self.device.silent_s
        if silent_s is None and self._sensor is not None:
            silent_s = self._sensor.silent_s
        noun = "command" if self._actuator is not None else "reading"
        self.readings = readings = Readings(self.device.missed, noun, silent_s, self.now())
        self.kernel.registry.set_readings(self.name, readings)
        driver.open()
        self._look_for_silence(readings)

    def _look_for_silence(self, readings: Readings) -> None:
        """Look whether readings still come, each time that the newest may have grown too old."""
        if readings is not self.readings or self._sensor is None:
            return  # the driver was opened again since, or closed
        left_s, silent, lines = readings.look(self.now())
        self._say(lines)
        if silent:
            self._sensor.silent()
        if left_s < math.inf:
            self.after(left_s, lambda: self._look_for_silence(readings))

    def _close_driver(self) -> None:
        driver, self.driver, self._sensor, self._actuator = self.driver, None, None, None
        if driver is None:
            return
        self._holding, self._filtered = True, None
        try:
            if isinstance(driver, Actuator):
                driver.safe_stop()
                self.kernel.registry.note_moving(self.name, False)
        finally:
            driver.close()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.on_stop()

    @every(hz=0)
    def read(self, tick: Tick) -> None:
        """Take a reading and publish it."""
        sensor = self._sensor
        try:
            if sensor is None:
                if self._actuator is not None:
                    self._actuator.tick()
                return
            reading = sensor.read()
            if reading is not None and (fault := self._fault_of(reading)):
                raise PancakesError(fault)
        except Exception as error:
            if self.missed(describe(error, self.device.cls)):
                raise
            return
        if reading is not None:
            self._publish(reading)

    def deliver(self, reading: Any) -> None:
        """Publish a reading on `system`; one of another class, or whose numbers are none, is missed. Any thread."""
        if self.actor_stopped.on:
            return
        check = self._checks.get(reading.__class__)
        if check is not None and not check(reading):  # as nearly all are
            self._publish(reading)
        elif fault := self._fault_of(reading):
            self.missed(fault)
        else:
            self._publish(reading)

    def _fault_of(self, reading: Any) -> str:
        """Say why a body is no reading of this device; empty: it is one."""
        cls = reading.__class__
        check = self._checks.get(cls)
        if check is None:
            driver = self.device.cls
            wanted = body_class(driver.type)
            if wanted is not None and not is_of_type(reading, driver.type):
                brought = f"{driver.__qualname__} brings a {cls.__name__}"
                return f"{brought}, and its type is {driver.type!r}, whose readings are each a {wanted.__name__}"
            check = self._checks[cls] = reading_check(cls) or (lambda reading: "")
        fault = check(reading)
        return fault.lstrip(".") if fault else ""

    def missed(self, why: str) -> bool:
        """A reading, or a command, has failed; returns whether that was one too many. Any thread."""
        if self.actor_stopped.is_set():
            return False
        lines, too_many = self.readings.missed(why, self.now())
        self._say(lines)
        return too_many

    def alive(self) -> None:
        """The hardware has said something that is no reading. Any thread."""
        self._say(self.readings.alive(self.now()))

    def _say(self, lines: Sequence[Line]) -> None:
        for level, text in lines:
            self.log(level, f"{self.name}: {text}")

    def _publish(self, reading: Any) -> None:
        try:
            stamp_s = self.publish(SYSTEM, reading).stamp_s
        except MailboxFullError as error:
            stamp_s = self.now()
            # A sensor goes on although a reader is slow. Said once: at 10 readings a second it would drown the rest.
            if not self._crowded:
                self._crowded = True
                self.log("warning", f"readings of {self.name} are lost: {error}")
        else:
            self._crowded = False
        if lines := self.readings.came(stamp_s):
            self._say(lines)

    @on(SYSTEM, None, addressed=True)
    def receive(self, packet: Packet) -> None:
        """Take what was sent to this very device."""
        if self.driver is not None:
            self.driver.receive(packet)

    def command(self, packet: Packet) -> None:
        """Carry out a command of the actuator's holder; refuse those of all others."""
        if halted := self.kernel.halt.why:
            self._refuse(packet, halted)
            return
        refusal = self._refusal(packet)
        if refusal:
            self._refuse(packet, refusal)
            return
        if fault := fault_of_command(packet.body):
            self._refuse(packet, fault, "a number that is none")
            # Its holder cannot reckon any more: the command before is not what it wants now either.
            if not self._holding and packet.source == self.kernel.registry.holder(self.name):
                self._hold("a command was no command")
            return
        if not self._fence.stands(packet):
            return
        fence, ttl_s, speed = packet.fence, self.device.hold_after_s, self.kernel.mission.speed
        if fence is not None:
            fence = self.kernel.permits.limited(fence, ttl_s / speed)
            if fence.good_for_s is not None:
                ttl_s = min(ttl_s, fence.good_for_s * speed)
        if ttl_s <= 0:
            self._come_late(packet)
            return
        if refusal := self._claim(packet.source):
            self._refuse(packet, refusal)
            return
        refused = self._refused.pop(packet.source, "")
        now_s = self.now()
        before_s, self._good_until_s = self._good_until_s, now_s + ttl_s
        if self._holding:
            self._holding = False
            self.kernel.registry.note_moving(self.name, True)
        # What a virtual actuator sends on is said under the right of the task that commands it.
        self.fence = fence
        try:
            self._carry_out(packet.body, ttl_s, packet.source, new=True)
        except NoPermitError:  # it was over before a virtual actuator had sent it on
            self._come_late(packet)
            return
        except Exception as error:
            self._filtered = None  # it is not known what the hardware has got: the next command writes, or holds
            self._refused[packet.source] = why = describe(error, self.device.cls)
            if refused != why:
                self.event("command_refused", device=self.name, by=packet.source, reason=why)
            if self.missed(why):
                raise
            if before_s > now_s:  # the hardware still has the command before, which is good for no longer than it was
                self._good_until_s = before_s
        else:
            self._say(self.readings.came(now_s))
        finally:
            self.fence = None
        if self._good_until_s < self._guard_s:
            self._guard_in(ttl_s)
        if self._chain is not None and (check_s := self._chain.check_s) is not None:
            self._check_in(check_s, packet, fence)

    def _carry_out(self, command: Any, ttl_s: float, source: str, *, new: bool) -> None:
        """Let a command pass the filters, and give the driver what comes of it.

        Args:
            command: the command's body.
            ttl_s: for how long it is good.
            source: the task that gave it.
            new: whether it has just come; one that is looked at again is written only if it comes out otherwise.
        """
        driver, chain = self._actuator, self._chain
        assert driver is not None
        if chain is not None:
            before, command = self._filtered, chain.apply(command, ttl_s, source)
            self._filtered = command
            if isinstance(command, Held):
                if not isinstance(before, Held):
                    chain.on_hold()
                    driver.safe_stop()
                return
            if not new and command == before:
                return
        driver.write(command, ttl_s, source)

    def _check_in(self, check_s: float, packet: Packet, fence: Fence | None) -> None:
        """Let the newest command pass the filters again in some time, if no other has come by then."""
        if self._check_shot is not None:
            self._check_shot.cancel()
        self._checked = packet
        self._check_shot = self.after(check_s, lambda: self._check_again(packet, fence))

    def _check_again(self, packet: Packet, fence: Fence | None) -> None:
        if packet is not self._checked:
            return  # a newer command came while this look waited for its turn
        self._check_shot = None
        ttl_s = self._good_until_s - self.now()
        if self._holding or self._chain is None or self.driver is None or ttl_s <= ROUNDING_S:
            return
        self.fence = fence
        try:
            self._carry_out(packet.body, ttl_s, packet.source, new=False)
        except NoPermitError:
            self._come_late(packet)
            return
        except Exception as error:
            self._filtered = None  # it is not known what the hardware has got: the next look writes
            if self.missed(describe(error, self.device.cls)):
                raise
        finally:
            self.fence = None
        if (check_s := self._chain.check_s) is not None:
            self._check_in(check_s, packet, fence)

    def _come_late(self, packet: Packet) -> None:
        """A command is of a guarded task that may not act now."""
        assert packet.fence is not None
        self.kernel.permits.hold_back(packet.fence, "commands")
        if not self._holding:
            self._hold("its task may not act")
        self._refuse(packet, f"{packet.fence.task_id} may not act until its guardians answer")

    def _refuse(self, packet: Packet, refusal: str, kind: str = "") -> None:
        # Said once for each source and reason: at 10 commands a second it would drown everything else.
        if self._refused.get(packet.source) != (kind or refusal):
            self._refused[packet.source] = kind or refusal
            if len(self._refused) > MOST_REFUSED:  # a peer may give itself ever new addresses
                del self._refused[next(iter(self._refused))]
            self.event("command_refused", device=self.name, by=packet.source, reason=refusal)
            self.log("warning", f"{self.name} refused a command of {packet.source}: {refusal}")

    def _refusal(self, packet: Packet) -> str:
        # First of all: a task without a right must not get an actuator that is free just now.
        if passed := self._fence.passed(packet):
            return passed
        holder = self.kernel.registry.holder(self.name)
        if holder and packet.source != holder:
            loan = self.kernel.registry.loan(self.name)
            return loan.why if loan is not None else f"it is held by {holder}"
        if not holder and agent_of(packet.source) == self.agent:
            return f"{packet.source} does not hold it"
        return ""

    def _claim(self, source: str) -> str:
        """Let another agent's virtual actuator hold this one for as long as its commands are fresh.

        Returns:
            Why it cannot; empty: it holds it.
        """
        registry = self.kernel.registry
        holder = registry.holder(self.name) or registry.claim(self.name, source)
        return f"it is held by {holder}" if holder and holder != source else ""

    def _told_where(self, packet: Packet) -> None:
        if packet.destination == self.address:
            self._fence.told(packet)

    def set_fence(self, change: ChangeTask) -> None:
        body = change.body
        if self._actuator is None or not isinstance(body, SetFence):
            super().set_fence(change)  # which refuses
            return
        self._fence.set(body, change.request.by, lambda reason, result: self.answer_change(change, reason, result))

    def _guard_in(self, ttl_s: float) -> None:
        if self._guard_shot is not None:
            self._guard_shot.cancel()
        self._guard_s = self.now() + ttl_s
        self._guard_shot = self.after(ttl_s, self._guard)

    def _guard(self) -> None:
        """Look whether a fresh command has come in the time that the last one was good for."""
        self._guard_s, self._guard_shot = math.inf, None
        left_s = self._good_until_s - self.now()
        if left_s > 1e-9:
            self._guard_in(left_s)
            return
        if not self._holding:
            self._hold("no fresh command")

    @on(CTRL, Hold, addressed=True)
    def hold(self, packet: Packet) -> None:
        """Go to the safe hold at once, if a service of this agent or the holder asks for it."""
        if agent_of(packet.source) == self.agent or packet.source == self.kernel.registry.holder(self.name):
            self._hold(packet.body.reason)

    def _hold(self, reason: str) -> None:
        self._holding = True
        self._filtered = None
        self._fence.drop()
        if self._chain is not None:
            self._chain.on_hold()
        if isinstance(self.driver, Actuator):
            self.driver.safe_stop()
            self.kernel.registry.note_moving(self.name, False)
            self.event("safe_hold", device=self.name, reason=reason)
            holder = self.kernel.registry.holder(self.name)
            if holder and agent_of(holder) != self.agent:
                self.kernel.registry.release(holder)


class DeviceService(ServiceCore, Service):
    """Creates the device tasks and schedules them (paper §3.3).

    Args:
        devices: the devices that it looks after.
        fences: what the actuators have seen of the tasks that command them.
    """

    def __init__(self, *args: Any, fences: FencesOfAgent, devices: Sequence[DeviceSpec] = (), **others: Any) -> None:
        super().__init__(*args, **others)
        self._devices = tuple(devices)
        self._shared = SharedThings()
        self._fences = fences
        self._driving: Driving | None = None  # only once somebody drives: few agents import it

    def own_tasks(self) -> Sequence[TaskSpec]:
        return [
            TaskSpec(
                name=device.name,
                cls=DeviceTask,
                type=device.type,
                settings=device.all_settings,
                rate_hz=device.rate_hz,
                restart=device.restart,
                device=device.cls.type,
                arguments={"device": device, "shared": self._shared, "fences": self._fences},
            )
            for device in self._devices
        ]

    def on_stop(self) -> None:
        self._shared.close()

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if slot is None or not isinstance(body, (Drive, EndDrive)):
            if slot is not None and self._driving is not None:
                self._driving.check(slot, body)
            super().carry_out_command(body, slot, request)
            return
        from pancakes.services.driving import MOTORS, Driving, Wheels

        if self._driving is None:
            self._driving = Driving(self)
        spec: DeviceSpec | None = slot.spec.arguments.get("device")
        wheels = None
        if spec is not None and issubclass(spec.cls, Actuator) and spec.cls.type == MOTORS:
            wheels = Wheels(spec.name, spec.hold_after_s, spec.drive_stop_s)
        self._driving.asked(slot, wheels, body, request)

    def take_message(self, message: Any) -> Any:
        if self._driving is not None and self._driving.takes(message):
            return None
        return super().take_message(message)

    def rested(self, slot: Slot) -> None:
        super().rested(slot)
        if self._driving is not None:
            self._driving.rested(slot)

    def settings_class(self, slot: Slot) -> type:
        device: DeviceSpec | None = slot.spec.arguments.get("device")
        return device.settings_class if device is not None else super().settings_class(slot)

    def describe_in_detail(self, slot: Slot) -> dict[str, Any]:
        marks = self._fences.fences.of(slot.name)
        fences = [
            {"task_id": task_id, "epoch": mark.n, "minter": mark.minter, "brought_by": mark.peer}
            for task_id, mark in sorted(marks.items())
        ]
        told = {**super().describe_in_detail(slot), "fences": fences}
        entry = next((it for it in self.kernel.registry.devices() if it.name == slot.name and it.actuator), None)
        return {**told, "watchdog_s": entry.watchdog_s} if entry is not None else told

    def author_of(self, slot: Slot) -> type:
        device: DeviceSpec | None = slot.spec.arguments.get("device")
        return device.cls if device is not None else super().author_of(slot)
