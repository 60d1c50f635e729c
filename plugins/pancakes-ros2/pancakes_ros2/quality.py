"""How messages of a topic are delivered: a QoS profile of ROS 2, as plain settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

Depth = Annotated[int, Meta(ge=1, le=10_000)]
LifespanS = Annotated[float, Meta(gt=0)]


@dataclass(frozen=True)
class Quality:
    """A QoS profile.

    Attributes:
        reliability: whether lost messages are sent again. A reliable reader hears reliable writers alone.
        durability: whether a reader that comes late gets the newest messages too. Such a reader hears such writers
            alone.
        depth: how many of the newest messages are kept.
        lifespan_s: a message that is older than this, in seconds, is delivered no more; None: none is too old.
    """

    reliability: Literal["reliable", "best_effort"] = "reliable"
    durability: Literal["volatile", "transient_local"] = "volatile"
    depth: Depth = 10
    lifespan_s: LifespanS | None = None


READING: Final = Quality("best_effort", depth=5)
"""For readings: the newest counts."""
MOVING: Final = Quality(depth=100)
"""For /tf: each transform counts, and many publishers share the topic."""
STATIC: Final = Quality(durability="transient_local", depth=100)
"""For /tf_static: a reader that comes late gets the transforms too."""
COMMAND: Final = Quality(depth=1)
"""For commands: each arrives, and none is obeyed late."""


def profile_of(quality: Quality) -> Any:
    """Returns it as rclpy wants it. Needs a ROS 2."""
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    others = {} if quality.lifespan_s is None else {"lifespan": Duration(nanoseconds=round(quality.lifespan_s * 1e9))}
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=quality.depth,
        reliability=ReliabilityPolicy[quality.reliability.upper()],
        durability=DurabilityPolicy[quality.durability.upper()],
        **others,
    )
