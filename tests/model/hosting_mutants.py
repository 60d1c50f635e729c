"""Broken variants of the rules that join a life with its hand-off, each of which the search must convict.

As in `model.mutants`, a variant is an edit of the product's own source: where that changes, either the edit still
applies, or `make` says which text is gone. Besides, each rule is left out as a whole.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from types import ModuleType
from typing import Any, Final

import msgspec
from model.hosting_rim import Step

from pancakes.hosting import machine, turn
from pancakes.hosting.hosting_event import HostingEvent


class HostingMutant(msgspec.Struct, frozen=True):
    """One broken variant.

    Attributes:
        story: what it does not do any more, or does wrongly.
        module: the module that is edited.
        old: text as it stands there, once.
        new: text instead.
    """

    story: str
    module: ModuleType
    old: str
    new: str

    def make(self) -> Step:
        """Returns the machine with the edit made.

        Raises:
            LookupError: the text does not stand in its module exactly once.
        """
        texts = {module: inspect.getsource(module) for module in (turn, machine)}
        count = texts[self.module].count(self.old)
        if count != 1:
            raise LookupError(f"the mutant {self.story!r} finds its text {count} times: {self.old}")
        texts[self.module] = texts[self.module].replace(self.old, self.new)
        made = {module: _module(module, text) for module, text in texts.items()}
        made[machine].Turn = made[turn].Turn  # type: ignore[attr-defined]
        step: Step = made[machine].step
        return step


def _module(original: ModuleType, text: str) -> ModuleType:
    module = ModuleType(original.__name__)
    exec(compile(text, f"<mutant of {original.__name__}>", "exec"), module.__dict__)
    return module


def _nothing(turn: Any, what: Any) -> None:
    """It means nothing."""


def _passes(turn: Any, what: Any) -> None:
    turn.do(what)


def without(kind: type, table: str, instead: Callable[[Any, Any], None]) -> Step:
    """Returns the machine with a rule replaced.

    Args:
        kind: the effect or event that the rule is for.
        table: the name of the table in which it stands.
        instead: the rule instead.
    """
    module = _module(machine, inspect.getsource(machine))
    setattr(module, table, {**getattr(module, table), kind: instead})
    step: Step = module.step
    return step


def left_out() -> dict[str, Step]:
    """Returns the machines in which one rule as a whole is left out, by what is left out."""
    steps: dict[str, Step] = {}
    for kind in machine.RULES:
        steps[f"{kind.__name__} means nothing"] = without(kind, "RULES", _nothing)
        if not issubclass(kind, HostingEvent):
            steps[f"{kind.__name__} only passes"] = without(kind, "RULES", _passes)
    for kind in machine.DECLINED:
        steps[f"that {kind.__name__} is declined means nothing"] = without(kind, "DECLINED", _nothing)
    return steps


def _in_machine(story: str, old: str, new: str) -> HostingMutant:
    return HostingMutant(story, machine, old, new)


def _in_turn(story: str, old: str, new: str) -> HostingMutant:
    return HostingMutant(story, turn, old, new)


MUTANTS: Final = (
    # Leave
    _in_machine(
        "a task that failed is started again by a new entry",
        "    if leave is Leave.ENTRY and effect.again and",
        "    if False and",
    ),
    _in_machine(
        "a restart that a person asks for goes without room", "effect.again and life.asker is None:", "effect.again:"
    ),
    _in_machine("what has leave asks for it", "    if leave is Leave.GRANTED:\n        return\n", ""),
    _in_machine(
        "a service that ends gives leave",
        "    if turn.at.closing:\n        turn.live",
        "    if False:\n        turn.live",
    ),
    _in_machine("a record found on disk gives no leave", "    elif leave is Leave.RECOVERED:\n", "    elif False:\n"),
    _in_machine("a start after a failure is a new entry", "    elif leave is Leave.AGAIN:\n", "    elif False:\n"),
    # Settle
    _in_machine(
        "what waits for leave is decided",
        "    if life.state is not State.ASKED and not standing.leaving:",
        "    if not standing.leaving:",
    ),
    _in_machine(
        "the end of what was given away decides a start", "State.ASKED and not standing.leaving:", "State.ASKED:"
    ),
    _in_machine(
        "what was refused is believed to run", "    refused = life.state is State.REFUSED or (", "    refused = ("
    ),
    _in_machine(
        "what was refused for good is believed to run",
        "life.state is State.REFUSED or (life.state is State.STOPPED and standing.begins)",
        "life.state is State.REFUSED",
    ),
    _in_machine(
        "what was refused is always wanted",
        "Ended(Wanted.RUNNING if life.wanted else Wanted.STOPPED)",
        "Ended(Wanted.RUNNING)",
    ),
    _in_machine(
        "what does not run is written down each time",
        "    if refused and standing.volatile.running and",
        "    if refused and",
    ),
    _in_machine("refusals pile up", " and ended not in standing.events[-1:]", ""),
    _in_machine("a start that is decided goes on", "    if standing.begins:\n        turn.done()\n", ""),
    # Rest
    _in_machine(
        "what was given away writes its rest",
        "    if turn.standing.leaving:\n        # What",
        "    if False:\n        # What",
    ),
    _in_machine(
        "what was given away is not at rest",
        "        turn.live(Written())\n        turn.do(Rested())\n    else:",
        "        turn.live(Written())\n    else:",
    ),
    _in_machine(
        "the end of a service stops its tasks for good", "    if turn.at.closing and life.wanted:", "    if False:"
    ),
    _in_machine(
        "the end of a service undoes a stop", "    if turn.at.closing and life.wanted:", "    if turn.at.closing:"
    ),
    _in_machine(
        "what is written down already is written",
        "not (standing.idle and begins_alike(",
        "not (False and begins_alike(",
    ),
    _in_machine("what waits to be written counts as written", "standing.idle and begins_alike(", "begins_alike("),
    _in_machine("a rest is not waited for", "        turn.change(rests=True)\n", "        turn.live(Written())\n"),
    _in_machine("a rest is not told", "    turn.do(Rested())\n    _place_free", "    _place_free"),
    _in_machine(
        "what comes back does not start once it rests",
        "    turn.do(Rested())\n    _place_free(turn, PlaceFree())\n",
        "    turn.do(Rested())\n",
    ),
    _in_machine(
        "a task that failed is stopped",
        "    if life.state is not State.FAILED:\n        return Wanted.STOPPED\n",
        "    return Wanted.STOPPED\n",
    ),
    _in_machine(
        "what is tried again is given up",
        "Wanted.FAILED if life.restarts.due_s is None else Wanted.RUNNING",
        "Wanted.FAILED",
    ),
    _in_machine(
        "what is given up is wanted",
        "Wanted.FAILED if life.restarts.due_s is None else Wanted.RUNNING",
        "Wanted.RUNNING",
    ),
    # Starting
    _in_machine(
        "a start overtakes an end",
        "    if any(isinstance(event, Ended) for event in turn.standing.events):",
        "    if False:",
    ),
    _in_machine("it starts without a place", "    elif life is None:\n        turn.do(OpenPlace(effect))\n", ""),
    _in_machine(
        "it starts beside its old actor",
        "    elif life.state in ACTOR:\n        # It came",
        "    elif False:\n        # It came",
    ),
    _in_machine(
        "the old actor is not told to end", '        turn.live(StopAsked(reason="it comes back"))', "        pass"
    ),
    _in_machine(
        "it is prepared and not started", "            turn.live(StartAsked(), Leave.GRANTED)", "            pass"
    ),
    _in_machine(
        "it is started twice",
        "        if life.state not in UNDECIDED:\n            turn.live",
        "        if True:\n            turn.live",
    ),
    _in_machine(
        "a start by the hand-off asks for leave", "turn.live(StartAsked(), Leave.GRANTED)", "turn.live(StartAsked())"
    ),
    _in_machine(
        "it is not known to begin",
        "        turn.change(begins=True, stands=None, unanswered=0)",
        "        turn.change(stands=None, unanswered=0)",
    ),
    _in_machine(
        "it stands still for its former actor", "begins=True, stands=None, unanswered=0", "begins=True, unanswered=0"
    ),
    _in_machine(
        "its former actor owes an answer", "begins=True, stands=None, unanswered=0", "begins=True, stands=None"
    ),
    _in_machine("it is not prepared", "        turn.do(Prepare(effect))\n", "        pass\n"),
    _in_machine(
        "a start that has begun begins anew",
        "isinstance(waits, StartTask) and not turn.standing.begins:",
        "isinstance(waits, StartTask):",
    ),
    _in_machine(
        "no place, and nothing is told", "    turn.do(Decided(event.reason))\n    turn.done()", "    turn.done()"
    ),
    _in_machine(
        "no place, and it waits for ever",
        "    turn.do(Decided(event.reason))\n    turn.done()",
        "    turn.do(Decided(event.reason))",
    ),
    # Standing still
    _in_machine(
        "what does not run is to stand still",
        "    if turn.life is not None and turn.life.state is State.RUNNING:\n        turn.change(stands",
        "    if True:\n        turn.change(stands",
    ),
    _in_machine(
        "that it cannot stand still is not said",
        '        turn.feed(FreezeFailed(effect.offer, "it does not run"))',
        "        pass",
    ),
    _in_machine("it is forgotten that it is to stand still", "stands=effect.offer, unanswered", "unanswered"),
    _in_machine("its answers are not counted", ", unanswered=turn.standing.unanswered + 1)", ")"),
    _in_machine(
        "an answer to a former offer counts",
        "    if unanswered:\n        return  # it was told so again meanwhile, and answers that\n",
        "",
    ),
    _in_machine("any answer counts", "    waits = standing.stands == event.offer\n", "    waits = True\n"),
    _in_machine("an answer counts for ever", "    if waits:\n        turn.change(stands=None)\n    runs", "    runs"),
    _in_machine(
        "a task that ends is handed over", "    if event.carried is None or not runs:", "    if event.carried is None:"
    ),
    _in_machine(
        "that it cannot stand still is not passed on",
        "        if waits:\n            turn.feed(FreezeFailed(event.offer, event.reason or",
        "        if False:\n            turn.feed(FreezeFailed(event.offer, event.reason or",
    ),
    _in_machine(
        "it is taken down for a hand-off that is over",
        "    elif waits and standing.volatile.freezing:",
        "    elif waits:",
    ),
    _in_machine("it stands still for ever", "        turn.do(LetGoOn())", "        pass"),
    _in_machine(
        "any deadline counts",
        "    if turn.standing.stands == event.offer:\n        turn.change(stands=None)\n        turn.feed",
        "    if True:\n        turn.change(stands=None)\n        turn.feed",
    ),
    _in_machine(
        "a deadline passes and it may stand still after all",
        '        turn.change(stands=None)\n        turn.feed(FreezeFailed(event.offer, "it is stuck"))',
        '        turn.feed(FreezeFailed(event.offer, "it is stuck"))',
    ),
    _in_machine(
        "a deadline means nothing", '        turn.feed(FreezeFailed(event.offer, "it is stuck"))', "        pass"
    ),
    # Going on and leaving
    _in_machine(
        "what failed while it stood still stays so", "        turn.live(StartAsked(), Leave.AGAIN)", "        pass"
    ),
    _in_machine(
        "what stood still is started beside itself",
        "turn.life.state not in ACTOR | UNDECIDED:",
        "turn.life.state not in UNDECIDED:",
    ),
    _in_machine(
        "what waits for leave is started twice",
        "turn.life.state not in ACTOR | UNDECIDED:",
        "turn.life.state not in ACTOR:",
    ),
    _in_machine("it goes on by a new entry", "turn.live(StartAsked(), Leave.AGAIN)", "turn.live(StartAsked())"),
    _in_machine("what was given away is not dropped", "    turn.do(Drop(ends))\n", ""),
    _in_machine("what was given away ends already", "    turn.do(Drop(ends))\n", "    turn.do(Drop(False))\n"),
    _in_machine(
        "what was given away keeps its place",
        "        turn.change(leaving=True)\n        turn.live(StopAsked(reason=f",
        "        turn.live(StopAsked(reason=f",
    ),
    _in_machine(
        "what was given away goes on",
        '        turn.live(StopAsked(reason=f"handed over to {record.peer}" if ends else "it is elsewhere"))',
        "        pass",
    ),
    _in_machine(
        "a task that failed and was given away keeps its place",
        "    if turn.life is not None and turn.life.state not in ACTOR:\n        turn.change(leaving=True)",
        "    if False:\n        turn.change(leaving=True)",
    ),
    _in_machine(
        "what is elsewhere is not stopped",
        '        turn.live(StopAsked(reason="it is elsewhere"))\n    turn.change(to_conclude=2)',
        "    turn.change(to_conclude=2)",
    ),
    _in_machine("a hand-over is concluded by its first part", "to_conclude=2", "to_conclude=1"),
    _in_machine(
        "a hand-over is concluded by each part",
        "    if not left:\n        turn.feed(Concluded())",
        "    turn.feed(Concluded())",
    ),
    # Declined
    _in_machine(
        "actuators of what is declined are kept",
        "    if turn.standing.record.phase is not Phase.PREPARED:\n        turn.do(Unreserve())\n    if turn.life",
        "    if turn.life",
    ),
    _in_machine(
        "a start that is declined is waited for",
        "    if turn.life is not None and turn.life.state in UNDECIDED:\n        turn.live(LeaveRefused(effect",
        "    if False:\n        turn.live(LeaveRefused(effect",
    ),
    _in_machine(
        "a start that is declined is tried again",
        "turn.live(LeaveRefused(effect.reason, for_good=True))",
        "turn.live(LeaveRefused(effect.reason))",
    ),
    _in_machine("what cannot be forgotten is forgotten", "    turn.do(Lasts(effect.reason))", "    turn.do(Lasts())"),
    # The service begins
    _in_machine("what is born is recovered", "    if unborn(record) or (event.fresh", "    if (event.fresh"),
    _in_machine("anew means as before", " or (event.fresh and record.phase is Phase.OWNER):", ":"),
    _in_machine("what is elsewhere begins anew", "(event.fresh and record.phase is Phase.OWNER)", "event.fresh"),
    _in_machine(
        "a frozen task stays frozen",
        "    elif record.phase in (Phase.OWNER, Phase.FROZEN):\n",
        "    elif record.phase is Phase.OWNER:\n",
    ),
    _in_machine(
        "its service waits for what is elsewhere",
        "        _take_up(turn, TakeUp())\n        turn.do(Settle())",
        "        _take_up(turn, TakeUp())",
    ),
    _in_machine(
        "a hand-off found on disk does not go on",
        "        _take_up(turn, TakeUp())\n        turn.do(Settle())",
        "        turn.do(Settle())",
    ),
    # Room
    _in_machine(
        "room is found for what does not ask",
        "    if turn.life is None or turn.life.state not in UNDECIDED:\n        return\n",
        "",
    ),
    _in_machine(
        "there is always room",
        "    if event.reason:\n        turn.live(LeaveRefused(event.reason, event.for_good))\n    elif unborn",
        "    if unborn",
    ),
    _in_machine(
        "what was lost is tried again and again",
        "LeaveRefused(event.reason, event.for_good)",
        "LeaveRefused(event.reason)",
    ),
    _in_machine("it is not born", "    elif unborn(record):\n        turn.feed(Born(event.snapshot))\n", ""),
    _in_machine(
        "what it carries is not written down", "        turn.feed(Ended(Wanted.STOPPED, event.snapshot))\n", ""
    ),
    _in_machine(
        "what it carries is written down, and it does not start",
        "        turn.feed(Ended(Wanted.STOPPED, event.snapshot))\n        turn.feed(Start())\n",
        "        turn.feed(Ended(Wanted.STOPPED, event.snapshot))\n",
    ),
    _in_machine(
        "what is elsewhere is written down here",
        "    elif event.snapshot and record.phase is Phase.OWNER:",
        "    elif event.snapshot:",
    ),
    # The disk
    _in_machine(
        "the record is not known",
        'turn.change(waits=None, record=waits.record, trouble="")',
        'turn.change(waits=None, trouble="")',
    ),
    _in_machine(
        "what was decided goes on after a fault",
        "trouble=event.reason, effects=tuple(effects))",
        "trouble=event.reason)",
    ),
    _in_machine("an adoption is not answered", "    if standing.record.phase in DOUBT and not", "    if False and not"),
    _in_machine(
        "an adoption that waits is answered",
        " and not any(isinstance(later, Adopt) for later in standing.events):",
        ":",
    ),
    _in_machine(
        "what waits for the disk keeps its service waiting",
        "    if starts:\n        turn.live(PutOff(event.reason))\n",
        "",
    ),
    _in_machine(
        "actuators are kept for what is not on disk",
        "    if record.phase is not Phase.PREPARED and not starts:\n        turn.do(Unreserve())\n",
        "",
    ),
    # The turn
    _in_turn("a rest is told before it is on disk", "            if self.standing.rests:\n", "            if False:\n"),
    _in_turn("a rest lasts for ever", "                self.change(rests=False)\n", ""),
    _in_turn("that it lasts is not told", "                self.do(Lasts(self.why_not))\n", "                pass\n"),
    _in_turn("its place is not cleared", "            self.do(Vacate())\n", "            pass\n"),
    _in_turn("its place is cleared at once", "self.life is not None and self.life.at_rest:", "self.life is not None:"),
    _in_turn("its place is cleared twice", "            self.change(leaving=False)\n", ""),
    _in_turn("effects do not wait", "        while self.standing.waits is None:\n", "        while True:\n"),
    _in_turn(
        "a start that is decided is under way", "self.change(waits=None, begins=False)", "self.change(waits=None)"
    ),
    _in_turn(
        "actuators are kept after a start",
        "        self.change(waits=None, begins=False)\n        self.do(Unreserve())\n",
        "        self.change(waits=None, begins=False)\n",
    ),
)

UNPROVEN: Final = frozenset(
    (
        "that Born is declined means nothing",
        "that Forget is declined means nothing",
        "what waits for leave is decided",
        "the end of a service stops its tasks for good",
        "what is written down already is written",
        "what waits to be written counts as written",
        "what comes back does not start once it rests",
        "a task that failed is stopped",
        "what is tried again is given up",
        "the old actor is not told to end",
        "it stands still for its former actor",
        "its former actor owes an answer",
        "a start that has begun begins anew",
        "no place, and nothing is told",
        "what does not run is to stand still",
        "that it cannot stand still is not said",
        "any answer counts",
        "an answer counts for ever",
        "that it cannot stand still is not passed on",
        "it is taken down for a hand-off that is over",
        "any deadline counts",
        "a deadline passes and it may stand still after all",
        "what failed while it stood still stays so",
        "what stood still is started beside itself",
        "what waits for leave is started twice",
        "what was given away ends already",
        "what was given away goes on",
        "what is elsewhere is not stopped",
        "a start that is declined is tried again",
        "what cannot be forgotten is forgotten",
        "what is born is recovered",
        "anew means as before",
        "what is elsewhere begins anew",
        "a frozen task stays frozen",
        "room is found for what does not ask",
        "it is not born",
        "what is elsewhere is written down here",
        "what waits for the disk keeps its service waiting",
        "its place is cleared twice",
    )
)
"""The variants of which no scenario is known yet that convicts them."""
