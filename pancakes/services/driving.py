"""Drive an actuator by hand: a task takes it from its holder, obeys a person, and gives it back (docs/drive.md).

`fault_of` and `Driver` decide who drives; they are pure. `HandDrive` is the task that has the actuator meanwhile. It
repeats the newest command, so that it stays fresh for the device, and stops the actuator if the driver says nothing.
`Driving` is the part of the Device Service that starts the task, and passes on what drivers ask for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.control import Drive, EndDrive, Hold, Refusal, Restart, Start
from pancakes.devices import Twist
from pancakes.devices.validation import fault_of_command
from pancakes.errors import ControlRefusedError
from pancakes.kernel.mailbox import Reference, tell
from pancakes.kernel.registry import Loan
from pancakes.packet import CTRL, Cause, agent_of, type_name
from pancakes.supervision.lifecycle import Request, StartAsked, State
from pancakes.supervision.messages import LoanChanged
from pancakes.supervision.restart import RestartSpec
from pancakes.supervision.slots import Slot
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, TaskSpec

if TYPE_CHECKING:
    from pancakes.kernel.timer import OneShot
    from pancakes.supervision.service_core import ServiceCore

SILENT_S: Final = 5.0
"""A drive ends after this silence of its driver, in host time: longer than a link is usually down."""
REPEATS: Final = 3
"""How often a command is repeated in the time that a command is good for."""
MOTORS: Final = type_name(Twist)
ENDING: Final = "a drive of {} is ending: begin another one after that"
ROUNDING_S: Final = 1e-6
"""Times in seconds that differ by less are the same."""
PREFIX: Final = "drive-"
"""The name of the task that drives a device begins with it."""


class Driver(msgspec.Struct, frozen=True):
    """Who drives an actuator.

    Attributes:
        id: the drive.
        by: who drives, an address.
        heard_s: when the driver was heard last, in host time.
        cause: the newest packet of the driver.
    """

    id: str
    by: str
    heard_s: float
    cause: Cause

    @property
    def name(self) -> str:
        """The name for people."""
        return agent_of(self.by)


def fault_of(driver: Driver | None, body: Drive | EndDrive, device: str) -> str:
    """Return why the sender of a packet may not drive now, as a sentence; empty: it may. Pure.

    Args:
        driver: who drives; None: nobody does.
        body: what is asked for.
        device: the actuator.
    """
    if driver is not None and driver.id == body.id:
        return ""
    begins = isinstance(body, Drive) and body.begin
    if driver is None:
        return "" if begins else f"this drive of {device} is over: begin another one"
    if not begins:
        return f"{driver.name} has taken over {device}"
    if isinstance(body, Drive) and body.take:
        return ""
    return f"{driver.name} drives {device} by hand already: wait for the end of that, or take it over with --take"


class Wheels(msgspec.Struct, frozen=True):
    """An actuator that can be driven by hand.

    Attributes:
        name: its name.
        hold_after_s: for how long a command is good, in mission time.
        stop_after_s: it stops after this host time without a word of its driver.
    """

    name: str
    hold_after_s: float
    stop_after_s: float


class Hand(msgspec.Struct, frozen=True):
    """The Device Service passes on what a driver asks for.

    Attributes:
        request: what to answer.
        body: what is asked for.
    """

    request: Request
    body: Drive | EndDrive


class HandAnswer(msgspec.Struct, frozen=True):
    """What a driver asked for is done, or refused.

    Attributes:
        slot: the name of the task that tells.
        request: what to answer.
        refusal: why not; None: it is done.
        result: of `Drive`, see there.
    """

    slot: str
    request: Request
    refusal: Refusal | None
    result: dict[str, Any] | None


class HandDrive(TaskCore, Task):
    """Drives one actuator for a person, and gives it back at its end, whatever ends it.

    Args:
        drives: the actuator.
        service: the Device Service, which passes on and answers.
        first: what begins the drive.
    """

    def __init__(self, *args: Any, drives: Wheels, service: Reference, first: Hand, **others: Any) -> None:
        super().__init__(*args, **others)
        self._device = drives
        self._service = service
        self._first = first
        self._driver: Driver | None = None
        self._command = Twist(0.0, 0.0)
        self._moving = False
        self._over = False
        self._repeat_shot: OneShot | None = None
        self._silence_shot: OneShot | None = None

    def on_start(self) -> None:
        self._take(self._first)

    def take_message(self, message: Any) -> Any:
        if not isinstance(message, Hand):
            return super().take_message(message)
        self._take(message)
        return None

    def _take(self, hand: Hand) -> None:
        body, request = hand.body, hand.request
        try:
            result: dict[str, Any] | None = None
            if isinstance(body, Drive):
                result = self._drive(body, request)
            else:
                self._end(body)
            answer = HandAnswer(self.name, request, None, result)
        except ControlRefusedError as error:
            answer = HandAnswer(self.name, request, Refusal.of(error), None)
        tell(self._service, answer)

    def _drive(self, body: Drive, request: Request) -> dict[str, Any]:
        device = self._device.name
        if self._over:
            raise ControlRefusedError(ENDING.format(device), "busy")
        if fault := fault_of(self._driver, body, device):
            raise ControlRefusedError(fault, "conflict")
        if body.dry_run:
            return self._result(request.by)
        before, now_s, stop_s = self._driver, self.kernel.host.now(), self._device.stop_after_s
        self._driver = Driver(body.id, request.by, now_s, request.cause)
        goes_on = before is not None and before.id == body.id
        if not goes_on:
            self._begin(self._driver, before)
        # After a silence it may have waited for the link: the person may have let the key go since.
        late = goes_on and before is not None and now_s - before.heard_s >= stop_s - ROUNDING_S
        if not late:
            self._command, self._moving = Twist(body.v_mps, body.omega_radps), True
        elif self._moving:
            self._hold(f"no command of {self._driver.name} for {stop_s:g} s")
        self._look_in(stop_s)
        self._repeat()
        return self._result(request.by, late)

    def _result(self, by: str, late: bool = False) -> dict[str, Any]:
        registry, device = self.kernel.registry, self._device.name
        filters = registry.filters(device)
        return {
            "device": device,
            "driver": by,
            "late": late,
            "stop_after_s": self._device.stop_after_s,
            "paused": self._paused(),
            "filters": filters.describe(self.now()) if filters is not None else [],
        }

    def _paused(self) -> str:
        """Return the address of the task that waits; empty: none does, or it is on another agent."""
        registry = self.kernel.registry
        holder = registry.lender(self._device.name)
        return holder if holder and registry.get(holder) is not None else ""

    def _begin(self, driver: Driver, before: Driver | None) -> None:
        """Take the actuator from its holder, or from another driver."""
        registry, device = self.kernel.registry, self._device.name
        loan = Loan(device, self.address, driver.name)
        # What its holder has commanded last must not go on.
        self._hold(loan.why)
        holder = registry.lend(loan)
        self._tell_holder(holder)
        taken_from = before.by if before is not None else ""
        self.event("drive_begun", device=device, by=driver.by, taken_from=taken_from, holder=holder)

    def _tell_holder(self, holder: str) -> None:
        task = self.kernel.registry.get(holder) if holder else None
        if task is not None:
            tell(task, LoanChanged())

    def _hold(self, reason: str) -> None:
        self._moving = False
        if (address := self.kernel.registry.address_of(self._device.name)) != "":
            self.publish(CTRL, Hold(reason), to=address)

    def _repeat(self) -> None:
        """Give the actuator the newest command, and again before that is old."""
        if self._repeat_shot is not None:
            self._repeat_shot.cancel()
            self._repeat_shot = None
        driver, address = self._driver, self.kernel.registry.address_of(self._device.name)
        if self.kernel.halt.why:
            self._moving = False  # at the end of the halt it waits for the driver's next command
        if not self._moving or driver is None or not address:
            return
        self.publish(CTRL, self._command, to=address, cause=driver.cause)
        self._repeat_shot = self.after(self._device.hold_after_s / REPEATS, self._repeat)

    def _look_in(self, delay_s: float) -> None:
        if self._silence_shot is not None:
            self._silence_shot.cancel()
        self._silence_shot = self.after_host(delay_s, self._look_for_silence)

    def _look_for_silence(self) -> None:
        """Stop the actuator if the driver is silent, and end the drive if it stays so."""
        driver = self._driver
        if driver is None:
            return
        silent_s = self.kernel.host.now() - driver.heard_s
        stop_s = self._device.stop_after_s
        if silent_s >= SILENT_S - ROUNDING_S:
            self._give_back("silent")
            self.stop()
        elif silent_s >= stop_s - ROUNDING_S:
            if self._moving:
                self._hold(f"no command of {driver.name} for {stop_s:g} s")
            self._look_in(SILENT_S - silent_s)
        else:
            self._look_in(stop_s - silent_s)

    def _end(self, body: EndDrive) -> None:
        if fault := fault_of(self._driver, body, self._device.name):
            raise ControlRefusedError(fault, "conflict")
        if not body.dry_run:
            self._give_back("ended")
            self.stop()

    def on_stop(self) -> None:
        self._give_back("stopped")

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self._give_back("lost by a failure")

    def _give_back(self, reason: str) -> None:
        """Let the actuator obey its holder again, from its safe hold on; once."""
        self._over = True
        driver, self._driver = self._driver, None
        if driver is None:
            return
        try:
            self._hold(f"{driver.name} drives it by hand no longer")
        finally:  # else its holder would wait for ever
            holder = self.kernel.registry.end_loan(self._device.name)
            self._tell_holder(holder)
        self.event("drive_ended", device=self._device.name, by=driver.by, reason=reason, holder=holder)


class Driving:
    """A part of the Device Service: starts the tasks that drive, and passes on what drivers ask for. In its actor.

    Args:
        service: the service.
    """

    def __init__(self, service: ServiceCore) -> None:
        self._service = service
        self._unanswered: dict[str, list[Request]] = {}  # by the task that was asked

    def asked(self, device: Slot, wheels: Wheels | None, body: Drive | EndDrive, request: Request) -> None:
        """Carry out what a driver asks for.

        Args:
            device: the place of the device.
            wheels: the same, if it can be driven.
            body: what is asked for.
            request: what to answer.

        Raises:
            ControlRefusedError: it cannot be done; the message says why.
        """
        service = self._service
        if wheels is None:
            found = [it.name for it in service.kernel.registry.devices() if it.actuator and it.type == MOTORS]
            instead = f", but {' or '.join(found)} can (--device)" if found else ""
            raise ControlRefusedError(f"{device.address} cannot be driven by hand{instead}", "unsupported")
        name = PREFIX + device.name
        slot = service.slots.get(name)
        if slot is not None and slot.spec.cls is not HandDrive:
            raise ControlRefusedError(
                f"{device.address} cannot be driven by hand, because {slot.address} has the name of the task that would"
                " drive it: give that device another name",
                "unsupported",
            )
        driven = slot is not None and slot.task is not None and not slot.life.at_rest
        if isinstance(body, Drive):
            if fault := fault_of_command(Twist(body.v_mps, body.omega_radps)):
                raise ControlRefusedError(f"{device.name} takes no such velocity: {fault}", "invalid")
            if service.kernel.halt.why:
                raise ControlRefusedError(
                    f"{service.agent} is {service.kernel.halt.why}. To end it: pancakes halt --end", "unable"
                )
            if device.life.state is not State.RUNNING:
                raise ControlRefusedError(f"{device.how_it_is}, not running", "unable")
        if slot is not None and driven:
            self._pass_on(slot, Hand(request, body))
            return
        if fault := fault_of(None, body, device.name):
            raise ControlRefusedError(fault, "conflict")
        if slot is not None:
            raise ControlRefusedError(f"{slot.how_it_is}, and another drive begins only after that", "busy")
        if body.dry_run:
            service.reply(request)
        else:
            self._start(name, wheels, Hand(request, body))

    def check(self, slot: Slot, body: Any) -> None:
        """Raise `ControlRefusedError` if a command would begin a drive without its driver."""
        if slot.spec.cls is HandDrive and isinstance(body, (Start, Restart)):
            raise ControlRefusedError(f"{slot.address} begins only with its driver: use pancakes drive", "unsupported")

    def _start(self, name: str, wheels: Wheels, first: Hand) -> None:
        service = self._service
        arguments = {"drives": wheels, "service": service, "first": first}
        task = TaskSpec(name=name, cls=HandDrive, start=False, restart=RestartSpec("no"), arguments=arguments)
        slot = service.open_slot(task)
        self._unanswered.setdefault(name, []).append(first.request)
        service.feed(slot, StartAsked())

    def _pass_on(self, slot: Slot, hand: Hand) -> None:
        assert slot.task is not None
        self._unanswered.setdefault(slot.name, []).append(hand.request)
        tell(slot.task, hand)  # one that ends is followed by `rested`, which answers

    def takes(self, message: Any) -> bool:
        """Take what a task tells that drives; return False if the message is another one."""
        if not isinstance(message, HandAnswer):
            return False
        unanswered = self._unanswered.get(message.slot, [])
        if message.request in unanswered:
            unanswered.remove(message.request)
            self._service.reply(message.request, message.refusal, message.result)
        return True

    def rested(self, slot: Slot) -> None:
        """A task has come to rest: if it drove, its place is gone, and what it has not answered is refused."""
        if slot.spec.cls is not HandDrive:
            return
        service = self._service
        service.call(lambda: self._forget(slot))  # once its life has been told
        ending = Refusal.of(ControlRefusedError(ENDING.format(slot.name.removeprefix(PREFIX)), "busy"))
        for request in self._unanswered.pop(slot.name, ()):
            service.reply(request, ending)

    def _forget(self, slot: Slot) -> None:
        service = self._service
        if service.slots.get(slot.name) is slot and slot.life.at_rest:
            del service.slots[slot.name]
            service.kernel.tasks.strike_out(service.name, slot.name)
