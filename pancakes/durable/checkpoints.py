"""Writes running tasks down, and acknowledges letters once their effect is on disk.

`snapshot_of` and `spec_of` convert between a task and its snapshot. `Checkpointing` looks for tasks that have
changed: once a second (`durability = "lazy"`) or after each turn (`"each"`). `Deliveries` gives letters to tasks and
answers their senders. All in the service's actor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import asdict, replace

from pancakes.durable.delivery import (
    COURIER,
    AskedBegan,
    CameFor,
    ForwardTo,
    Letter,
    PacketId,
    Receipt,
    Say,
    StreamsBegan,
)
from pancakes.durable.hosting import BeganFrom, LastCheckpoint, Place, TaskLetters, plain_of
from pancakes.durable.installed import Installed
from pancakes.durable.messages import REGISTRAR
from pancakes.durable.reconcile import Outcome, Write
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.durable.register_messages import Guarded
from pancakes.durable.rules import Desired, Save
from pancakes.durable.snapshot import Posted, Snapshot
from pancakes.errors import MigrationError, PancakesError
from pancakes.kernel.dead_letters import ATTEMPTS
from pancakes.kernel.mailbox import Reference, tell
from pancakes.migration import GuardRule, MigrationRule
from pancakes.packet import Packet
from pancakes.settings import plain_value
from pancakes.supervision.lifecycle import State
from pancakes.supervision.messages import Carried, Give, LetterGiven, LetterOutcome, Look, Looked
from pancakes.supervision.restart import RestartSpec
from pancakes.supervision.slots import Slot
from pancakes.task import Nothing, TaskSpec
from pancakes.util import codecs
from pancakes.util.arrays import alike

if TYPE_CHECKING:
    from pancakes.durable.client_service import ClientServiceCore


def snapshot_of(
    spec: TaskSpec,
    task_id: TaskId,
    service: str,
    carried: Carried | None,
    posted: Posted | None = None,
) -> Snapshot:
    """Returns a task as data.

    Args:
        spec: how it is started.
        task_id: its identity for life.
        service: the service that looks after it.
        carried: what it carries; None: it has not begun yet.
        posted: what it has sent to other tasks and is not acknowledged; only of one that moves.
    """
    carried = carried or Carried(spec.settings, {})
    return Snapshot(
        task_id=task_id,
        type=spec.type,
        version=spec.version,
        service=service,
        requires=spec.cls.requires,
        settings=set_of(spec, carried.settings),
        configured=dict(spec.settings),
        state=dict(carried.state),
        periods_s=dict(carried.periods_s),
        posted=posted,
        heard=dict(carried.heard),
        restart=asdict(spec.restart),
        durability=spec.durability,
        migrate=asdict(spec.rule) if spec.rule is not None else None,
        guard=asdict(spec.guard) if spec.guard is not None else None,
        rate_hz=spec.rate_hz,
        created=spec.created,
        offers=spec.cls.offers,
        requests=carried.requests,
    )


def set_of(spec: TaskSpec, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that were set, by its configuration or since: a new version may have other defaults."""
    defaults = _defaults_of(spec.cls.Settings)
    return {
        name: value
        for name, value in settings.items()
        if name in spec.settings or name not in defaults or not alike(value, defaults[name])
    }


@cache
def _defaults_of(cls: type) -> dict[str, Any]:
    """Returns the defaults of the fields of a class of settings, as plain values."""
    info = codecs.type_info(cls)
    if not isinstance(info, msgspec.inspect.DataclassType | msgspec.inspect.StructType):
        return {}
    defaults: dict[str, Any] = {}
    for field in info.fields:
        if field.default is not msgspec.NODEFAULT:
            defaults[field.name] = plain_value(field.default)
        elif field.default_factory is not msgspec.NODEFAULT:
            defaults[field.name] = plain_value(field.default_factory())
    return defaults


def spec_of(snapshot: Snapshot, catalogue: Installed) -> TaskSpec:
    """Returns how to start a task of which nothing is known here but its snapshot.

    Raises:
        PancakesError: its class is not installed here.
        msgspec.ValidationError: its rules of restart or migration are none.
    """
    cls, version = catalogue.find(snapshot.type)
    return TaskSpec(
        name=snapshot.task_id.name,
        cls=cls,
        type=snapshot.type,
        version=version,
        settings=snapshot.configured,
        start=False,
        restart=codecs.convert(snapshot.restart, RestartSpec) if snapshot.restart else RestartSpec(),
        durability=snapshot.durability,
        rule=codecs.convert(snapshot.migrate, MigrationRule) if snapshot.migrate is not None else None,
        guard=codecs.convert(snapshot.guard, GuardRule) if snapshot.guard is not None else None,
        rate_hz=snapshot.rate_hz,
        created=snapshot.created,
    )


def carried_of(snapshot: Snapshot) -> Carried:
    """Returns what a task that begins from a snapshot carries."""
    return Carried(snapshot.settings, snapshot.state, snapshot.periods_s, snapshot.heard, snapshot.requests)


def settings_now(snapshot: Snapshot, configured: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Returns a task's own settings with what its configuration has changed since, and the names of that."""
    settings, before = dict(snapshot.settings), snapshot.configured
    changed = [key for key in configured if key not in before or not alike(before[key], configured[key])]
    settings.update((key, configured[key]) for key in changed)
    removed = [key for key in before if key not in configured]
    for key in removed:
        settings.pop(key, None)
    return settings, [*changed, *removed]


CHECKPOINT_S: Final = 1.0
"""How often, in host time, a task whose state has changed is written down (`durability = "lazy"`)."""
AT_ONCE: Final = 20
"""How many tasks are looked at in one go; a look at a thousand would make all of them 20 ms late, each second."""


class Checkpointing:
    """Looks at the tasks of one service, and writes down what has changed. All in that service's actor.

    A guarded task has a time of its own; those with the same one share packets, and rounds of the disk.

    Args:
        host: the service.

    Attributes:
        late: the places of tasks whose checkpoint had to wait for the disk.
    """

    def __init__(self, host: ClientServiceCore) -> None:
        self._host = host
        self.late: dict[TaskId, Place] = {}
        self._begun = False
        self._periods: set[float] = set()

    def begin(self) -> None:
        """Look at all tasks from now on, as long as there are any."""
        if not self._begun:
            self._begun = True
            self._host.after_host(CHECKPOINT_S, self._look_at_all)

    def _look_at_all(self) -> None:
        self._begun = False
        names = [slot.name for slot in self._host.slots.values() if slot.spec.guard is None]
        batches = [names[start : start + AT_ONCE] for start in range(0, len(names), AT_ONCE)]
        for number, batch in enumerate(batches):
            if number == 0:
                self.look_at(batch)
            else:
                self._host.after_host(number * CHECKPOINT_S / len(batches), partial(self.look_at, batch))
        if self._host.slots:
            self.begin()

    def guarded(self, place: Place) -> None:
        """Look at a guarded task, now and again and again."""
        slot = place.slot
        if slot is None or slot.spec.guard is None:
            return
        self._look_at_guarded([place])
        self._look_later(slot.spec.guard.checkpoint_s)

    def _look_later(self, every_s: float) -> None:
        if every_s in self._periods:
            return
        self._periods.add(every_s)
        to_next_s = every_s - self._host.kernel.host.now() % every_s
        if to_next_s < every_s / 2:  # it may be next to nothing, as numbers are rounded
            to_next_s += every_s
        self._host.after_host(to_next_s, partial(self._look_again, every_s))

    def _look_again(self, every_s: float) -> None:
        self._periods.discard(every_s)
        guarded = [it for it in self._host.slots.values() if it.spec.guard is not None]
        due = [it for it in guarded if it.spec.guard is not None and it.spec.guard.checkpoint_s == every_s]
        self._look_at_guarded([self._host.places.at[it.name] for it in due])
        if due:
            self._look_later(every_s)

    def _look_at_guarded(self, places: Sequence[Place]) -> None:
        self.look_at([it.slot.name for it in places if it.slot is not None])
        for place in places:
            self._look_at_actuators(place)

    def _look_at_actuators(self, place: Place) -> None:
        slot, host = place.slot, self._host
        if slot is None or not place.record.owned:
            return
        unsafe = frozenset(host.kernel.registry.without_dead_man(slot.address))
        for device in sorted(unsafe - place.unsafe):
            host.log(
                "warning",
                f"{slot.address} is guarded and commands {device}, whose hardware does not stop it unless commanded:"
                " if this process is stopped or killed, it keeps its last command",
            )
            host.event("no_dead_man", task=slot.name, device=device)
        place.unsafe = unsafe

    def look_at(self, names: Sequence[str]) -> None:
        """Look at some tasks, by name."""
        places = self._host.places
        for name in names:
            slot = self._host.slots.get(name)
            if slot is None or slot.task is None or slot.life.state is not State.RUNNING:
                continue
            # Its duplicate filter cannot have changed either: a letter that it is given leaves it owing an answer.
            place = places.at[slot.name]
            written, kernel = place.written, self._host.kernel
            note, timers = kernel.tasks.settings_of(slot.address), kernel.task_timers.of(slot.address)
            if place.owes or written is None or not written.surely_holds(note, timers):
                tell(slot.task, Look())
            else:
                self._unchanged(place)

    def _unchanged(self, place: Place) -> None:
        """The task is as its newest checkpoint says."""
        place.looked_s, place.unwritable = self._host.kernel.host.now(), False
        slot = place.slot
        if slot is not None and slot.spec.guard is not None and place.removal is None:
            self._host.kernel.tell(REGISTRAR, Guarded(place.task_id, slot.spec.type, slot.spec.guard, place.looked_s))

    def look_at_late(self) -> None:
        """The disk has written something: looks at the tasks whose checkpoint had to wait."""
        late, self.late = self.late, {}
        for place in late.values():
            slot = place.slot
            if slot is not None and (slot.spec.durability == "each" or place.owes):
                self.look_at([slot.name])

    def looked(self, slot: Slot, looked: Looked) -> None:
        """A task says what it carries."""
        if looked.carried is None:
            self._tell_unwritable(slot, looked.reason)
        else:
            self.save(slot, looked.carried)

    def save(self, slot: Slot, carried: Carried) -> None:
        """Write down a running task, if anything has changed."""
        if slot.life.state is not State.RUNNING:
            return
        place = self._host.places.at[slot.name]
        if not place.course.settled:
            # The disk is slow, or a migration under way: the next time will do, and nothing piles up meanwhile.
            self.late[place.task_id] = place
            return
        try:
            plain = plain_of(carried)
            if place.written is not None and place.written.plain == plain and not place.owes:
                self._unchanged(place)
                return
            snapshot = self._host.snapshot(slot, carried)
        except PancakesError as error:
            self._tell_unwritable(slot, str(error))
            return
        place.unwritable = False
        place.written = LastCheckpoint(plain, carried if slot.spec.cls.State is Nothing else None)
        place.looked_s = self._host.kernel.host.now()
        consumed = place.letters.consumed(carried.heard) if place.letters is not None else ()
        then = partial(self._saved, place, consumed)
        self._host.tell_registrar(place, Save(snapshot), then, write=Write.SAVE, is_checkpoint=True)

    def _saved(self, place: Place, consumed: Sequence[PacketId], outcome: Outcome, why: str) -> None:
        if outcome in (Outcome.FAILED, Outcome.DECLINED):
            place.written = None
        elif outcome is Outcome.COUNTS:
            # Only then its effect outlives this agent, too, so that a take-over keeps it.
            for packet in consumed:
                self._host.on_disk(place, packet)

    def _tell_unwritable(self, slot: Slot, why: str) -> None:
        """Tells `log` once what a task carries that cannot be written down, until it can again."""
        place = self._host.places.at[slot.name]
        if not place.unwritable:
            place.unwritable = True
            self._host.log("error", f"what {slot.address} carries cannot be written down: {why}")


class Deliveries:
    """Gives letters to the tasks of one service. All in that service's actor.

    With `durability = "each"` a letter is acknowledged once its effect is on disk. With `"lazy"` that runs ahead of the
    disk: the letter is kept here until it is written down, and given again to a task that failed and begins again from
    its checkpoint. So only a crash of the whole agent, or a failure of the service itself, loses what was acknowledged.

    Args:
        host: the service.
    """

    def __init__(self, host: ClientServiceCore) -> None:
        self._host = host

    def arrived(self, came: CameFor) -> None:
        """Take a letter; if it cannot be given to the task now, its sender keeps it and sends it again."""
        letter, host = came.letter, self._host
        place = host.places.get(TaskId.parse(letter.task_id))
        if place is None:
            return
        record = place.record
        if record.owned and place.course.desired is Desired.RUN and not place.course.paused:
            self._deliver(place, letter, came.packet)
        elif record.standing in (Standing.RELEASED, Standing.MEMBER) and record.peer:
            self._say(letter.sender, ForwardTo(letter.task_id, record.peer, record.seen.n))
        # Stopped or undecided: the sender keeps the letter, for want of an acknowledgement, and sends it again.

    def _deliver(self, place: Place, letter: Letter, packet: Packet | None) -> None:
        slot = place.slot
        if slot is None or slot.task is None or slot.life.state is not State.RUNNING:
            return
        place.letters = letters = place.letters or TaskLetters()
        key = (letter.stream, letter.seq)
        if packet is None and key not in letters.failures:
            letters.note_failures(letter, ATTEMPTS)
            reason = f"{slot.address} cannot read packet #{letter.seq} of {letter.stream}"
            self._host.kernel.dead_letters.bury(reason)
        addressed = None
        if packet is not None and letters.failures.get(key, 0) < ATTEMPTS:
            # To its handlers it is as any other packet that names them.
            addressed = replace(packet, destination=slot.address)
        # It comes again and again while the task computes or waits, and would fill the memory.
        if letters.give(slot.task, letter, packet):
            tell(slot.task, Give(letter, addressed))

    def given(self, told: LetterGiven) -> None:
        """A task says what has become of a letter."""
        letter, task = told.give.letter, told.task
        place = self._host.places.get(TaskId.parse(letter.task_id))
        letters = place.letters if place is not None else None
        if place is None or letters is None:
            return  # the task was given away meanwhile
        packet = letters.looked_at(task, letter)
        if told.outcome is LetterOutcome.FAILED:
            # It is not acknowledged, so it comes again when the task has been restarted.
            failures = letters.failures.get((letter.stream, letter.seq), 0) + 1
            letters.note_failures(letter, failures)
            if failures == ATTEMPTS and packet is not None:
                self._host.kernel.dead_letters.bury(
                    f"{task.address} failed {failures} times on {packet.type!r} #{packet.number} from {packet.source}"
                )
        elif told.outcome is LetterOutcome.TAKEN:
            self._took(place, letters, task, letter, packet)

    def _took(self, place: Place, letters: TaskLetters, task: Reference, letter: Letter, packet: Packet | None) -> None:
        slot = place.slot
        if slot is None or slot.task is not task:
            return  # the actor that took it has ended; its sender, which has not been told so, sends it again
        letters.took(letter)
        if slot.spec.durability == "each":
            return
        if letters.keep(letter, packet):
            self._acknowledge(place, PacketId(letter.stream, letter.seq), letter.sender)
        elif not letters.asked:
            letters.asked = True
            tell(task, Look())

    def became_owner(self, place: Place) -> None:
        """A task is owned here from now on, or under another epoch: remembers what it begins from."""
        record, slot = place.record, place.slot
        if slot is not None and slot.task is not None:
            return  # it goes on as it is
        try:
            snapshot = Snapshot.decode(record.snapshot)
        except MigrationError:  # it cannot be started either, which is said where that is tried
            return
        place.began = BeganFrom(record.epoch.n, snapshot.heard)

    def asked_began(self, message: AskedBegan) -> None:
        """An agent that has sent letters to a task asks from what state it began here."""
        place = self._host.places.get(TaskId.parse(message.asked.task_id))
        if place is not None and place.began is not None and place.record.owned:
            upto = {stream: place.began.upto(stream) for stream in message.asked.streams}
            began = StreamsBegan(message.asked.task_id, place.began.epoch_n, upto, place.began.life)
            self._say(message.peer, began)

    def again(self, place: Place) -> None:
        """Give a task that has begun again what was acknowledged and is not in its checkpoint; all else comes after."""
        if place.letters is not None:
            for letter, packet in list(place.letters.kept.values()):
                self._deliver(place, letter, packet)

    def on_disk(self, place: Place, packet: PacketId) -> None:
        """A letter, and all before it in its stream, have had their effect for good."""
        sender = place.letters.on_disk(packet) if place.letters is not None else ""
        if sender:
            self._acknowledge(place, packet, sender)

    def _acknowledge(self, place: Place, packet: PacketId, sender: str) -> None:
        """Tells the sender of a letter that it, and all before it, have had their effect."""
        began, epoch_n = place.began, place.record.epoch.n
        receipt = Receipt(str(place.task_id), packet.stream, packet.seq, epoch_n)
        if began is not None:
            upto = began.upto(packet.stream)
            receipt = replace(receipt, began_n=began.epoch_n, began_seq=upto, began_life=began.life)
        self._say(sender, receipt)

    def _say(self, peer: str, body: Receipt | ForwardTo | StreamsBegan) -> None:
        self._host.kernel.tell(COURIER, Say(peer, body))
