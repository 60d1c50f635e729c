"""The ways back to the tiny nodes of an agent: a line notes them, and what commands a node uses them."""

from __future__ import annotations

from pancakes_sensor_field.lines import Reply


class Wires:
    """How each node was answered last, by its name. Any thread; of one node, one line at a time notes."""

    def __init__(self) -> None:
        self._replies: dict[str, Reply] = {}

    def note(self, node: str, reply: Reply) -> None:
        """A node has spoken, and can be answered so."""
        self._replies[node] = reply

    def forget(self, node: str) -> None:
        """The line of a node is gone."""
        self._replies.pop(node, None)

    def send(self, node: str, data: bytes) -> bool:
        """Send bytes to a node; returns whether there is a way to it."""
        reply = self._replies.get(node)
        if reply is None:
            return False
        try:
            reply(data)
        except OSError:  # the line has gone since; its thread says so
            return False
        return True

    def close(self) -> None:
        """Forget all of them."""
        self._replies.clear()
