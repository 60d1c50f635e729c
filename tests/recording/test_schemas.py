"""The schemas in a recording: viewers understand each of them, and Foxglove's own are as Foxglove publishes them."""

import json
import math

import pytest
from mcap.reader import make_reader

from pancakes.devices import Infrared, LaserScan, Pose, Pose3D, Sonar
from pancakes.events import Event, LogLine
from pancakes.packet import Packet, known_types
from pancakes.recording.foxglove_messages import Viewer
from pancakes.recording.mcap_writer import RecordingWriter
from pancakes.recording.message_format import schema_for, viewable
from pancakes.recording.records import RecordedPacket
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.util.plugins import Plugins

SIMPLE = {"boolean", "string", "number", "integer"}
S = 1_000_000_000

# As Foxglove publishes them (foxglove-sdk, schemas/jsonschema): what is required, and of which type.
TIME = {"sec": int, "nsec": int}
VECTOR = dict.fromkeys("xyz", float)
POSE = {"position": VECTOR, "orientation": dict.fromkeys("xyzw", float)}
COLOUR = dict.fromkeys("rgba", float)
ARROW = {
    "pose": POSE, "shaft_length": float, "shaft_diameter": float, "head_length": float, "head_diameter": float,
    "color": COLOUR,
}  # fmt: skip
CYLINDER = {"pose": POSE, "size": VECTOR, "bottom_scale": float, "top_scale": float, "color": COLOUR}
ENTITY = {
    "timestamp": TIME, "frame_id": str, "id": str, "lifetime": TIME, "frame_locked": bool,
    "metadata": [{"key": str, "value": str}], "arrows": [ARROW], "cubes": [{}], "spheres": [{}],
    "cylinders": [CYLINDER], "lines": [{}], "triangles": [{}], "texts": [{}], "models": [{}],
}  # fmt: skip
FRAME = {
    "timestamp": TIME, "parent_frame_id": str, "child_frame_id": str, "translation": VECTOR,
    "rotation": dict.fromkeys("xyzw", float),
}  # fmt: skip
PUBLISHED = {
    "foxglove.FrameTransforms": {"transforms": [FRAME]},
    "foxglove.LaserScan": {
        "timestamp": TIME, "frame_id": str, "pose": POSE, "start_angle": float, "end_angle": float, "ranges": [float],
        "intensities": [float],
    },
    "foxglove.Log": {"timestamp": TIME, "level": int, "message": str, "name": str, "file": str, "line": int},
    "foxglove.PoseInFrame": {"timestamp": TIME, "frame_id": str, "pose": POSE},
    "foxglove.PosesInFrame": {"timestamp": TIME, "frame_id": str, "poses": [POSE]},
    "foxglove.SceneUpdate": {"deletions": [{}], "entities": [ENTITY]},
}  # fmt: skip


def check(schema, path=""):
    """Read a schema as strictly as Foxglove's parser: what this does not understand costs a viewer the topic."""
    assert schema["type"] == "object", path
    for name, field in schema["properties"].items():
        there = f"{path}.{name}"
        assert not {"anyOf", "oneOf", "allOf", "$ref"} & set(field), there
        if field["type"] == "array":
            field = field["items"]
        if field["type"] == "object":
            check(field, there)
        else:
            assert field["type"] in SIMPLE, there


def fits(value, wanted, path=""):
    """Say whether a value is of a published form."""
    if isinstance(wanted, dict):
        assert set(value) >= set(wanted), path
        for name, part in wanted.items():
            fits(value[name], part, f"{path}.{name}")
    elif isinstance(wanted, list):
        for item in value:
            fits(item, wanted[0], f"{path}[]")
    else:
        assert isinstance(value, (int, float) if wanted is float else wanted), path


def describes(schema, wanted, path=""):
    """Say whether a schema describes a published form."""
    if isinstance(wanted, list):
        assert schema["type"] == "array", path
        describes(schema["items"], wanted[0], path)
    elif isinstance(wanted, dict):
        assert schema["type"] == "object", path
        assert set(schema["required"]) == set(schema["properties"]) == set(wanted), path
        for name, part in wanted.items():
            describes(schema["properties"][name], part, f"{path}.{name}")
    else:
        assert schema["type"] == {int: "integer", float: "number", str: "string", bool: "boolean"}[wanted], path


@pytest.fixture(scope="module")
def shown():
    viewer = Viewer()
    body = BodyState("agent1", "robot", 1.0, 2.0, 0.5, 0.1, 0.0, 6.0, "agent1/client/ScanTarget")
    world = WorldState(1.5, (body,))
    packets = [
        Packet("system", "pose", "a/device/pose", "", 1.5, 1, Pose(1.0, 2.0, 3.0)),
        Packet("system", "world_state", "a/client/World", "", 1.5, 1, world),
        Packet("system", "ir", "a/device/ir", "", 1.5, 1, Infrared((1.0, 0.0, -1.0), (0.2, 0.1, 0.3), 0.3)),
        Packet("system", "sonar", "a/device/sonar", "", 1.5, 1, Sonar((0.0,), (0.5,), 4.0)),
        Packet("system", "laser_scan", "a/device/laser", "", 1.5, 1, LaserScan(-0.5, 0.5, (500, 4000, 0), 4.0)),
        Packet("system", "pose_3d", "a/device/place", "", 1.5, 1, Pose3D("world", 1.0, 2.0, 3.0)),
        Packet("log", "line", "a/client/Watch", "", 1.5, 1, LogLine("warning", "the lid is open")),
        Packet("log", "event", "a/client", "", 1.5, 1, Event("task_started", {"service": "client", "task": "Watch"})),
    ]
    return [message for packet in packets for message in viewer.messages(RecordedPacket(int(1.5 * S), "a", packet))]


def test_viewers_understand_the_schema_of_every_packet_type():
    Plugins().load_packets()
    names = known_types()
    assert {"pose", "event", "world_state", "command", "task_figures"} <= set(names)
    for name in names:
        check(schema_for(name), name)
        json.dumps(schema_for(name))


def test_what_viewers_plot_is_described():
    def fields(name):
        return schema_for(name)["properties"]["body"]["properties"]

    assert fields("pose")["x_m"]["type"] == "number"
    assert fields("motion")["bearing_rad"]["type"] == "number"  # or null
    assert fields("world_state")["bodies"]["items"]["properties"]["x_m"]["type"] == "number"
    assert fields("line")["level"]["type"] == "string"
    assert schema_for("nobody.knows.this")["properties"]["body"] == {"type": "object", "properties": {}}


@pytest.mark.parametrize(
    ("schema", "told"),
    [
        ({"anyOf": [{"type": "number"}, {"type": "null"}], "default": None}, {"type": "number"}),
        ({"anyOf": [{"type": "number"}, {"type": "string"}]}, None),
        ({"enum": ["near", "far"], "description": "which."}, {"type": "string", "description": "which."}),
        ({"enum": ["near", 1]}, None),
        ({}, None),
        ({"type": "array", "items": {"type": "array", "items": {"type": "number"}}}, None),
        ({"type": "array", "prefixItems": [{"type": "number"}] * 2}, {"type": "array", "items": {"type": "number"}}),
        ({"type": "array", "prefixItems": [{"type": "number"}, {"type": "string"}]}, None),
        ({"type": "object", "additionalProperties": {"type": "number"}}, {"type": "object", "properties": {}}),
        (
            {"$ref": "#/$defs/Tree"},
            {"type": "object", "properties": {"name": {"type": "string"}}},  # what holds itself is not written out
        ),
    ],
)
def test_what_can_be_said_in_few_words_is_and_the_rest_is_left_out(schema, told):
    tree = {"type": "object", "properties": {"name": {"type": "string"}, "below": {"$ref": "#/$defs/Tree"}}}
    assert viewable(schema, {"Tree": tree}) == told


def test_poses_paths_and_the_world_are_as_foxglove_publishes_their_schemas(shown):
    assert {message.schema_name for message in shown} == set(PUBLISHED)
    for message in shown:
        check(message.schema, message.schema_name)
        assert message.schema["title"] == message.schema_name
        describes(message.schema, PUBLISHED[message.schema_name], message.schema_name)
        fits(json.loads(message.data), PUBLISHED[message.schema_name], message.schema_name)


def test_times_are_those_of_the_messages_and_all_is_in_the_frame_of_the_world_or_of_a_body(shown):
    for message in shown:
        told = json.loads(message.data)
        for part in told.get("entities", told.get("transforms", [told])):
            assert part["timestamp"] == {"sec": 1, "nsec": S // 2}
            frame = part.get("frame_id", part.get("child_frame_id", "a"))
            body = message.schema_name in ("foxglove.LaserScan", "foxglove.FrameTransforms", "foxglove.Log")
            assert frame == ("a" if body else "world")
        assert message.time_ns == S + S // 2
    turned = json.loads(shown[0].data)["pose"]["orientation"]
    assert sum(turned[axis] ** 2 for axis in "xyzw") == pytest.approx(1.0)


def test_a_laser_scan_and_a_pose_in_space_are_drawn_as_they_are(shown):
    told = {message.topic: json.loads(message.data) for message in shown}
    scan = told["/viewer/a/laser"]
    assert (scan["start_angle"], scan["end_angle"]) == (-0.5, 0.5)
    assert (scan["ranges"], scan["intensities"]) == ([0.5, 4.0, 0.0], [1.0, 0.0, 0.0])
    assert told["/viewer/a/place"]["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}


def test_a_ring_of_sensors_is_a_scan_that_says_where_something_is_seen(shown):
    told = {message.topic: json.loads(message.data) for message in shown}
    ring = told["/viewer/a/ir"]
    step = (ring["end_angle"] - ring["start_angle"]) / (len(ring["ranges"]) - 1)
    assert math.degrees(step) == pytest.approx(3.0)
    seen = [(n, it) for n, (it, seen) in enumerate(zip(ring["ranges"], ring["intensities"], strict=True)) if seen]
    assert [it for _, it in seen] == [0.1, 0.2] and set(ring["ranges"]) == {0.1, 0.2, 0.3}
    for (place, _), bearing in zip(seen, (0.0, 1.0), strict=True):
        assert ring["start_angle"] + place * step == pytest.approx(bearing, abs=step / 2)
    assert told["/viewer/a/sonar"]["ranges"] == [0.5] and told["/viewer/a/sonar"]["intensities"] == [1.0]


def test_what_is_said_in_the_log_has_its_level(shown):
    said = [json.loads(message.data) for message in shown if message.topic == "/viewer/a/log"]
    assert [(it["level"], it["message"], it["name"]) for it in said] == [
        (3, "the lid is open", "a/client/Watch"),
        (2, "task started: service client, task Watch", "a/client"),
    ]


def test_a_file_says_that_its_messages_and_schemas_are_json(shown, tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    for message in shown:
        writer.add(*message)
    writer.close()
    with (tmp_path / "r.mcap").open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"json"}
    assert {channel.topic for channel in summary.channels.values()} == {
        "/viewer/a/ir", "/viewer/a/laser", "/viewer/a/log", "/viewer/a/place", "/viewer/a/pose",
            "/viewer/a/pose/path", "/viewer/a/pose/transform",
        "/viewer/a/sonar", "/viewer/a/world",
    }  # fmt: skip
