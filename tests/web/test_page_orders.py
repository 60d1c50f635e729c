"""What a page may ask for is checked word for word."""

from typing import Any

import pytest

from pancakes.control import Migrate, Reschedule, Restart, Start, Stop
from pancakes.errors import ControlRefused
from pancakes.tools.web.page_orders import order_from

TASK = {"agent": "a", "task": "client/T"}


@pytest.mark.parametrize(
    ("message", "body"),
    [
        ({"do": "migrate", "to": "b", "dry_run": True}, Migrate("client/T", "b", dry_run=True)),
        ({"do": "rate", "rate_hz": 2}, Reschedule("client/T", 2.0)),
        ({"do": "stop"}, Stop("client/T")),
        ({"do": "start"}, Start("client/T")),
        ({"do": "restart"}, Restart("client/T")),
    ],
)
def test_a_message_becomes_a_control_packet(message: dict[str, Any], body: Any):
    order = order_from({**TASK, **message})

    assert order.agent == "a"
    assert order.body() == body


@pytest.mark.parametrize(
    "message",
    [
        {"do": "shutdown"},
        {"do": "stop", "task": "T"},
        {"do": "stop", "task": "client/T/x"},
        {"do": "stop", "agent": ""},
        {"do": "stop", "agent": 7},
        {"do": "rate", "rate_hz": -1},
        {"do": "rate", "rate_hz": "fast"},
        {"do": "migrate"},
        {"do": "stop", "force": True},
        {},
    ],
)
def test_anything_else_is_refused_with_a_sentence(message: dict[str, Any]):
    with pytest.raises(ControlRefused, match="the page asked for what it cannot have"):
        order_from({**TASK, **message})
