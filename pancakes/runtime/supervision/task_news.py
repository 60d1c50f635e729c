"""The events and lines on `log` about the life of a task."""

from __future__ import annotations

from typing import assert_never

from pancakes.runtime.kernel.component import Component
from pancakes.runtime.life.life_effect import News, Tell
from pancakes.runtime.supervision.slot import Slot


def tell_of_task(service: Component, slot: Slot, effect: Tell) -> None:
    """Tells people and programs what has happened to a task, in the name of its service."""
    restarts, text = slot.life.restarts, effect.text
    traceback = slot.failure.traceback if slot.failure is not None else ""
    now_s = service.kernel.host.now()
    match effect.news:
        case News.REFUSED:
            service.log("error", f"{slot.address} was not started: {text}")
        case News.STARTED:
            service.event(
                "task_started",
                task=slot.name,
                service=service.name,
                type=slot.spec.type,
                incarnation=slot.life.incarnation,
                epoch=slot.fence.epoch[0] if slot.fence is not None else None,
            )
        case News.FAILED:
            following = effect.following.value if effect.following is not None else ""
            service.event("task_failed", task=slot.name, error=text, then=following)
        case News.RESTARTS:
            if slot.failure is None or slot.failure.text != text:
                traceback = ""
            service.log("warning", f"{slot.address} is started again {restarts.when(now_s)}: {text}", traceback)
        case News.GIVEN_UP:
            spec = restarts.spec
            then_again = "" if restarts.due_s is None else f", and tried again {restarts.when(now_s)}"
            why = "" if effect.hopeless else f" ({spec.policy}, {spec.at_most} restarts in {spec.within_s:g} s)"
            service.log("error", f"{slot.address} is given up{then_again}: {text}{why}", traceback)
            service.event("task_given_up", task=slot.name, error=text)
        case News.FAILED_WHILE_STOPPING:
            service.log("warning", f"{slot.address} failed while it stopped: {text}", traceback)
        case News.FAILED_AT_THE_END:
            service.log("warning", f"{slot.address} failed as its service stops: {text}", traceback)
        case News.STOPPED:
            service.event("task_stopped", task=slot.name, service=service.name, reason=text)
        case News.STUCK:
            service.log("error", text)
            service.event("task_stuck", task=slot.name)
        case _:
            assert_never(effect.news)
