"""Broken variants of the rules that join a life with its hand-off, each of which the search must convict.

As in `model.mutants`, a variant is an edit of the product's own source: where that changes, either the edit still
applies, or `make` says which text is gone. Besides, each rule is left out as a whole. Not listed is that a task whose
service ends is not written down where nothing of it is new: that saves time, and changes nothing else.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Final

from model.hosting_dispute_mutants import DISPUTES
from model.hosting_mutant import HostingMutant, edited_machine
from model.hosting_rim import Step

from pancakes.durable import state_machine
from pancakes.durable.state_machine import HostingEvent


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
    module = edited_machine(inspect.getsource(state_machine))
    setattr(module, table, {**getattr(module, table), kind: instead})
    step: Step = module.handle
    return step


def left_out() -> dict[str, tuple[type, str, Callable[[Any, Any], None]]]:
    """Returns the variants in which one rule as a whole is left out, as arguments of `without`, by their stories."""
    variants: dict[str, tuple[type, str, Callable[[Any, Any], None]]] = {}
    for kind in state_machine.RULES:
        variants[f"{kind.__name__} means nothing"] = kind, "RULES", _nothing
        if not issubclass(kind, HostingEvent):
            variants[f"{kind.__name__} only passes"] = kind, "RULES", _passes
    for kind in state_machine.DECLINED:
        variants[f"that {kind.__name__} is declined means nothing"] = kind, "DECLINED", _nothing
    return variants


def stories() -> list[str]:
    """Returns the stories of all broken variants."""
    return [*left_out(), *(mutant.story for mutant in MUTANTS)]


def make(story: str) -> Step:
    """Returns a broken variant of the machine.

    Raises:
        LookupError: its edit does not match the source exactly once, or there is no such variant.
    """
    rule = left_out().get(story)
    if rule is not None:
        return without(*rule)
    for mutant in MUTANTS:
        if mutant.story == story:
            return mutant.make()
    raise LookupError(f"there is no variant {story!r}")


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
    HostingMutant("refusals pile up", " and ended not in last_said", ""),
    HostingMutant("a start that is decided goes on", "    if standing.begins:\n        step.done()\n", ""),
    # Rest
    HostingMutant(
        "what was given away writes its rest",
        "    if step.standing.leaving:\n        # What",
        "    if False:\n        # What",
    ),
    HostingMutant(
        "what was given away is not at rest",
        "        step.live(lifecycle.Written())\n        step.do(Rested())\n    else:",
        "        step.live(lifecycle.Written())\n    else:",
    ),
    HostingMutant(
        "a rest is not waited for", "        step.change(rests=True)\n", "        step.live(lifecycle.Written())\n"
    ),
    HostingMutant(
        "a start overtakes an end",
        "    if any(isinstance(event, handoff_event.Ended) for event in step.standing.events):",
        "    if False:",
    ),
    HostingMutant("it starts without a place", "    elif life is None:\n        step.do(OpenPlace(effect))\n", ""),
    HostingMutant(
        "it is prepared and not started",
        "            step.live(lifecycle.StartAsked(), Leave.GRANTED)",
        "            pass",
    ),
    HostingMutant(
        "it is started twice",
        "        if life.state not in UNDECIDED:\n            step.live",
        "        if True:\n            step.live",
    ),
    HostingMutant(
        "a start by the hand-off asks for leave",
        "step.live(lifecycle.StartAsked(), Leave.GRANTED)",
        "step.live(lifecycle.StartAsked())",
    ),
    HostingMutant("it is not prepared", "        step.do(Prepare(effect))\n", "        pass\n"),
    HostingMutant(
        "no place, and nothing is told",
        "    step.do(Decided(event.reason))\n    step.done()",
        "    step.done()",
    ),
    HostingMutant(
        "no place, and it waits for ever",
        "    step.do(Decided(event.reason))\n    step.done()",
        "    step.do(Decided(event.reason))",
    ),
    # Standing still
    HostingMutant(
        "that it cannot stand still is not said",
        '        step.feed(handoff_event.FreezeFailed(effect.offer, "it does not run"))',
        "        pass",
    ),
    HostingMutant(
        "an answer to a former offer counts",
        "    if unanswered:\n        return  # it was told so again meanwhile, and answers that\n",
        "",
    ),
    HostingMutant(
        "a task that ends is handed over", "    if event.carried is None or not runs:", "    if event.carried is None:"
    ),
    HostingMutant("it stands still for ever", "        step.do(LetGoOn())", "        pass"),
    # Going on and leaving
    HostingMutant(
        "what failed while it stood still stays so",
        "        step.live(lifecycle.StartAsked(), Leave.AGAIN)",
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
        "step.live(lifecycle.StartAsked(), Leave.AGAIN)",
        "step.live(lifecycle.StartAsked())",
    ),
    HostingMutant("what was given away is not dropped", "    step.do(Drop(ends))\n", ""),
    HostingMutant(
        "what was given away ends already",
        "    step.do(Drop(ends))\n",
        "    step.do(Drop(False))\n",
    ),
    HostingMutant(
        "what was given away keeps its place",
        "    step.change(leaving=life is not None)\n",
        "",
    ),
    HostingMutant(
        "what was given away goes on",
        "step.live(lifecycle.StopAsked(reason=reason))",
        "pass",
    ),
    HostingMutant(
        "a hand-over is concluded by each part",
        "    if not left:\n        step.feed(handoff_event.Concluded())",
        "    step.feed(handoff_event.Concluded())",
    ),
    # Declined
    HostingMutant(
        "actuators of what is declined are kept",
        "    step.unreserve()\n    if step.life",
        "    if step.life",
    ),
    HostingMutant(
        "a start that is declined is waited for",
        "        step.live(lifecycle.LeaveRefused(effect.reason, for_good=True))",
        "        pass",
    ),
    HostingMutant(
        "a start that is declined is tried again",
        "step.live(lifecycle.LeaveRefused(effect.reason, for_good=True))",
        "step.live(lifecycle.LeaveRefused(effect.reason))",
    ),
    HostingMutant(
        "what cannot be forgotten is forgotten",
        "ForgettingAsked: lambda step, effect: step.do(Lasts(effect.reason))",
        "ForgettingAsked: lambda step, effect: step.do(Lasts())",
    ),
    HostingMutant(
        "what cannot be removed is removed",
        "RemovalAsked: lambda step, effect: step.do(Lasts(effect.reason))",
        "RemovalAsked: lambda step, effect: step.do(Lasts())",
    ),
    # The service begins
    HostingMutant("what is born is recovered", "    if record.may_begin or (event.fresh", "    if (event.fresh"),
    HostingMutant("anew means as before", " or (event.fresh and record.phase is Phase.OWNER):", ":"),
    HostingMutant("what is elsewhere begins anew", "(event.fresh and record.phase is Phase.OWNER)", "event.fresh"),
    HostingMutant(
        "a frozen task stays frozen",
        "    elif record.phase in (Phase.OWNER, Phase.FROZEN):\n",
        "    elif record.phase is Phase.OWNER:\n",
    ),
    HostingMutant(
        "its service waits for what is elsewhere",
        "        _take_up(step, TakeUp())\n        step.do(lifecycle.Settle())",
        "        _take_up(step, TakeUp())",
    ),
    HostingMutant(
        "a hand-off found on disk does not go on",
        "        _take_up(step, TakeUp())\n        step.do(lifecycle.Settle())",
        "        step.do(lifecycle.Settle())",
    ),
    # Room
    HostingMutant(
        "there is always room",
        "    if event.reason and not record.in_doubt:",
        "    if False:\n",
    ),
    HostingMutant(
        "what was lost is tried again and again",
        "lifecycle.LeaveRefused(event.reason, event.for_good)",
        "lifecycle.LeaveRefused(event.reason)",
    ),
    HostingMutant(
        "it is not born",
        "        step.feed(handoff_event.Born(event.snapshot, event.guardian))\n",
        "        pass\n",
    ),
    HostingMutant(
        "what is being adopted is born", "record.may_begin and step.standing.waits is None:", "record.may_begin:"
    ),
    HostingMutant(
        "what is on its way here is refused, and tried again",
        "event.reason and not record.in_doubt:",
        "event.reason:",
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
        "room is found for what does not ask",
        "    if step.life is None or step.life.state not in UNDECIDED:\n        step.unreserve()",
        "    if False:\n        step.unreserve()",
    ),
    HostingMutant(
        "actuators are kept for what does not ask any more",
        "        step.unreserve()  # it was decided otherwise since\n",
        "",
    ),
    HostingMutant(
        "the actuators of what is on its way here are given away",
        "        if self.standing.record.phase is not Phase.PREPARED:\n            self.do",
        "        if True:\n            self.do",
    ),
    HostingMutant(
        "an end takes the actuators of the start after it",
        "        step.change(waits=None)  # it was decided otherwise since\n",
        "        step.done()\n",
    ),
    # The disk
    HostingMutant(
        "what a crash has left frozen waits for leave for ever",
        "    if state in UNDECIDED and step.standing.record.phase is Phase.FROZEN and not asked_later:\n",
        "    if False:\n",
    ),
    HostingMutant(
        "what a crash has left frozen is tried again while it is handed over",
        "LeaveRefused(event.reason, for_good=True)",
        "LeaveRefused(event.reason)",
    ),
    HostingMutant(
        "what was decided goes on after a fault",
        "trouble=event.reason, effects=tuple(effects))",
        "trouble=event.reason)",
    ),
    HostingMutant(
        "an adoption is not answered",
        "    if (elsewhere or adopted) and not",
        "    if False and not",
    ),
    HostingMutant(
        "an adoption that waits is answered",
        " and not adopted_later:",
        ":",
    ),
    # The turn
    HostingMutant(
        "a rest is told before it is on disk", "            if self.standing.rests:\n", "            if False:\n"
    ),
    HostingMutant("a rest lasts for ever", "                self.change(rests=False)\n", ""),
    HostingMutant("its place is not cleared", "            self.do(Vacate())\n", "            pass\n"),
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
        "        self.change(waits=None, begins=False)\n        self.unreserve()\n",
        "        self.change(waits=None, begins=False)\n",
    ),
    HostingMutant(
        "what does not run is written down each time",
        "    if refused and not known and ended",
        "    if refused and ended",
    ),
    HostingMutant(
        "what is tried again is not written down",
        "not standing.volatile.running and standing.record.wanted is ended.wanted",
        "not standing.volatile.running",
    ),
    HostingMutant(
        "what could not be written counts as written",
        "known = settled(standing) and not",
        "known = idle(standing) and not",
    ),
    HostingMutant("what waits to be written is known", "known = settled(standing) and not", "known = not"),
    HostingMutant("it starts beside its old actor", "    elif life.state not in ACTOR:", "    else:"),
    HostingMutant(
        "it is not known to begin",
        "        step.change(begins=True, unanswered=0)",
        "        step.change(unanswered=0)",
    ),
    HostingMutant("its former actor owes an answer", "begins=True, unanswered=0", "begins=True"),
    HostingMutant(
        "what does not run is to stand still",
        "    if step.life is not None and step.life.state is State.RUNNING:\n        step.change(unanswered",
        "    if True:\n        step.change(unanswered",
    ),
    HostingMutant("its answers are not counted", "        step.change(unanswered=step.standing.unanswered + 1)\n", ""),
    HostingMutant(
        "that it cannot stand still is not passed on",
        '        step.feed(handoff_event.FreezeFailed(event.offer, event.reason or "it ends"))',
        "        pass",
    ),
    HostingMutant(
        "it is taken down for a hand-off that is over",
        "    elif standing.volatile.freezing and not any",
        "    elif not any",
    ),
    HostingMutant(
        "a deadline passes and it may stand still after all",
        " and not any(isinstance(later, given_up) for later in standing.events)",
        "",
    ),
    HostingMutant(
        "a deadline means nothing",
        '        step.feed(handoff_event.FreezeFailed(event.offer, "it is stuck"))',
        "        pass",
    ),
    HostingMutant(
        "the end of a service undoes a stop",
        "idle(standing) and wanted is record.wanted and alike",
        "idle(standing) and alike",
    ),
    HostingMutant(
        "what ends with its service, or is to start again, is stopped",
        "    return Wanted.RUNNING if life.wanted else Wanted.STOPPED",
        "    return Wanted.STOPPED",
    ),
    HostingMutant(
        "a stop does not outlive a crash",
        "    return Wanted.RUNNING if life.wanted else Wanted.STOPPED",
        "    return Wanted.RUNNING",
    ),
    HostingMutant(
        "what changed before its service ended is lost",
        "wanted is record.wanted and alike:",
        "wanted is record.wanted:",
    ),
    HostingMutant(
        "what waits to be written counts as written", "step.at.closing and idle(standing) and", "step.at.closing and"
    ),
    HostingMutant(
        "what is given up is wanted",
        "    if life.state is State.FAILED and life.restarts.due_s is None:\n        return Wanted.FAILED\n",
        "",
    ),
    HostingMutant("what is tried again is given up", "State.FAILED and life.restarts.due_s is None:", "State.FAILED:"),
    HostingMutant(
        "a task that failed and was given away keeps its place",
        "step.change(leaving=step.life is not None, to_conclude=2)",
        "step.change(to_conclude=2)",
    ),
    HostingMutant("a hand-over is concluded by its first part", "to_conclude=2", "to_conclude=1"),
    HostingMutant(
        "a rest is not told",
        "    step.go_on()\n    step.do(Rested())\n\n\ndef _wanted",
        "    step.go_on()\n\n\ndef _wanted",
    ),
    HostingMutant("that it lasts is not told", "                self.do(Lasts())\n", "                pass\n"),
    HostingMutant(
        "what waits for the disk keeps its service waiting",
        "        step.live(lifecycle.PutOff(event.reason))",
        "        pass",
    ),
    HostingMutant(
        "actuators are kept for what is not on disk",
        "        step.unreserve()\n\n\ndef _stood",
        "        pass\n\n\ndef _stood",
    ),
    HostingMutant(
        "actuators are not kept for what waits for the disk",
        "    if state is not State.ASKED:\n        step.unreserve()",
        "    step.unreserve()",
    ),
    HostingMutant(
        "the record is not known",
        '        step.change(waits=None, record=waits.record, trouble="")',
        '        step.change(waits=None, trouble="")',
    ),
    HostingMutant(
        "an adoption that comes too late is not answered",
        "        if waits.record.phase is Phase.PREPARED:\n",
        "        if False:\n",
    ),
    HostingMutant(
        "a task that cannot be forgotten is forgotten later",
        "        step.do(Lasts(event.reason))\n",
        "        pass\n",
    ),
    HostingMutant(
        "what is stopped while the disk fails keeps its service waiting",
        "    elif state in UNDECIDED:\n        step.live(lifecycle.PutOff",
        "    elif state is State.ASKED:\n        step.live(lifecycle.PutOff",
    ),
    *DISPUTES,
)
