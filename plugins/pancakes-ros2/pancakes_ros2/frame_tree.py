"""The frames of tf, and where one is in another. Pure.

Of each frame the newest transform counts, and transforms are not interpolated: a pose is as old as the oldest transform
on its way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from pancakes.devices import LEVEL, Pose3D, Quaternion, Vector
from pancakes_ros2.message_fields import Unusable
from pancakes_ros2.sensor_conversion import read_transform

MOST_FRAMES: Final = 10_000
"""At most this many frames are remembered: a publisher that invents names must not fill the memory."""
SHOWN_FRAMES: Final = 20
MOST_STEPS: Final = 100
"""A way from a frame to the root has at most this many transforms."""


class FrameTree:
    """Where one frame is in another, by the transforms that came. In one thread.

    Args:
        frame: the frame that the pose is in, such as `map`; a slash before it does not count.
        child: the frame that it is the pose of, such as `base_link`; likewise.
    """

    def __init__(self, frame: str, child: str) -> None:
        self.frame = frame.lstrip("/")
        self.child = child.lstrip("/")
        self._transforms: dict[str, Pose3D] = {}

    def hear(self, message: Any) -> tuple[Pose3D | None, list[str]]:
        """Take a tf2_msgs/TFMessage, of /tf or of /tf_static.

        Args:
            message: the message.

        Returns:
            The pose, if a transform of this message is part of it; None: none is, or it is not known yet. And what is
            wrong with transforms that were left out.
        """
        heard, faults = set(), []
        for transform in message.transforms:
            try:
                pose, child = read_transform(transform)
            except Unusable as error:
                faults.append(str(error))
                continue
            if child in self._transforms or len(self._transforms) < MOST_FRAMES:
                self._transforms[child] = pose
                heard.add(child)
        if not heard:
            return None, faults
        ways = self._ways()
        if ways is None or heard.isdisjoint({*ways[0], *ways[1]}):
            return None, faults
        down, up = ways
        place, turn = self._along(down)
        base_place, base_turn = self._along(up)
        back = _inverse(base_turn)
        shifted = (place[0] - base_place[0], place[1] - base_place[1], place[2] - base_place[2])
        x_m, y_m, z_m = _turned(back, shifted)
        if not all(map(math.isfinite, (x_m, y_m, z_m))):
            return None, [*faults, f"the transforms from {self.frame} to {self.child} are together not finite"]
        return Pose3D(self.frame, x_m, y_m, z_m, _unit(_product(back, turn))), faults

    def explain(self, do: Callable[[Callable[[Any], None]], None], tell: Callable[[str], None]) -> None:
        """Have `tell` called with why the pose is not known, if it is not.

        Args:
            do: has a function called in the thread that hears the transforms; see `RosNode.do`.
            tell: takes the sentence, in that thread.
        """

        def look(_: Any) -> None:
            if why := self.why_unknown():
                tell(why)

        do(look)

    def why_unknown(self) -> str:
        """Return why the pose is not known, with the frames that there are; empty: it is known."""
        if self._ways() is not None:
            return ""
        names = sorted({*self._transforms, *(step.frame for step in self._transforms.values())})
        if not names:
            return "no transform of tf has come"
        more = f" and {len(names) - SHOWN_FRAMES} more" if len(names) > SHOWN_FRAMES else ""
        there = ", ".join(names[:SHOWN_FRAMES])
        return f"no transforms of tf connect {self.frame!r} and {self.child!r}; its frames are {there}{more}"

    def _ways(self) -> tuple[list[str], list[str]] | None:
        """Return the frames whose transforms lead from the child and from the frame to their common ancestor."""
        down, up = self._ancestors(self.child), self._ancestors(self.frame)
        common = next((name for name in up if name in down), None)
        return None if common is None else (down[: down.index(common)], up[: up.index(common)])

    def _ancestors(self, name: str) -> list[str]:
        """Return a frame, its parent, and so on to the root; transforms that form a circle end where it closes."""
        found = [name]
        while (step := self._transforms.get(found[-1])) is not None:
            if step.frame in found or len(found) > MOST_STEPS:
                break
            found.append(step.frame)
        return found

    def _along(self, way: list[str]) -> tuple[Vector, Quaternion]:
        """Return where the first frame of a way is in the frame above the last."""
        place: Vector = (0.0, 0.0, 0.0)
        turn: Quaternion = LEVEL
        for name in way:
            step = self._transforms[name]
            x, y, z = _turned(step.orientation, place)
            place = (x + step.x_m, y + step.y_m, z + step.z_m)
            turn = _product(step.orientation, turn)
        return place, turn


def _product(one: Quaternion, other: Quaternion) -> Quaternion:
    """Return the turn `other`, and then `one`."""
    ax, ay, az, aw = one
    bx, by, bz, bw = other
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _inverse(turn: Quaternion) -> Quaternion:
    x, y, z, w = turn
    return (-x, -y, -z, w)


def _turned(turn: Quaternion, vector: Vector) -> Vector:
    x, y, z, _ = _product(_product(turn, (*vector, 0.0)), _inverse(turn))
    return x, y, z


def _unit(turn: Quaternion) -> Quaternion:
    """Return a quaternion of the length 1: products of many drift away from it."""
    x, y, z, w = turn
    length = (x * x + y * y + z * z + w * w) ** 0.5
    return (x / length, y / length, z / length, w / length)
