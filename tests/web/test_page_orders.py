"""The orders of a page are checked strictly."""

from typing import Any

import pytest

from pancakes.control import Configure, Drive, EndDrive, EndHalt, Halt, Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefusedError
from pancakes.tools.web.orders import order_from

TASK = {"agent": "a", "task": "client/T"}


@pytest.mark.parametrize(
    ("message", "body"),
    [
        ({"do": "migrate", "to": "b", "dry_run": True}, Migrate("client/T", "b", dry_run=True)),
        ({"do": "rate", "rate_hz": 2}, Reschedule("client/T", 2.0)),
        ({"do": "rate", "rate_hz": 0, "timer": "look", "dry_run": True}, Reschedule("client/T", 0.0, "look", True)),
        (
            {"do": "configure", "settings": {"radius_m": 0.5, "route": [[1, 2.5], []], "legs": {"n": None}}},
            Configure("client/T", {"radius_m": 0.5, "route": [[1, 2.5], []], "legs": {"n": None}}),
        ),
        (
            {"do": "configure", "settings": {"careful": True, "name": "x" * 4000}, "dry_run": True},
            Configure("client/T", {"careful": True, "name": "x" * 4000}, dry_run=True),
        ),
        ({"do": "stop"}, Stop("client/T")),
        ({"do": "start"}, Start("client/T")),
        ({"do": "restart"}, Restart("client/T")),
    ],
)
def test_order_becomes_a_control_packet(message: dict[str, Any], body: Any):
    order = order_from({**TASK, **message})

    assert order.agent == "a"
    assert order.body() == body


@pytest.mark.parametrize(
    ("message", "body"),
    [
        ({"do": "halt"}, Halt()),
        ({"do": "halt", "reason": "a child on the field"}, Halt("a child on the field")),
        ({"do": "end_halt"}, EndHalt()),
    ],
)
def test_halt_of_a_page_becomes_a_control_packet(message: dict[str, Any], body: Any):
    order = order_from({"agent": "a", **message})
    assert (order.agent, order.body()) == ("a", body)


@pytest.mark.parametrize(
    "message",
    [
        {"do": "halt", "task": "client/T"},
        {"do": "halt", "agent": ""},
        {"do": "halt", "reason": "x" * 201},
        {"do": "halt", "dry_run": True},
        {"do": "end_halt", "reason": "x"},
    ],
)
def test_invalid_halt_of_a_page_is_refused(message: dict[str, Any]):
    with pytest.raises(ControlRefusedError, match="the page sent an invalid order"):
        order_from({"agent": "a", **message})


@pytest.mark.parametrize(
    "message",
    [
        {"do": "shutdown"},
        {"do": "stop", "task": "T"},
        {"do": "stop", "task": "client/T/x"},
        {"do": "stop", "agent": ""},
        {"do": "stop", "agent": 7},
        {"do": "rate", "rate_hz": -1},
        {"do": "rate", "rate_hz": 10_001},
        {"do": "rate", "rate_hz": "fast"},
        {"do": "rate", "rate_hz": 1, "timer": "../step"},
        {"do": "rate", "rate_hz": 1, "timer": "x" * 101},
        {"do": "rate", "rate_hz": 1, "settings": {"a": 1}},
        {"do": "stop", "timer": "step"},
        {"do": "stop", "settings": {"a": 1}},
        {"do": "configure"},
        {"do": "configure", "settings": [1]},
        {"do": "configure", "settings": "a=1"},
        {"do": "configure", "settings": {"a": 1}, "rate_hz": 1},
        {"do": "migrate"},
        {"do": "stop", "force": True},
        {},
    ],
)
def test_invalid_order_is_refused(message: dict[str, Any]):
    with pytest.raises(ControlRefusedError, match="the page sent an invalid order"):
        order_from({**TASK, **message})


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        ({}, "settings are empty"),
        ({f"s{number}": 1 for number in range(65)}, "65 settings at once are too many, at most 64 are allowed"),
        ({"a": [0] * 1000}, "settings have more than 1000 values"),
        ({"a": {str(number): number for number in range(600)}}, "settings have more than 1000 values"),
        ({"a": nested(8)}, "settings are nested more than 8 deep"),
        ({"a": nested(900)}, "settings are nested more than 8 deep"),
        ({"a": "x" * 4001}, "a text in settings has more than 4000 characters"),
        ({"x" * 4001: 1}, "a text in settings has more than 4000 characters"),
        ({"a": [2**63]}, "a number in settings is too large"),
        ({"a": -(2**63)}, "a number in settings is too large"),
        ({"a": float("inf")}, "a number in settings is not finite"),
        ({"a": {"b": float("nan")}}, "a number in settings is not finite"),
        ({"a": b"x"}, "a value in settings is a bytes"),
        ({"a": {1: 1}}, "a key of settings is not a text"),
    ],
)
def test_oversized_settings_are_refused(settings: dict[str, Any], fault: str):
    with pytest.raises(ControlRefusedError, match=f"the page sent an invalid order: {fault}"):
        order_from({**TASK, "do": "configure", "settings": settings})


def test_largest_allowed_settings_are_accepted():
    settings = {"a": nested(7), "b": [0] * 900, "c": 2**63 - 1, **{f"s{number}": 1.5 for number in range(40)}}
    order = order_from({**TASK, "do": "configure", "settings": settings})

    assert order.body() == Configure("client/T", settings)


def test_invalid_rate_is_refused():
    with pytest.raises(ControlRefusedError, match="a rate must lie between 0 and 10,000 ticks a second, not -1"):
        order_from({**TASK, "do": "rate", "rate_hz": -1})


ID = "0123456789abcdef"


@pytest.mark.parametrize(
    ("message", "body"),
    [
        ({"do": "drive", "begin": True, "take": True}, Drive("motors", ID, begin=True, take=True)),
        ({"do": "drive", "v_mps": 1, "omega_radps": -0.5}, Drive("motors", ID, 1.0, -0.5)),
        ({"do": "end_drive"}, EndDrive("motors", ID)),
    ],
)
def test_drive_of_a_page_becomes_a_control_packet(message: dict[str, Any], body: Any):
    order = order_from({"agent": "a", "device": "motors", "drive": ID, **message})
    assert (order.agent, order.body()) == ("a", body)


@pytest.mark.parametrize(
    "message",
    [
        {"do": "drive", "device": "client/T"},
        {"do": "drive", "drive": ""},
        {"do": "drive", "drive": "x" * 16},
        {"do": "drive", "drive": "a" * 65},
        {"do": "drive", "v_mps": 1e9},
        {"do": "drive", "v_mps": "fast"},
        {"do": "drive", "dry_run": True},
        {"do": "end_drive", "v_mps": 1.0},
        {"do": "end_drive", "take": True},
    ],
)
def test_invalid_drive_of_a_page_is_refused(message: dict[str, Any]):
    with pytest.raises(ControlRefusedError, match="the page sent an invalid order"):
        order_from({"agent": "a", "device": "motors", "drive": ID, **message})
