"""Make messages that viewers draw without configuration, in the schemas that Foxglove knows by name.

| packet | schema and topic, below `/viewer/AGENT` |
|---|---|
| `pose` | `PoseInFrame` on `DEVICE`, `PosesInFrame` on `DEVICE/path`, `FrameTransforms` on `DEVICE/transform` |
| `pose_3d` | `PoseInFrame` on `DEVICE` |
| `ir`, `sonar`, `laser_scan` | `LaserScan` on `DEVICE` |
| `world_state` | `SceneUpdate` on `world` |
| `event`, `line` | `Log` on `log` |

Poses and the world are in the frame `world`, scans in that of the body, which has the name of its agent. A reading that
names its frame is in that frame.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

from pancakes.packet import LOG, SYSTEM
from pancakes.recording.causal_chains import body_text
from pancakes.recording.records import NANOSECONDS, RecordedPacket
from pancakes.util import codecs

SHOWN: Final = ("event", "ir", "laser_scan", "line", "pose", "pose_3d", "sonar", "world_state")
"""The packet types that are shown."""
FRAME: Final = "world"
TRAIL: Final = 300
"""The number of poses in a path."""
TRAIL_NS: Final = 10 * NANOSECONDS
"""How often a path is written."""
SHOWN_NS: Final = NANOSECONDS // 10
"""The highest rate of shown messages: the eye sees no more, and the recording has all packets anyway."""
STEP_DEG: Final = 3
"""The angle between two values of a scan: 121 of them all around."""
LEVELS: Final = {"debug": 1, "info": 2, "warning": 3, "error": 4}
"""The levels of `foxglove.Log`; 0 is unknown."""
COLOURS: Final = ((0.12, 0.47, 0.71), (0.84, 0.15, 0.16), (0.17, 0.63, 0.17), (0.58, 0.40, 0.74), (1.0, 0.5, 0.05))
GREY: Final = (0.5, 0.5, 0.5)


class ViewerMessage(NamedTuple):
    """A message in the schema of a viewer: the arguments of `RecordingWriter.add`."""

    topic: str
    schema_name: str
    schema: Mapping[str, object]
    time_ns: int
    data: bytes


class Viewer:
    """Make viewer messages from packets, see the table of this module. In one thread."""

    def __init__(self) -> None:
        self._trails: dict[str, deque[dict[str, Any]]] = {}
        self._path_ns: dict[str, int] = {}
        self._shown_ns: dict[str, int] = {}

    def messages(self, entry: RecordedPacket) -> Iterator[ViewerMessage]:
        """Yield the viewer messages for a packet."""
        packet = entry.packet
        if isinstance(packet.body, Mapping) or packet.type not in SHOWN:
            return  # of a type that is unknown here, or not shown
        if packet.type == "world_state":
            if self._is_due(entry):
                yield _scene(entry)
        elif not packet.source.startswith(entry.agent + "/"):
            return  # it only passes through
        elif packet.channel == LOG:
            yield _log(entry)
        elif packet.channel == SYSTEM and self._is_due(entry):
            if packet.type == "pose":
                yield from self._pose(entry)
            elif packet.type in ("ir", "sonar"):
                yield _scan(entry)
            elif packet.type == "pose_3d":
                yield _pose_3d(entry)
            elif packet.type == "laser_scan":
                yield _laser_scan(entry)

    def _is_due(self, entry: RecordedPacket) -> bool:
        source, time_ns = entry.packet.source, entry.time_ns
        # A tenth of tolerance: packets at 10 Hz are sometimes a little early.
        if time_ns - self._shown_ns.get(source, -SHOWN_NS) < SHOWN_NS * 9 // 10:
            return False
        self._shown_ns[source] = time_ns
        return True

    def _pose(self, entry: RecordedPacket) -> Iterator[ViewerMessage]:
        body, device = entry.packet.body, entry.packet.source.rpartition("/")[2]
        pose = _pose(body.x_m, body.y_m, body.theta_rad)
        head = {"timestamp": _time(entry.time_ns), "frame_id": FRAME}
        topic = f"/viewer/{entry.agent}/{device}"
        yield _message(topic, "foxglove.PoseInFrame", entry.time_ns, {**head, "pose": pose})
        frame = {
            "timestamp": head["timestamp"],
            "parent_frame_id": FRAME,
            "child_frame_id": entry.agent,
            "translation": pose["position"],
            "rotation": pose["orientation"],
        }
        yield _message(f"{topic}/transform", "foxglove.FrameTransforms", entry.time_ns, {"transforms": [frame]})
        trail = self._trails.setdefault(topic, deque(maxlen=TRAIL))
        trail.append(pose)
        if entry.time_ns - self._path_ns.get(topic, -TRAIL_NS) >= TRAIL_NS:
            self._path_ns[topic] = entry.time_ns
            path = {**head, "poses": list(trail)}
            yield _message(f"{topic}/path", "foxglove.PosesInFrame", entry.time_ns, path)


def _scene(entry: RecordedPacket) -> ViewerMessage:
    entities = []
    for number, body in enumerate(entry.packet.body.bodies):
        robot = body.kind == "robot"
        red, green, blue = COLOURS[number % len(COLOURS)] if robot else GREY
        colour = {"r": red, "g": green, "b": blue, "a": 0.9}
        height_m, width_m = (0.1, 0.13) if robot else (0.05, 0.1)
        pose = _pose(body.x_m, body.y_m, body.theta_rad)
        place = {**pose, "position": {**pose["position"], "z": height_m / 2}}
        size = {"x": width_m, "y": width_m, "z": height_m}
        nose = {"shaft_length": 0.1, "shaft_diameter": 0.02, "head_length": 0.05, "head_diameter": 0.04}
        entities.append(
            {
                "timestamp": _time(entry.time_ns),
                "frame_id": FRAME,
                "id": body.name,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": False,
                "metadata": [{"key": "driven by", "value": body.driven_by}] if body.driven_by else [],
                "arrows": [{"pose": place, "color": colour, **nose}] if robot else [],
                "cubes": [],
                "spheres": [],
                "cylinders": [{"pose": place, "size": size, "bottom_scale": 1.0, "top_scale": 1.0, "color": colour}],
                "lines": [],
                "triangles": [],
                "texts": [],
                "models": [],
            }
        )
    scene = {"deletions": [], "entities": entities}
    return _message(f"/viewer/{entry.agent}/world", "foxglove.SceneUpdate", entry.time_ns, scene)


def _log(entry: RecordedPacket) -> ViewerMessage:
    packet = entry.packet
    if packet.type == "line":
        level, text = packet.body.level, packet.body.text
    else:
        level, text = "info", f"{packet.body.kind.replace('_', ' ')}: {body_text(packet.body.fields)}"
    plain = {
        "timestamp": _time(entry.time_ns),
        "level": LEVELS.get(level, 0),
        "message": text,
        "name": packet.source,
        "file": "",
        "line": 0,
    }
    return _message(f"/viewer/{entry.agent}/log", "foxglove.Log", entry.time_ns, plain)


def _pose_3d(entry: RecordedPacket) -> ViewerMessage:
    body, device = entry.packet.body, entry.packet.source.rpartition("/")[2]
    plain = {
        "timestamp": _time(entry.time_ns),
        "frame_id": body.frame,
        "pose": {
            "position": {"x": body.x_m, "y": body.y_m, "z": body.z_m},
            "orientation": dict(zip("xyzw", body.orientation, strict=True)),
        },
    }
    return _message(f"/viewer/{entry.agent}/{device}", "foxglove.PoseInFrame", entry.time_ns, plain)


def _laser_scan(entry: RecordedPacket) -> ViewerMessage:
    body, device = entry.packet.body, entry.packet.source.rpartition("/")[2]
    plain = {
        "timestamp": _time(entry.time_ns),
        "frame_id": body.frame or entry.agent,
        "pose": _pose(0.0, 0.0, 0.0),
        "start_angle": body.start_rad,
        "end_angle": body.start_rad + body.step_rad * (len(body.ranges_mm) - 1),
        "ranges": [range_mm / 1000 for range_mm in body.ranges_mm],
        "intensities": [1.0 if 0 < range_mm < 1000 * body.max_range_m else 0.0 for range_mm in body.ranges_mm],
    }
    return _message(f"/viewer/{entry.agent}/{device}", "foxglove.LaserScan", entry.time_ns, plain)


def _scan(entry: RecordedPacket) -> ViewerMessage:
    ring, device = entry.packet.body, entry.packet.source.rpartition("/")[2]
    start_deg, ranges_m, seen = scan(ring.bearings_rad, ring.ranges_m, ring.max_range_m)
    plain = {
        "timestamp": _time(entry.time_ns),
        "frame_id": entry.agent,
        "pose": _pose(0.0, 0.0, 0.0),
        "start_angle": math.radians(start_deg),
        "end_angle": math.radians(start_deg + STEP_DEG * (len(ranges_m) - 1)),
        "ranges": ranges_m,
        "intensities": seen,
    }
    return _message(f"/viewer/{entry.agent}/{device}", "foxglove.LaserScan", entry.time_ns, plain)


def scan(
    bearings_rad: Sequence[float], ranges_m: Sequence[float], max_range_m: float
) -> tuple[int, list[float], list[float]]:
    """Put the readings of a ring of sensors on a grid of equal angles, as a `LaserScan` has them.

    Args:
        bearings_rad: the direction of each sensor, in the frame of the body.
        ranges_m: the reading of each, from the edge of the body.
        max_range_m: the full range, the reading of a sensor that sees nothing.

    Returns:
        The first angle in whole degrees, and for each step of `STEP_DEG` from there the range and the intensity: 1 if a
            sensor sees something; 0, at the full range, if none does or none looks there.

    Raises:
        ValueError: there are not as many ranges as bearings.
    """
    degrees = [STEP_DEG * round(math.degrees(it) / STEP_DEG) for it in bearings_rad]
    start_deg = min(degrees, default=0)
    count = (max(degrees, default=0) - start_deg) // STEP_DEG + 1
    grid_m, seen = [max_range_m if math.isfinite(max_range_m) else 0.0] * count, [0.0] * count  # JSON has no infinity
    for angle, range_m in zip(degrees, ranges_m, strict=True):
        place = (angle - start_deg) // STEP_DEG
        if range_m < max_range_m:
            grid_m[place], seen[place] = min(range_m, grid_m[place]), 1.0
    return start_deg, grid_m, seen


def _message(topic: str, name: str, time_ns: int, plain: Mapping[str, Any]) -> ViewerMessage:
    return ViewerMessage(topic, name, {"title": name, **_schemas()[name]}, time_ns, codecs.encode_json(plain))


@cache
def _schemas() -> dict[str, dict[str, Any]]:
    """Return the schemas by their names in Foxglove: https://docs.foxglove.dev/docs/sdk/schemas.

    They are published in https://github.com/foxglove/foxglove-sdk, schemas/jsonschema. Of fields that are always empty
    here, the file has only the name.
    """
    return codecs.json_decoder()(resources.files("pancakes.recording").joinpath("static/foxglove.json").read_text())


def _time(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // NANOSECONDS, "nsec": time_ns % NANOSECONDS}


def _pose(x_m: float, y_m: float, theta_rad: float) -> dict[str, Any]:
    return {
        "position": {"x": x_m, "y": y_m, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(theta_rad / 2), "w": math.cos(theta_rad / 2)},
    }
