"""Find agents that were lost: killed, or without power. Their recordings end, and others lose the link. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from pancakes.events import Event
from pancakes.packet import LOG, Packet, agent_of

BEFORE_S: Final = 1.0
"""The clocks of two recordings may differ by this much: others notice a loss after it happened."""
NOTICED_S: Final = 30.0
"""A link that ends later than this after the end of a recording says nothing about that end."""
IN_ORDER: Final = (" stopped", " sleeps", " has no use for it", "this agent said goodbye")
"""What the reason says if a link ends in order."""
MOST_REPORTS: Final = 1000


@dataclass(frozen=True)
class AgentLoss:
    """An agent that was lost.

    Attributes:
        agent: the agent.
        at_s: when its recording ends.
        noticed: what others reported, as a sentence.
    """

    agent: str
    at_s: float
    noticed: str


@dataclass(frozen=True)
class _Report:
    """What another agent reported of a loss; `reason` of a link that ended, empty if a task was taken over."""

    t_s: float
    by: str
    reason: str


@dataclass
class Losses:
    """The agents that were lost.

    Attributes:
        losses: the losses, in the order in which they were found.
    """

    losses: list[AgentLoss] = field(default_factory=list)
    _seen_s: dict[str, float] = field(default_factory=dict)
    _ends: set[str] = field(default_factory=set)
    _reports: dict[str, list[_Report]] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Take a packet that was seen on an agent."""
        before_s, self._seen_s[agent] = self._seen_s.get(agent), t_s
        body = packet.body
        if packet.channel != LOG or not isinstance(body, Event) or agent_of(packet.source) != agent:
            return
        if body.kind == "recording_started":
            if before_s is not None:
                self._end(agent, before_s)
            self._ends.discard(agent)
        elif body.kind == "asked" and body.fields.get("what") == "shutdown":
            self._ends.add(agent)
        elif body.kind == "peer_down":
            reason = str(body.fields.get("reason", ""))
            if not any(words in reason for words in IN_ORDER):
                self._report(str(body.fields.get("peer", "")), _Report(t_s, agent, reason))
        elif body.kind == "taken_over":
            self._report(str(body.fields.get("source_agent", "")), _Report(t_s, agent, ""))

    def _report(self, lost: str, report: _Report) -> None:
        reports = self._reports.setdefault(lost, [])
        if lost != report.by and len(reports) < MOST_REPORTS:
            reports.append(report)

    def close(self) -> None:
        """End the recording: an agent whose recording ends before others notice that it is gone was lost then."""
        for agent, seen_s in self._seen_s.items():
            self._end(agent, seen_s)

    def _end(self, agent: str, at_s: float) -> None:
        """Take the end of a recording."""
        noticed = [it for it in self._reports.pop(agent, ()) if at_s - BEFORE_S <= it.t_s <= at_s + NOTICED_S]
        if not noticed or agent in self._ends:
            return
        by = " and ".join(sorted({it.by for it in noticed if it.reason}))
        reason = next((it.reason for it in noticed if it.reason), "")
        said = f"the link to it ended on {by} ({reason})" if by else f"{noticed[0].by} had its task taken over"
        self.losses.append(AgentLoss(agent, at_s, f"{agent} was lost: its recording ends here, and {said}"))
