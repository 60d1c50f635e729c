"""Broken variants of the rules, and of what surrounds them. The search must convict each of them."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Final

from register.edited import edited
from register.scenarios import LIARS, SUITE, Scenario
from register.search import Search
from register.world import Result

from pancakes.durable import rules


@dataclass(frozen=True)
class Mutant:
    """A broken variant.

    Attributes:
        name: what it does wrongly.
        found_in: a part of the title of the scenario that is searched first.
        edits: texts of the rules, each with the text in its place.
        flaw: what is broken outside the rules; see `Search`.
    """

    name: str
    found_in: str
    edits: tuple[tuple[str, str], ...] = ()
    flaw: str = ""

    def make(self) -> ModuleType:
        """Return the rules with the edits.

        Raises:
            LookupError: a text is not there exactly once.
        """
        if not self.edits:
            return rules
        variant = edited(rules, self.name, *self.edits)
        vars(variant)["RULES"] = {getattr(rules, it.__name__): rule for it, rule in vars(variant)["RULES"].items()}
        return variant

    def convict(self, limit: int = 700_000) -> tuple[str, Result]:
        """Search the scenarios until one convicts it; return the title of that scenario, and the result."""
        scenarios = sorted((*SUITE, *LIARS), key=lambda it: self.found_in not in it.title)
        variant, flaws = self.make(), frozenset({self.flaw} - {""})
        tried: Scenario = scenarios[0]
        for tried in scenarios:
            found = Search(tried, variant, flaws, limit).run()
            if found.verdict not in ("ok", "unfinished"):
                break
        return tried.title, found


def _edit(name: str, found_in: str, *edits: tuple[str, str]) -> Mutant:
    return Mutant(name, found_in, edits)


_STOP: Final = "return _write(place, wanted=event.wanted, heir=NOBODY, state=state)"
_MAY_ACT: Final = "register.clockless or memory.permit > 0"
_QUORUM: Final = "if not is_quorum(needed, {it.by for it in promises}):"
_OWNER_NEWS: Final = "if new.epoch <= register.epoch or register.wanted is Wanted.DISPUTED:"
_TAKES_BACK: Final = """        changes["since"] = no
        memory = memory._replace(permit=0, offered=False)"""
_PAUSED_BY_AN_OFFER: Final = "    if register.heir != NOBODY or register.wanted"
_UNNAMED: Final = "if not any(me in one for one in event.sets) and me not in register.members:"
_DISPUTED: Final = "return [Remember(memory._replace(permit=0)), Persist(paused)]"
_OFFERED: Final = "return [Remember(memory), Persist(new), Send(Accept(new.as_written(), 0, to))]"

MUTANTS: Final = (
    _edit(
        "a member promises before that is on disk",
        "move, letters",
        (
            "return [*effects, Send(Promise(event.epoch, me, new))]",
            "return [Send(Promise(event.epoch, me, new)), *effects]",
        ),
    ),
    _edit(
        "the owner offers the task before the heir is on disk",
        "move, letters",
        (_OFFERED, "return [Remember(memory), Send(Accept(new.as_written(), 0, to)), Persist(new)]"),
    ),
    _edit(
        "the heir asks for the promise before it has the register on disk",
        "move, letters",
        (
            "        effects += _ask_for_promises(place, held, NO_EPOCH, held.sets)",
            "        effects = [*_ask_for_promises(place, held, NO_EPOCH, held.sets), *effects]",
        ),
    ),
    _edit(
        "a new owner makes itself known before it has written that",
        "move, letters",
        (
            "return [Persist(own), Remember(Memory()), Send(Accept(own.as_written(), 0))]",
            "return [Send(Accept(own.as_written(), 0)), Persist(own), Remember(Memory())]",
        ),
    ),
    _edit(
        "an owner that offers the task promises it to any agent",
        "moves of three",
        ("(register.heir == taker and has_offer)", "(register.heir != NOBODY)"),
    ),
    _edit(
        "an owner promises the task to its heir also on an offer that was taken back",
        "there and back",
        ("(register.heir == taker and has_offer)", "event.held[0] == register.epoch"),
    ),
    _edit(
        "an owner that has given the task away takes it back",
        "move, letters",
        (
            "_write(place, heir=NOBODY) if place.writes and place.register.heir != NOBODY else []",
            "_write(place, heir=NOBODY) if place.register.owner == place.me and place.register.heir != NOBODY else []",
        ),
        ("    if register.promised > register.epoch:\n        return Desired", "    if False:\n        return Desired"),
    ),
    _edit(
        "a restarted owner continues without a write that takes the offer back",
        "move, letters",
        (
            "effects += _write(place._replace(memory=Memory(offered=True)), heir=NOBODY)",
            "effects.append(Persist(register._replace(heir=NOBODY)))",
        ),
    ),
    _edit(
        "an offer is taken back without a later write",
        "move, letters",
        (
            "return _write(place, heir=NOBODY) if place.writes and place.register.heir != NOBODY else []",
            "return [Persist(place.register._replace(heir=NOBODY))] if place.writes else []",
        ),
    ),
    _edit(
        "an heir acts as soon as it has the register",
        "move, letters",
        (
            "    if register.owner != me or register.wanted is Wanted.REMOVED:\n        return Desired.END",
            "    if register.heir == me and register.state is not None:\n        return Desired.RUN\n"
            "    if register.owner != me:\n        return Desired.END",
        ),
    ),
    _edit(
        "an heir takes a late offer under an epoch that it has passed",
        "a taker, letters",
        ("    if new.epoch < register.promised:\n        return [Send", "    if False:\n        return [Send"),
    ),
    _edit(
        "an agent that gave the task away forgets all of it",
        "move, letters",
        ("return [Persist(gone), Remember(Memory())]", "return [Persist(BLANK), Remember(Memory())]"),
    ),
    _edit(
        "a packet is acknowledged before its effect is on enough disks",
        "migration, a letter",
        (
            "    return _write(place, state=event.state)\n\n",
            "    return [*_write(place, state=event.state), Counts(place.register._replace(state=event.state))]\n\n",
        ),
    ),
    _edit(
        "a stop is answered before it is on enough disks",
        "stop, start, a taker",
        (
            _STOP,
            f"return [*{_STOP.removeprefix('return ')}, Counts(register._replace(wanted=event.wanted))]",
        ),
    ),
    _edit(
        "a stop is not written",
        "move, stop",
        (
            _STOP,
            "return [Remember(place.memory._replace(behind=event.wanted is Wanted.STOPPED)),"
            " Counts(register._replace(wanted=event.wanted))]",
        ),
    ),
    _edit(
        "a taker overlooks that the task was removed",
        "removed, a taker",
        ("key=lambda it: (it.stamp, it.state is not None)", "key=lambda it: (it.state is not None, it.stamp)"),
    ),
    _edit(
        "a taker does not take over that the task was stopped",
        "stop, start, a taker",
        ("0, NOBODY, newest.wanted, newest.state", "0, NOBODY, Wanted.RUNNING, newest.state"),
    ),
    _edit(
        "a task begins again under the first epoch",
        "begin again",
        ("return _own_alone(place, n + 1, event.state)", "return _own_alone(place, 0, event.state)"),
    ),
    _edit(
        "a member promises while the lease runs that it granted",
        "migration, given up",
        ("(not needs_no_lease and not place.lease.beat)", "not needs_no_lease"),
    ),
    _edit(
        "a restarted owner of a guarded task acts at once",
        "a taker, letters",
        (
            "        effects.append(Grant(Lease(register.promised, all_beats)))",
            "        effects += [Grant(Lease(register.promised, all_beats)), Remember(Memory(permit=99))]",
        ),
    ),
    _edit(
        "a restarted member promises at once",
        "a taker, two beats",
        ("        effects.append(Grant(Lease(register.promised, all_beats)))", "        pass"),
    ),
    _edit(
        "a member follows an owner below its promise",
        "two takers",
        (
            "    if new.epoch < register.promised:\n        return [Send",
            "    if new.epoch < register.epoch:\n        return [Send",
        ),
    ),
    _edit(
        "a member accepts a write before it is on disk",
        "migration, a letter",
        ("        effects = [Persist(held), Remember(Memory())]", "        effects = [Remember(Memory())]"),
    ),
    _edit(
        "a new owner acts on promises, without a lease",
        "two takers",
        ("return [Persist(own), Remember(Memory()), Send", "return [Persist(own), Remember(Memory(permit=99)), Send"),
    ),
    _edit("one promise is enough", "a taker, letters", (_QUORUM, "if not promises:")),
    _edit(
        "a taker continues from its own register, not from the newest",
        "a taker, letters",
        ("if register.stamp >= newest.stamp and register.state", "if register.state is not None and register.state"),
    ),
    _edit(
        "new members count at once",
        "a member replaced",
        ("sets=(register.sets[0], event.members)", "sets=(event.members,)"),
    ),
    _edit(
        "an owner that a stray promise has passed only asks for leases",
        "refusals",
        (
            "for a later one itself.\n    return _ask_for_promises(place, register, new.promised, register.sets)",
            "for a later one itself.\n    return []",
        ),
    ),
    _edit(
        "an owner that the members have passed keeps others out by the leases that it asks for",
        "removed, a taker",
        (
            "        return [Remember(memory._replace(behind=True)), *asks]\n    # A member",
            "        return asks\n    # A member",
        ),
    ),
    _edit(
        "the heir asks under another epoch after a crash",
        "move, letters",
        ("register.no if register.heir == place.me else place.draw", "place.draw"),
    ),
    _edit(
        "an owner needs no lease as it is a member itself",
        "a taker, letters",
        (_MAY_ACT, _MAY_ACT.replace("register.clockless", "me in register.members")),
    ),
    _edit(
        "an owner needs no lease while its members change",
        "a member replaced",
        (_MAY_ACT, f"len(register.sets) == 2 or {_MAY_ACT}"),
    ),
    _edit(
        "a member lets its register go at the news of a later owner",
        "refusals",
        (
            "if me in register.members and not register.unguarded and not (is_by_person and register.owner == me):",
            "if False:",
        ),
    ),
    _edit(
        "an owner leaves the members itself",
        "a former owner replaced",
        (" or place.me not in event.members:", ":"),
    ),
    _edit(
        "the new members decide before a quorum of both sets knows",
        "a member replaced",
        ("if len(register.sets) == 2 and written >= register.since:", "if len(register.sets) == 2:"),
    ),
    _edit(
        "leases count whatever write a member has",
        "migration, given up",
        ("for member, beat, no in answers if no >= register.since}", "for member, beat, no in answers}"),
    ),
    _edit(
        "an heir that is a member is told first, as a stranger is",
        "migration, given up",
        ("if register.unguarded or event.heir in register.members:", "if register.unguarded:"),
    ),
    _edit(
        "an owner that says goodbye acts on until its permit ends",
        "goodbye, two",
        (_PAUSED_BY_AN_OFFER, _PAUSED_BY_AN_OFFER.replace("!= NOBODY", "not in (NOBODY, ANYONE)")),
        ("memory = place.memory._replace(offered=True, permit=0)\n    return", "memory = place.memory\n    return"),
    ),
    _edit(
        "an owner that takes its offer back acts on under the old permit",
        "migration, given up",
        (_TAKES_BACK, "        memory = memory._replace(offered=False)"),
    ),
    _edit(
        "a member that has no register yet promises nothing",
        "a member",
        (_UNNAMED, "if me not in register.members:"),
    ),
    _edit(
        "an unguarded owner acts on beside a later one",
        "nobody notices",
        (_OWNER_NEWS, "if True:"),
    ),
    _edit(
        "an owner rests also for a lower epoch",
        "nobody notices",
        (_OWNER_NEWS, _OWNER_NEWS.replace("<=", "==")),
    ),
    _edit(
        "a person's word takes the next epoch, not one far above",
        "most members",
        ("register.promised.n) + MORE_THAN_MIGRATIONS", "register.promised.n) + 1"),
    ),
    _edit(
        "an owner that learns of a later one throws its state away",
        "wrong word",
        (_DISPUTED, "return _tombstone(register, new)"),
    ),
    _edit(
        "an agent follows any owner of a higher epoch",
        "liar: a stranger",
        ("    if new.epoch > register.promised and not (confirmed or is_free):", "    if False:"),
    ),
    _edit(
        "an owner rests for any claim of a higher epoch",
        "liar: a stranger, a move",
        ("        if not confirmed:\n            return [Ask(message)]", "        if False:\n            return []"),
    ),
    _edit(
        "an owner that gave the task away believes any agent that it is elsewhere",
        "liar: a stranger, a move",
        ("if confirmed or by == register.promised.minter else [Ask(message)]", ""),
    ),
    _edit(
        "an heir believes any agent that its offer is dead",
        "liar: a stranger, a move",
        ("        if not confirmed and by != register.owner:", "        if False:"),
    ),
    _edit(
        "a member promises the task to any agent",
        "liar: a stranger, a taker",
        (
            "    if not (confirmed or is_heir or taker in register.members or register.state is None):",
            "    if False:",
        ),
    ),
    Mutant("a permit counts from the answers, not from the request", "a taker, two beats", flaw="late count"),
    Mutant("a task acts until its timer is served, in a process that was paused", "two beats", flaw="gate"),
    Mutant("a lease ends before the permit that rests on it", "a taker, two beats", flaw="short lease"),
    Mutant("a task whose disk was lost begins without a question", "birthplace", flaw="begins unasked"),
    Mutant("an agent whose disk was lost has its old identity", "disk lost", flaw="lost votes"),
    Mutant("an owner on a copy of its disk continues as the original", "copy of the owner", flaw="copy owns"),
    Mutant("an agent that could not write acts on what it meant to write", "migration, given up", flaw="memory stays"),
)
