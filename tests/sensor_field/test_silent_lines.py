"""A line whose other end has gone without a word is opened again."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from pancakes_sensor_field.drivers import TcpNodes

from pancakes.mesh.transport import Connection, ConnectionHandler
from pancakes.testing import Fleet

LINE = "tcp://127.0.0.1:7421"


class Ends(ConnectionHandler):
    """Takes connections, and notes each."""

    def __init__(self) -> None:
        self.stand: list[Connection] = []

    def opened(self, connection: Connection) -> None:
        self.stand.append(connection)

    def received(self, data: bytes) -> None:
        """Nobody listens."""

    def closed(self, reason: str) -> None:
        """It may."""


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5) as made:
        yield made


def test_a_line_that_says_nothing_is_opened_again_and_that_is_told_once(fleet: Fleet) -> None:
    server, ends = fleet.start("server"), Ends()
    server.kernel.transport.listen(LINE, lambda: ends)
    settings = {"address": LINE, "nodes": {"shed": 1}, "line_silent_s": 10.0}
    gateway = fleet.start("gateway", devices={"line": {"type": TcpNodes, "rate_hz": 1.0, "settings": settings}})
    fleet.run_for(35.0)
    assert len(ends.stand) == 4
    told = [line for line in gateway.lines("warning") if "nothing has come from" in line]
    assert told == [f"line: nothing has come from the line at {LINE} for 10 s: it is opened again"]
    ends.stand[-1].send(b"\0noise")
    fleet.run_for(2.0)
    assert f"line: the line at {LINE} sends again" in gateway.lines("info")
    assert not gateway.lines("error")
