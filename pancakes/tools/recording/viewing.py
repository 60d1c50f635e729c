"""What viewers draw without being told how: poses, paths and the world, in the schemas that Foxglove knows by name."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

from pancakes.runtime.foundation import codecs
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket

SHOWN: Final = ("pose", "world_state")
"""The packet types of which something is shown."""
FRAME: Final = "world"
TRAIL: Final = 300
"""The number of poses in a path."""
TRAIL_NS: Final = 10 * NANOSECONDS
"""How often a path is written."""
SHOWN_NS: Final = NANOSECONDS // 10
"""How often anything is shown at most: an eye sees no more, and the packets themselves are all in the recording."""
COLOURS: Final = ((0.12, 0.47, 0.71), (0.84, 0.15, 0.16), (0.17, 0.63, 0.17), (0.58, 0.40, 0.74), (1.0, 0.5, 0.05))
GREY: Final = (0.5, 0.5, 0.5)


class ViewerMessage(NamedTuple):
    """A message in the schema of a viewer; the arguments of `RecordingWriter.add`."""

    topic: str
    schema_name: str
    schema: Mapping[str, object]
    time_ns: int
    data: bytes


class Viewer:
    """Makes viewer messages of packets: of the type `pose` a pose and a path, of the type `world_state` a scene."""

    def __init__(self) -> None:
        self._trails: dict[str, deque[dict[str, Any]]] = {}
        self._told_ns: dict[str, int] = {}
        self._shown_ns: dict[str, int] = {}

    def messages(self, entry: RecordedPacket) -> Iterator[ViewerMessage]:
        """Gives what a viewer shows of a packet."""
        packet = entry.packet
        if isinstance(packet.body, Mapping):
            return  # of a type that is not known here
        if packet.type == "pose" and packet.channel == "system" and packet.source.startswith(entry.agent + "/"):
            if self._is_due(entry):
                yield from self._pose(entry)
        elif packet.type == "world_state" and self._is_due(entry):
            yield _scene(entry)

    def _is_due(self, entry: RecordedPacket) -> bool:
        source, time_ns = entry.packet.source, entry.time_ns
        # A tenth of tolerance: a packet of ten a second is a little early now and then.
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
        trail = self._trails.setdefault(topic, deque(maxlen=TRAIL))
        trail.append(pose)
        if entry.time_ns - self._told_ns.get(topic, -TRAIL_NS) >= TRAIL_NS:
            self._told_ns[topic] = entry.time_ns
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


def _message(topic: str, name: str, time_ns: int, plain: Mapping[str, Any]) -> ViewerMessage:
    return ViewerMessage(topic, name, {"title": name, **_schemas()[name]}, time_ns, codecs.encode_json(plain))


@cache
def _schemas() -> dict[str, dict[str, Any]]:
    """Returns the schemas by the names under which Foxglove finds them: https://docs.foxglove.dev/docs/sdk/schemas.

    They are published in https://github.com/foxglove/foxglove-sdk, schemas/jsonschema. Of what is always empty here
    the file has the name alone.
    """
    return codecs.json_decoder()(
        resources.files("pancakes.tools.recording").joinpath("static/foxglove.json").read_text()
    )


def _time(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // NANOSECONDS, "nsec": time_ns % NANOSECONDS}


def _pose(x_m: float, y_m: float, theta_rad: float) -> dict[str, Any]:
    return {
        "position": {"x": x_m, "y": y_m, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(theta_rad / 2), "w": math.cos(theta_rad / 2)},
    }
