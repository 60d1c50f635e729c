"""A task with a large state migrates: its state crosses the link once."""

from dataclasses import dataclass

from services.counting import Count

from pancakes.control import Migrate
from pancakes.durable.messages import Piece
from pancakes.durable.record import TaskId
from pancakes.packet import Packet
from pancakes.testing import Fleet

SIZE_BYTES = 1024 * 1024


class Heavy(Count):
    """Counts its ticks, and carries much."""

    @dataclass
    class State:
        n: int = 0
        load: bytes = b"x" * SIZE_BYTES


def test_large_state_crosses_the_link_once():
    sent: list[Piece] = []

    def watch(packet: Packet) -> None:
        if isinstance(packet.body, Piece):
            sent.append(packet.body)

    with Fleet(seed=5, classes={"test.Heavy": Heavy}) as fleet:
        a = fleet.start("a", tasks={"Heavy": {"type": Heavy}})
        b = fleet.start("b")
        fleet.connect()
        fleet.run_for(1.0)
        a.kernel.stream.tap_outgoing(watch)
        assert a.ask(Migrate("Heavy", to="b")).ok
        assert fleet.run_until(lambda: b.running() == ["Heavy"], 5.0)
        fleet.run_for(3.0)
    assert {piece.task_id for piece in sent} == {TaskId("a", "Heavy")}
    assert sum(len(piece.data) for piece in sent) == sent[0].size_bytes
