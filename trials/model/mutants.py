"""Broken variants of the hand-off's core, each of which the search must convict.

A mutant is an edit of the product's own source: text that must stand there exactly once, and what a hurried
author would have written instead. So it cannot rot: when the source changes, either the edit still applies
and the mutant is searched, or `make` fails and says which text is gone.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
from dataclasses import dataclass
from types import ModuleType

from model.parts import Bounds, Core, Keep

from pancakes.durable import handoff, snapshot

Edit = tuple[ModuleType, str, str]


@dataclass(frozen=True)
class Mutant:
    """One broken variant.

    Attributes:
        name: its name, as PROTOCOL lists it.
        story: what a hurried author would have done.
        edits: module, text as it stands there, text instead.
        bounds: the bounds of the search that convicts it.
    """

    name: str
    story: str
    edits: tuple[Edit, ...]
    bounds: Bounds = Bounds()

    def make(self) -> Core:
        """Returns the core with the edits made.

        Raises:
            LookupError: a text does not stand in its module exactly once.
        """
        texts = {module: inspect.getsource(module) for module in (handoff, snapshot)}
        for module, old, new in self.edits:
            if texts[module].count(old) != 1:
                raise LookupError(f"the mutant {self.name!r} finds its text {texts[module].count(old)} times: {old}")
            texts[module] = texts[module].replace(old, new)
        made = {module: _module(module, text) for module, text in texts.items()}
        return Core(made[handoff].handle, made[handoff].recover, made[snapshot].Snapshot.decode)


def _module(original: ModuleType, text: str) -> ModuleType:
    spec = importlib.util.spec_from_loader(f"mutant_of_{original.__name__.replace('.', '_')}", loader=None)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    module.__dict__["Keep"] = Keep
    # Dataclasses and structs look their module up by name while they are made.
    sys.modules[module.__name__] = module
    try:
        exec(compile(text, f"<mutant of {original.__name__}>", "exec"), module.__dict__)
    finally:
        del sys.modules[module.__name__]
    return module


_COMMIT = """                Persist(record),
                Discard(),
                *_commit(record, 0, times),
"""

MUTANTS = (
    Mutant(
        "commit sent before it is persisted",
        "the source sends COMMIT, then writes COMMITTED",
        ((handoff, _COMMIT, "*_commit(record, 0, times), Persist(record), Discard(),\n"),),
    ),
    Mutant(
        "abort after commit",
        "the source times out in COMMITTED and takes the task back",
        (
            (
                handoff,
                "record.phase is not Phase.FROZEN or record.offer != event.offer",
                "record.phase not in (Phase.FROZEN, Phase.COMMITTED) or record.offer != event.offer",
            ),
        ),
    ),
    Mutant(
        "start on transfer",
        "the destination starts the task when the snapshot arrives",
        (
            (
                handoff,
                "    return [Persist(record), Remember(Volatile()), *recover_candidate(record, times)]",
                "    return [Persist(record), StartTask(record.offer, 0, record.snapshot),"
                " *recover_candidate(record, times)]",
            ),
        ),
    ),
    Mutant(
        "activated before persisted",
        "the destination says that it owns the task, then writes it down",
        ((handoff, "            Persist(own),\n", "            answer, Persist(own),\n"),),
    ),
    Mutant(
        "offer number reused after a crash",
        "the offered epoch is not written down with the frozen task",
        ((handoff, "        seen=event.offer,\n", ""),),
    ),
    Mutant(
        "late NAK believed",
        "a refusal that comes late takes a committed task back",
        (
            (
                handoff,
                "if record.phase is Phase.FROZEN and (record.peer, record.offer) == (peer, message.offer):",
                "if (record.peer, record.offer) == (peer, message.offer):",
            ),
        ),
    ),
    Mutant(
        "prepared kept in memory only",
        "the destination saves itself a write",
        (
            (
                handoff,
                "    return [Persist(record), Remember(Volatile()), *recover_candidate",
                "    return [Keep(record), *recover_candidate",
            ),
        ),
    ),
    Mutant(
        "a lease that drops PREPARED",
        "the destination throws a snapshot away that it has held for long",
        (
            (
                handoff,
                "    if record.phase is not Phase.FROZEN or record.offer != event.offer:",
                "    if record.phase is Phase.PREPARED:\n"
                '        return [Persist(replace(record, phase=Phase.ABSENT, offer=NO_EPOCH, snapshot=b""))]\n'
                "    if record.phase is not Phase.FROZEN or record.offer != event.offer:",
            ),
        ),
    ),
    Mutant(
        "tombstone deleted",
        "a task that moved on, or never came, is forgotten",
        (
            (handoff, 'phase=Phase.RELEASED, offer=NO_EPOCH, snapshot=b""', "phase=Phase.ABSENT, seen=NO_EPOCH"),
            (handoff, 'phase=Phase.ABSENT, offer=NO_EPOCH, snapshot=b""', "phase=Phase.ABSENT, seen=NO_EPOCH"),
        ),
    ),
    Mutant(
        "duplicate filter not moved",
        "what the task has heard is left out of the snapshot",
        ((snapshot, "    heard: dict[str, int] = {}", "    unheard: dict[str, int] = {}\n    heard = {}"),),
    ),
    Mutant(
        "acknowledged before checkpointed",
        "the acknowledgement is sent first, to be quick",
        (
            (
                handoff,
                "[Persist(replace(record, snapshot=event.snapshot)), *(Ack(packet) for packet in event.consumed)]",
                "[*(Ack(packet) for packet in event.consumed), Persist(replace(record, snapshot=event.snapshot))]",
            ),
        ),
    ),
    Mutant(
        "freeze not durable",
        "the last checkpoint is sent instead of what the task was when it stopped",
        ((handoff, "        snapshot=event.snapshot,\n        sequel=", "        sequel="),),
        Bounds(durability="lazy"),
    ),
    Mutant(
        "not stopped before the snapshot",
        "the task goes on while its snapshot travels",
        (
            (
                handoff,
                "*_transfer(record, 0, times), After(wait_s, give_up)",
                "Resume(record.epoch, 0, record.snapshot), *_transfer(record, 0, times)",
            ),
        ),
    ),
    Mutant(
        "record discarded on commit",
        "the source forgets the task once it has sent COMMIT",
        (
            (
                handoff,
                "                After(times.warn_s, InDoubt(record.offer, Phase.COMMITTED)),\n            ]\n",
                "                Persist(replace(record, phase=Phase.RELEASED, offer=NO_EPOCH)),\n            ]\n",
            ),
        ),
    ),
    Mutant(
        "a start in doubt",
        "a task that was given away, perhaps, is started because somebody wants it",
        (
            (
                handoff,
                "    if record.phase is not Phase.OWNER:\n        return [_decline(record)]\n    if volatile",
                "    if record.phase not in (Phase.OWNER, Phase.COMMITTED):\n"
                "        return [_decline(record)]\n    if volatile",
            ),
        ),
    ),
    Mutant(
        "doubt forgotten after a stale answer",
        "ACTIVATED of an older hand-off is believed",
        (
            (
                handoff,
                "record.phase is not Phase.COMMITTED or (record.peer, record.offer) != (peer, message.offer)",
                "record.phase is not Phase.COMMITTED or record.peer != peer",
            ),
        ),
        Bounds(offers=3),
    ),
    Mutant(
        "a failed write believed",
        "a source whose COMMITTED could not be written sends COMMIT all the same",
        (
            (
                handoff,
                "    if record.phase is Phase.OWNER and volatile.freezing:\n",
                "    if event.record.phase is Phase.COMMITTED:\n"
                "        return _commit(event.record, 0, times)\n"
                "    if record.phase is Phase.OWNER and volatile.freezing:\n",
            ),
        ),
        Bounds(faults=1),
    ),
    Mutant(
        "a checkpoint of a former start believed",
        "a checkpoint is taken whichever start of the task it comes from",
        ((handoff, "record.epoch == event.epoch and record.incarnation == event.incarnation", "True"),),
        Bounds(restarts=1, late=True),
    ),
)
"""All those of PROTOCOL that concern at-most-one, and, from "a start in doubt" on, our own."""
