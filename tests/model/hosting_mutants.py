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

from pancakes.hosting import machine
from pancakes.hosting.hosting_event import HostingEvent


class HostingMutant(msgspec.Struct, frozen=True):
    """One broken variant.

    Attributes:
        story: what it does not do any more, or does wrongly.
        old: text as it stands in the machine, once.
        new: text instead.
    """

    story: str
    old: str
    new: str

    def make(self) -> Step:
        """Returns the machine with the edit made.

        Raises:
            LookupError: the text does not stand in the machine exactly once.
        """
        text = inspect.getsource(machine)
        count = text.count(self.old)
        if count != 1:
            raise LookupError(f"the mutant {self.story!r} finds its text {count} times: {self.old}")
        step: Step = _machine(text.replace(self.old, self.new)).handle
        return step


def _machine(text: str) -> ModuleType:
    module = ModuleType(machine.__name__)
    exec(compile(text, f"<mutant of {machine.__name__}>", "exec"), module.__dict__)
    return module


def _nothing(step: Any, what: Any) -> None:
    """It means nothing."""


def _passes(step: Any, what: Any) -> None:
    step.do(what)


def without(kind: type, table: str, instead: Callable[[Any, Any], None]) -> Step:
    """Returns the machine with a rule replaced.

    Args:
        kind: the effect or event that the rule is for.
        table: the name of the table in which it stands.
        instead: the rule instead.
    """
    module = _machine(inspect.getsource(machine))
    setattr(module, table, {**getattr(module, table), kind: instead})
    step: Step = module.handle
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


MUTANTS: Final = (
    # Leave
    HostingMutant(
        "a task that failed is started again by a new entry",
        "    if leave is Leave.ENTRY and effect.again and",
        "    if False and",
    ),
    HostingMutant(
        "a restart that a person asks for goes without room", "effect.again and life.asker is None:", "effect.again:"
    ),
    HostingMutant("what has leave asks for it", "    if leave is Leave.GRANTED:\n        return\n", ""),
    HostingMutant(
        "a service that ends gives leave",
        "    if step.at.closing:\n        step.live",
        "    if False:\n        step.live",
    ),
    HostingMutant("a record found on disk gives no leave", "    elif leave is Leave.RECOVERED:\n", "    elif False:\n"),
    HostingMutant("a start after a failure is a new entry", "    elif leave is Leave.AGAIN:\n", "    elif False:\n"),
    # Settle
    HostingMutant(
        "what waits for leave is decided",
        "    if life.state is not State.ASKED and not standing.leaving:",
        "    if not standing.leaving:",
    ),
    HostingMutant(
        "the end of what was given away decides a start", "State.ASKED and not standing.leaving:", "State.ASKED:"
    ),
    HostingMutant(
        "what was refused is believed to run", "    refused = life.state is State.REFUSED or (", "    refused = ("
    ),
    HostingMutant(
        "what was refused for good is believed to run",
        "life.state is State.REFUSED or (life.state is State.STOPPED and standing.begins)",
        "life.state is State.REFUSED",
    ),
    HostingMutant(
        "what was refused is always wanted",
        "handoff_event.Ended(Wanted.RUNNING if life.wanted else Wanted.STOPPED)",
        "handoff_event.Ended(Wanted.RUNNING)",
    ),
    HostingMutant(
        "what does not run is written down each time",
        "    if refused and standing.volatile.running and",
        "    if refused and",
    ),
    HostingMutant("refusals pile up", " and ended not in standing.events[-1:]", ""),
    HostingMutant("a start that is decided goes on", "    if standing.begins:\n        step.done()\n", ""),
    # Rest
    HostingMutant(
        "what was given away writes its rest",
        "    if step.standing.leaving:\n        # What",
        "    if False:\n        # What",
    ),
    HostingMutant(
        "what was given away is not at rest",
        "        step.live(life_event.Written())\n        step.do(hosting_effect.Rested())\n    else:",
        "        step.live(life_event.Written())\n    else:",
    ),
    HostingMutant(
        "the end of a service stops its tasks for good", "    if step.at.closing and life.wanted:", "    if False:"
    ),
    HostingMutant(
        "the end of a service undoes a stop", "    if step.at.closing and life.wanted:", "    if step.at.closing:"
    ),
    HostingMutant(
        "what is written down already is written",
        "not (idle(standing) and begins_alike(",
        "not (False and begins_alike(",
    ),
    HostingMutant("what waits to be written counts as written", "idle(standing) and begins_alike(", "begins_alike("),
    HostingMutant(
        "a rest is not waited for", "        step.change(rests=True)\n", "        step.live(life_event.Written())\n"
    ),
    HostingMutant("a rest is not told", "    step.do(hosting_effect.Rested())\n    _place_free", "    _place_free"),
    HostingMutant(
        "what comes back does not start once it rests",
        "    step.do(hosting_effect.Rested())\n    _place_free(step, hosting_event.PlaceFree())\n",
        "    step.do(hosting_effect.Rested())\n",
    ),
    HostingMutant(
        "a task that failed is stopped",
        "    if life.state is not State.FAILED:\n        return Wanted.STOPPED\n",
        "    return Wanted.STOPPED\n",
    ),
    HostingMutant(
        "what is tried again is given up",
        "Wanted.FAILED if life.restarts.due_s is None else Wanted.RUNNING",
        "Wanted.FAILED",
    ),
    HostingMutant(
        "what is given up is wanted",
        "Wanted.FAILED if life.restarts.due_s is None else Wanted.RUNNING",
        "Wanted.RUNNING",
    ),
    # Starting
    HostingMutant(
        "a start overtakes an end",
        "    if any(isinstance(event, handoff_event.Ended) for event in step.standing.events):",
        "    if False:",
    ),
    HostingMutant(
        "it starts without a place", "    elif life is None:\n        step.do(hosting_effect.OpenPlace(effect))\n", ""
    ),
    HostingMutant(
        "it starts beside its old actor",
        "    elif life.state in ACTOR:\n        # It came",
        "    elif False:\n        # It came",
    ),
    HostingMutant(
        "the old actor is not told to end",
        '        step.live(life_event.StopAsked(reason="it comes back"))',
        "        pass",
    ),
    HostingMutant(
        "it is prepared and not started",
        "            step.live(life_event.StartAsked(), Leave.GRANTED)",
        "            pass",
    ),
    HostingMutant(
        "it is started twice",
        "        if life.state not in UNDECIDED:\n            step.live",
        "        if True:\n            step.live",
    ),
    HostingMutant(
        "a start by the hand-off asks for leave",
        "step.live(life_event.StartAsked(), Leave.GRANTED)",
        "step.live(life_event.StartAsked())",
    ),
    HostingMutant(
        "it is not known to begin",
        "        step.change(begins=True, stands=None, unanswered=0)",
        "        step.change(stands=None, unanswered=0)",
    ),
    HostingMutant(
        "it stands still for its former actor", "begins=True, stands=None, unanswered=0", "begins=True, unanswered=0"
    ),
    HostingMutant(
        "its former actor owes an answer", "begins=True, stands=None, unanswered=0", "begins=True, stands=None"
    ),
    HostingMutant("it is not prepared", "        step.do(hosting_effect.Prepare(effect))\n", "        pass\n"),
    HostingMutant(
        "a start that has begun begins anew",
        "isinstance(waits, handoff_effect.StartTask) and not step.standing.begins:",
        "isinstance(waits, handoff_effect.StartTask):",
    ),
    HostingMutant(
        "no place, and nothing is told",
        "    step.do(hosting_effect.Decided(event.reason))\n    step.done()",
        "    step.done()",
    ),
    HostingMutant(
        "no place, and it waits for ever",
        "    step.do(hosting_effect.Decided(event.reason))\n    step.done()",
        "    step.do(hosting_effect.Decided(event.reason))",
    ),
    # Standing still
    HostingMutant(
        "what does not run is to stand still",
        "    if step.life is not None and step.life.state is State.RUNNING:\n        step.change(stands",
        "    if True:\n        step.change(stands",
    ),
    HostingMutant(
        "that it cannot stand still is not said",
        '        step.feed(handoff_event.FreezeFailed(effect.offer, "it does not run"))',
        "        pass",
    ),
    HostingMutant("it is forgotten that it is to stand still", "stands=effect.offer, unanswered", "unanswered"),
    HostingMutant("its answers are not counted", ", unanswered=step.standing.unanswered + 1)", ")"),
    HostingMutant(
        "an answer to a former offer counts",
        "    if unanswered:\n        return  # it was told so again meanwhile, and answers that\n",
        "",
    ),
    HostingMutant("any answer counts", "    waits = standing.stands == event.offer\n", "    waits = True\n"),
    HostingMutant("an answer counts for ever", "    if waits:\n        step.change(stands=None)\n    runs", "    runs"),
    HostingMutant(
        "a task that ends is handed over", "    if event.carried is None or not runs:", "    if event.carried is None:"
    ),
    HostingMutant(
        "that it cannot stand still is not passed on",
        "        if waits:\n            step.feed(handoff_event.FreezeFailed(event.offer, event.reason or",
        "        if False:\n            step.feed(handoff_event.FreezeFailed(event.offer, event.reason or",
    ),
    HostingMutant(
        "it is taken down for a hand-off that is over",
        "    elif waits and standing.volatile.freezing:",
        "    elif waits:",
    ),
    HostingMutant("it stands still for ever", "        step.do(hosting_effect.LetGoOn())", "        pass"),
    HostingMutant(
        "any deadline counts",
        "    if step.standing.stands == event.offer:\n        step.change(stands=None)\n        step.feed",
        "    if True:\n        step.change(stands=None)\n        step.feed",
    ),
    HostingMutant(
        "a deadline passes and it may stand still after all",
        '        step.change(stands=None)\n        step.feed(handoff_event.FreezeFailed(event.offer, "it is stuck"))',
        '        step.feed(handoff_event.FreezeFailed(event.offer, "it is stuck"))',
    ),
    HostingMutant(
        "a deadline means nothing",
        '        step.feed(handoff_event.FreezeFailed(event.offer, "it is stuck"))',
        "        pass",
    ),
    # Going on and leaving
    HostingMutant(
        "what failed while it stood still stays so",
        "        step.live(life_event.StartAsked(), Leave.AGAIN)",
        "        pass",
    ),
    HostingMutant(
        "what stood still is started beside itself",
        "step.life.state not in ACTOR | UNDECIDED:",
        "step.life.state not in UNDECIDED:",
    ),
    HostingMutant(
        "what waits for leave is started twice",
        "step.life.state not in ACTOR | UNDECIDED:",
        "step.life.state not in ACTOR:",
    ),
    HostingMutant(
        "it goes on by a new entry",
        "step.live(life_event.StartAsked(), Leave.AGAIN)",
        "step.live(life_event.StartAsked())",
    ),
    HostingMutant("what was given away is not dropped", "    step.do(hosting_effect.Drop(ends))\n", ""),
    HostingMutant(
        "what was given away ends already",
        "    step.do(hosting_effect.Drop(ends))\n",
        "    step.do(hosting_effect.Drop(False))\n",
    ),
    HostingMutant(
        "what was given away keeps its place",
        "        step.change(leaving=True)\n        step.live(life_event.StopAsked(reason=f",
        "        step.live(life_event.StopAsked(reason=f",
    ),
    HostingMutant(
        "what was given away goes on",
        'step.live(life_event.StopAsked(reason=f"handed over to {record.peer}" if ends else "it is elsewhere"))',
        "pass",
    ),
    HostingMutant(
        "a task that failed and was given away keeps its place",
        "    if step.life is not None and step.life.state not in ACTOR:\n        step.change(leaving=True)",
        "    if False:\n        step.change(leaving=True)",
    ),
    HostingMutant(
        "what is elsewhere is not stopped",
        '        step.live(life_event.StopAsked(reason="it is elsewhere"))\n    step.change(to_conclude=2)',
        "    step.change(to_conclude=2)",
    ),
    HostingMutant("a hand-over is concluded by its first part", "to_conclude=2", "to_conclude=1"),
    HostingMutant(
        "a hand-over is concluded by each part",
        "    if not left:\n        step.feed(handoff_event.Concluded())",
        "    step.feed(handoff_event.Concluded())",
    ),
    # Declined
    HostingMutant(
        "actuators of what is declined are kept",
        "    if step.standing.record.phase is not Phase.PREPARED:\n        step.do(hosting_effect.Unreserve())\n",
        "",
    ),
    HostingMutant(
        "a start that is declined is waited for",
        "        step.live(life_event.LeaveRefused(effect.reason, for_good=True))",
        "        pass",
    ),
    HostingMutant(
        "a start that is declined is tried again",
        "step.live(life_event.LeaveRefused(effect.reason, for_good=True))",
        "step.live(life_event.LeaveRefused(effect.reason))",
    ),
    HostingMutant(
        "what cannot be forgotten is forgotten",
        "    step.do(hosting_effect.Lasts(effect.reason))",
        "    step.do(hosting_effect.Lasts())",
    ),
    # The service begins
    HostingMutant("what is born is recovered", "    if record.unborn or (event.fresh", "    if (event.fresh"),
    HostingMutant("anew means as before", " or (event.fresh and record.phase is Phase.OWNER):", ":"),
    HostingMutant("what is elsewhere begins anew", "(event.fresh and record.phase is Phase.OWNER)", "event.fresh"),
    HostingMutant(
        "a frozen task stays frozen",
        "    elif record.phase in (Phase.OWNER, Phase.FROZEN):\n",
        "    elif record.phase is Phase.OWNER:\n",
    ),
    HostingMutant(
        "its service waits for what is elsewhere",
        "        _take_up(step, hosting_event.TakeUp())\n        step.do(life_effect.Settle())",
        "        _take_up(step, hosting_event.TakeUp())",
    ),
    HostingMutant(
        "a hand-off found on disk does not go on",
        "        _take_up(step, hosting_event.TakeUp())\n        step.do(life_effect.Settle())",
        "        step.do(life_effect.Settle())",
    ),
    # Room
    HostingMutant(
        "room is found for what does not ask",
        "    if step.life is None or step.life.state not in UNDECIDED:\n        return\n",
        "",
    ),
    HostingMutant(
        "there is always room",
        "    if event.reason:\n",
        "    if False:\n",
    ),
    HostingMutant(
        "what was lost is tried again and again",
        "life_event.LeaveRefused(event.reason, event.for_good)",
        "life_event.LeaveRefused(event.reason)",
    ),
    HostingMutant(
        "it is not born", "    elif record.unborn:\n        step.feed(handoff_event.Born(event.snapshot))\n", ""
    ),
    HostingMutant(
        "what it carries is not written down",
        "        step.feed(handoff_event.Ended(Wanted.STOPPED, event.snapshot))\n",
        "",
    ),
    HostingMutant(
        "what it carries is written down, and it does not start",
        "        step.feed(handoff_event.RunAsked())\n",
        "",
    ),
    HostingMutant(
        "what is elsewhere is written down here",
        "    elif event.snapshot and record.phase is Phase.OWNER:",
        "    elif event.snapshot:",
    ),
    # The disk
    HostingMutant(
        "the record is not known",
        'step.change(waits=None, record=waits.record, trouble="")',
        'step.change(waits=None, trouble="")',
    ),
    HostingMutant(
        "what was decided goes on after a fault",
        "trouble=event.reason, effects=tuple(effects))",
        "trouble=event.reason)",
    ),
    HostingMutant(
        "an adoption is not answered", "    if standing.record.phase in DOUBT and not", "    if False and not"
    ),
    HostingMutant(
        "an adoption that waits is answered",
        " and not adopted_later:",
        ":",
    ),
    HostingMutant(
        "what waits for the disk keeps its service waiting",
        "    if starts:\n        step.live(life_event.PutOff(event.reason))\n",
        "",
    ),
    HostingMutant(
        "actuators are kept for what is not on disk",
        "    if record.phase is not Phase.PREPARED and not starts:\n        step.do(hosting_effect.Unreserve())\n",
        "",
    ),
    # The turn
    HostingMutant(
        "a rest is told before it is on disk", "            if self.standing.rests:\n", "            if False:\n"
    ),
    HostingMutant("a rest lasts for ever", "                self.change(rests=False)\n", ""),
    HostingMutant(
        "that it lasts is not told",
        "                self.do(hosting_effect.Lasts(self.why_not))\n",
        "                pass\n",
    ),
    HostingMutant("its place is not cleared", "            self.do(hosting_effect.Vacate())\n", "            pass\n"),
    HostingMutant(
        "its place is cleared at once", "self.life is not None and self.life.at_rest:", "self.life is not None:"
    ),
    HostingMutant("its place is cleared twice", "            self.change(leaving=False)\n", ""),
    HostingMutant("effects do not wait", "        while self.standing.waits is None:\n", "        while True:\n"),
    HostingMutant(
        "a start that is decided is under way", "self.change(waits=None, begins=False)", "self.change(waits=None)"
    ),
    HostingMutant(
        "actuators are kept after a start",
        "        self.change(waits=None, begins=False)\n        self.do(hosting_effect.Unreserve())\n",
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
