"""What an agent says of one of its tasks, in short."""

from __future__ import annotations

import msgspec

from pancakes.packet import join


class TaskRow(msgspec.Struct, frozen=True, kw_only=True):
    """A task that an agent has; a device is a task too.

    Attributes:
        agent, service, task: where it is, and its name.
        type: the name of its class, such as `sim.battery`.
        state: `running`, `stopped`, `failed` and so on.
        rest: why it rests, in a word, where its agent knows more than its state says; else empty.
        reason: why it stopped or failed, as a sentence; else empty.
        rate_hz: ticks for each second of mission time; None: it has no timer.
        ticks, missed: how many came since it began, and how many did not, as it was late.
        lateness_max_s: how late one came at most, in seconds.
        dropped: how many packets it has lost, as it was too slow for them.
        incarnation: how often it began.
    """

    agent: str
    service: str
    task: str
    type: str
    state: str
    rest: str = ""
    reason: str = ""
    rate_hz: float | None = None
    ticks: int = 0
    missed: int = 0
    lateness_max_s: float = 0.0
    dropped: int = 0
    incarnation: int = 0

    @property
    def address(self) -> str:
        """Its address, `agent/service/task`."""
        return join(self.agent, self.service, self.task)

    def __str__(self) -> str:
        return self.address
