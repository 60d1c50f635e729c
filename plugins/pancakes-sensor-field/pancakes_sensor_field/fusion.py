"""Fuse the reports of all nodes: the weight of the evidence, and whether there is an alarm. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

from pancakes import NotNegative, Positive
from pancakes_sensor_field.packets import Report


@dataclass
class FusionSettings:
    """The weights of the evidence.

    Attributes:
        motion_weight: a node that has sensed motion within `window_s`.
        heat_weight: a node whose temperature is `hot_c` or more, or was within `window_s`.
        hot_c: see there.
        window_s: how long evidence counts.
        raise_at: the weight at which there is an alarm. With the defaults, one animal or one node in the sun does not
            raise it; motion and heat together do, or motion at three nodes.
        clear_after_s: an alarm is over when the evidence has weighed less for this time.
    """

    motion_weight: NotNegative = 1.0
    heat_weight: NotNegative = 2.0
    hot_c: float = 45.0
    window_s: Positive = 20.0
    raise_at: Positive = 3.0
    clear_after_s: Positive = 15.0


@dataclass
class NodeMemory:
    """What is remembered of one node.

    Attributes:
        received: how many of its reports have come.
        highest: the number of the last of them; equal to `received` if none was lost and none came twice.
        heard_s: when it was made.
        celsius: the temperature in it.
        moved_s: when the node last sensed motion; None: never.
        moving: whether it still did when it last reported.
        hot_s: when it last was hot; None: never.
    """

    received: int = 0
    highest: int = 0
    heard_s: float = 0.0
    celsius: float | None = None
    moved_s: float | None = None
    moving: bool = False
    hot_s: float | None = None


@dataclass
class Situation:
    """The state of the field, by the reports so far.

    Attributes:
        nodes: each node, by name.
        alarms: how many alarms there have been.
        open: whether there is one now.
        weighed_s: when the evidence last was enough for one.
    """

    nodes: dict[str, NodeMemory] = field(default_factory=dict)
    alarms: int = 0
    open: bool = False
    weighed_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence at one moment.

    Attributes:
        weight: the total weight.
        moving: nodes that count for motion.
        hot: nodes that count for heat.
    """

    weight: float
    moving: tuple[str, ...]
    hot: tuple[str, ...]


def remember(situation: Situation, report: Report, made_s: float, settings: FusionSettings) -> None:
    """Add a report to what is known.

    Args:
        situation: what is known; changed in place.
        report: the report.
        made_s: mission time at which it was made: it may have waited for its node's network.
        settings: what counts.
    """
    node = situation.nodes.setdefault(report.node, NodeMemory())
    node.received += 1
    node.highest = report.number
    node.heard_s = made_s
    node.celsius = report.celsius
    if report.moving or node.moving:  # it moved up to now
        node.moved_s = made_s
    node.moving = report.moving
    if report.celsius is not None and report.celsius >= settings.hot_c:
        node.hot_s = made_s


def weigh(situation: Situation, now_s: float, settings: FusionSettings) -> Evidence:
    """Return what counts at `now_s`."""

    def counts(when_s: float | None) -> bool:
        return when_s is not None and now_s - when_s <= settings.window_s

    moving = tuple(name for name, node in sorted(situation.nodes.items()) if node.moving or counts(node.moved_s))
    hot = tuple(name for name, node in sorted(situation.nodes.items()) if counts(node.hot_s))
    return Evidence(settings.motion_weight * len(moving) + settings.heat_weight * len(hot), moving, hot)


def judge(situation: Situation, now_s: float, settings: FusionSettings) -> tuple[Evidence, str]:
    """Decide whether there is an alarm; `situation` is changed.

    Returns:
        The evidence, and `raised`, `cleared`, or an empty string if nothing has changed.
    """
    evidence = weigh(situation, now_s, settings)
    if evidence.weight >= settings.raise_at:
        situation.weighed_s = now_s
        if not situation.open:
            situation.open = True
            situation.alarms += 1
            return evidence, "raised"
    elif situation.open and now_s - situation.weighed_s >= settings.clear_after_s:
        situation.open = False
        return evidence, "cleared"
    return evidence, ""
