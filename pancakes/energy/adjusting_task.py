"""Base of tasks that adjust other tasks: it publishes a decider's orders on `sysctrl` and returns the replies."""

from __future__ import annotations

from collections.abc import Sequence

from pancakes.control import Reply
from pancakes.energy.orders import Decider, Order
from pancakes.errors import PancakesError
from pancakes.events import Event
from pancakes.packet import LOG, SYSCTRL, Packet, agent_of
from pancakes.task import Task, on


class AdjustingTask(Task):
    """A task that adjusts others; a subclass sets `decider` in `on_start`."""

    decider: Decider

    def on_stop(self) -> None:
        if not self.kernel.stopping:  # where all tasks end, no task is left that could take an order
            self.give_last(self.decider.give_back(self.now()))

    def give(self, orders: Sequence[Order]) -> None:
        """Publishes orders."""
        for order in orders:
            packet = self.publish(SYSCTRL, order.body)
            self.decider.asked(packet.seq, order, self.now())

    def give_last(self, orders: Sequence[Order]) -> None:
        """Publishes the orders of a task that ends. The log names a mailbox that refuses one."""
        try:
            self.give(orders)
        except PancakesError as error:
            self.log("warning", f"not everything was set back: {error}")

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, packet: Packet) -> None:
        """Hears what became of an order."""
        if packet.cause is None:
            return
        reply: Reply = packet.body
        for sentence in self.decider.answered(packet.cause[1], reply.ok, reply.reason, reply.result):
            self.log("warning", sentence)

    @on(LOG, Event)
    def happened(self, packet: Packet) -> None:
        """Hears of tasks and services that start and stop."""
        if agent_of(packet.source) == self.agent:
            self.decider.happened(packet.body.kind, packet.body.fields)
