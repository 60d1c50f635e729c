"""Base of tasks that adjust other tasks: it publishes a decider's orders on `sysctrl` and passes the replies to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pancakes.control import Reply
from pancakes.energy.orders import Decider, Order
from pancakes.errors import PancakesError
from pancakes.events import Event
from pancakes.packet import LOG, SYSCTRL, Packet, agent_of
from pancakes.task import Task, on


class AdjustingTask(Task):
    """Adjust other tasks. A subclass sets `decider` in `on_start`; its state has `turned`, which outlives a restart."""

    decider: Decider
    state: Any

    def on_stop(self) -> None:
        if not self._actor.kernel.stopping:  # if the whole agent stops, no task is left to take an order
            self.restore()

    def publish_orders(self, orders: Sequence[Order]) -> None:
        """Publish orders, and keep whether any knob was ever turned."""
        for order in orders:
            packet = self.publish(SYSCTRL, order.body)
            self.decider.asked(packet.seq, order, self.now())
        self.state.turned = self.state.turned or self.decider.book.turned

    def restore(self) -> None:
        """Publish the orders that restore everything. A mailbox that refuses one is logged."""
        try:
            self.publish_orders(self.decider.restore(self.now()))
        except PancakesError as error:
            self.log("warning", f"not everything was set back: {error}")

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, packet: Packet) -> None:
        """Take the reply to an order."""
        if packet.cause is None:
            return
        reply: Reply = packet.body
        for sentence in self.decider.answered(packet.cause[1], reply.ok, reply.reason, reply.result):
            self.log("warning", sentence)

    @on(LOG, Event)
    def note_event(self, packet: Packet) -> None:
        """Take the events of this agent: tasks and services that start and stop."""
        if agent_of(packet.source) == self.agent:
            self.decider.on_event(packet.body.kind, packet.body.fields)
