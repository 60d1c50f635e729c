"""Lines and events of a log as rcl_interfaces/Log. Pure."""

from __future__ import annotations

from typing import Final

from pancakes.events import Event, LogLine

LOG_LEVELS: Final = {"debug": 10, "info": 20, "warning": 30, "error": 40}
LOG_MESSAGE: Final = "rcl_interfaces/msg/Log"


def log_text(body: LogLine | Event) -> str:
    """Return a line, or an event, as the text of a message."""
    if isinstance(body, LogLine):
        return body.text
    return " ".join([body.kind, *(f"{key}={value}" for key, value in body.fields.items())])
