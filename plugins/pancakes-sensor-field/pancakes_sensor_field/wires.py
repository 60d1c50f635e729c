"""The ways back to the tiny nodes of an agent: lines note them, and commands to a node use them."""

from __future__ import annotations

from pancakes_sensor_field.lines import Reply


class Wires:
    """How to reply to each node, by its name. Any thread."""

    def __init__(self) -> None:
        self._replies: dict[str, Reply] = {}

    def note(self, node: str, reply: Reply) -> None:
        """Note how a node that has sent can be answered."""
        self._replies[node] = reply

    def forget(self, node: str) -> None:
        """Forget a node whose line is gone."""
        self._replies.pop(node, None)

    def send(self, node: str, data: bytes) -> bool:
        """Send bytes to a node; return whether there is a way to it."""
        reply = self._replies.get(node)
        if reply is None:
            return False
        try:
            reply(data)
        except OSError:  # the line is gone, which its thread logs
            return False
        return True

    def close(self) -> None:
        """Forget all of them."""
        self._replies.clear()
