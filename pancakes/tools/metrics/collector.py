"""The metrics of an agent: some are counted as things happen, the others are read at each request."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, Final

from prometheus_client import CollectorRegistry, Counter, GCCollector, Histogram, PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from pancakes.events import Event
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.mailbox import Runnable
from pancakes.runtime.kernel.task_timer import TaskTimer
from pancakes.runtime.life.life import State

BUCKETS_S: Final = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


TIMER: Final = "agent service task timer"
GUARDED: Final = "agent service task"
MAILBOX: Final = "agent service task channel"
FAMILIES: Final[Sequence[tuple[str, Any, str, str]]] = (
    ("task_rate_hertz", GaugeMetricFamily, "The rate that was asked for.", TIMER),
    ("task_ticks", CounterMetricFamily, "Ticks so far.", TIMER),
    ("task_missed_ticks", CounterMetricFamily, "Ticks that were left out.", TIMER),
    ("mailbox_waiting_packets", GaugeMetricFamily, "Packets that wait.", MAILBOX),
    ("mailbox_handled_packets", CounterMetricFamily, "Packets taken out.", MAILBOX),
    ("mailbox_dropped_packets", CounterMetricFamily, "Packets that a reader wanted and lost.", MAILBOX),
    ("task_running", GaugeMetricFamily, "Whether a task runs.", "agent service task"),
    ("task_starts", CounterMetricFamily, "How often a task was started.", "agent service task"),
    ("guard_permit_seconds", GaugeMetricFamily, "For how long a guarded task may act yet.", GUARDED),
    ("guard_answering_guardians", GaugeMetricFamily, "Guardians that have answered within a lease.", GUARDED),
    ("guard_wanted_guardians", GaugeMetricFamily, "Guardians that a task is to have.", GUARDED),
    (
        "guard_checkpoint_age_seconds",
        GaugeMetricFamily,
        "How long ago a task was known to be as the checkpoint says that more than half of its guardians have.",
        GUARDED,
    ),
    ("link_round_trip_seconds", GaugeMetricFamily, "Round trip of a link, smoothed.", "agent peer"),
    ("link_sent_packets", CounterMetricFamily, "Packets sent.", "agent peer"),
    ("link_received_packets", CounterMetricFamily, "Packets received.", "agent peer"),
    ("link_sent_bytes", CounterMetricFamily, "Bytes sent.", "agent peer"),
    ("link_received_bytes", CounterMetricFamily, "Bytes received.", "agent peer"),
    ("link_waiting_packets", GaugeMetricFamily, "Packets that wait for a peer.", "agent peer"),
    ("link_dropped_packets", CounterMetricFamily, "Packets that a slow peer missed.", "agent peer channel"),
    ("undelivered_packets", CounterMetricFamily, "Packets that no subscriber took.", "agent"),
    ("dead_letters", CounterMetricFamily, "Packets whose handler failed.", "agent"),
    ("disk_syncs", CounterMetricFamily, "How often the agent has waited until its disk had all (fsync).", "agent"),
    (
        "disk_written_bytes",
        CounterMetricFamily,
        "What the agent has written to its journal.",
        "agent",
    ),
    ("mission_seconds", GaugeMetricFamily, "The agent's mission clock.", "agent"),
    ("battery_level_ratio", GaugeMetricFamily, "What is left of the battery.", "agent"),
)
"""What is read at each request: its name, its kind, what it is, and its labels."""

_Value = tuple[str, list[str], float]
"""The name of a metric, the values of its labels, and its own value."""


class AgentMetrics(Collector):
    """All metrics of one agent.

    Args:
        kernel: the agent's kernel.

    Attributes:
        registry: what Prometheus' exposition reads.
        battery_level: what the agent's battery last said, from 0 to 1; None before that.
    """

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self.battery_level: float | None = None
        self.registry = CollectorRegistry()
        # First, because it forgets what the others shall no longer tell.
        self.registry.register(self)
        self._lateness = Histogram(
            "pancakes_task_lateness_seconds",
            "How late ticks of time-driven tasks were, in mission time.",
            ["agent", "service", "task", "timer"],
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self._late: dict[TaskTimer, Any] = {}
        self._migrations = Counter(
            "pancakes_migrations", "Moves of tasks away from this agent.", ["agent", "outcome"], registry=self.registry
        )
        self._arrivals = Counter(
            "pancakes_task_arrivals", "Tasks that came from other agents.", ["agent"], registry=self.registry
        )
        self._takeovers = Counter(
            "pancakes_guard_takeovers",
            "How often this agent took over a guarded task whose agent was lost.",
            ["agent", "service", "task"],
            registry=self.registry,
        )
        self._failures = Counter(
            "pancakes_task_failures",
            "Tasks that ended by an error.",
            ["agent", "service", "task", "then"],
            registry=self.registry,
        )
        self._requests = Counter(
            "pancakes_control_changes",
            "Changes that were asked for by control packets.",
            ["agent", "kind"],
            registry=self.registry,
        )
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        GCCollector(registry=self.registry)

    # As it happens ---------------------------------------------------------------------------------------------

    def ticked(self, timer: TaskTimer, lateness_s: float) -> None:
        """Counts a tick. In the task's turn: the labels are looked up once."""
        child = self._late.get(timer)
        if child is None:
            child = self._late[timer] = self._lateness.labels(*_place(timer.component), timer.method)
        child.observe(lateness_s)

    def happened(self, source: str, event: Event) -> None:
        """Counts what an event of this agent tells of; `source` is the address that told it."""
        agent, fields = self._kernel.agent, event.fields
        service = (*source.split("/"), "")[1]  # a service tells what becomes of its own tasks
        if event.kind == "migration" and fields["source"] == agent and not fields.get("dry_run"):
            self._migrations.labels(agent, fields["outcome"]).inc()
        elif event.kind == "task_arrived":
            self._arrivals.labels(agent).inc()
        elif event.kind == "task_taken":
            self._takeovers.labels(agent, service, fields["task"]).inc()
        elif event.kind == "task_failed":
            self._failures.labels(agent, service, fields["task"], fields["then"]).inc()
        elif event.kind in ("asked", "rate_changed", "settings_changed"):
            self._requests.labels(agent, str(fields.get("what", event.kind))).inc()

    # When it is asked for --------------------------------------------------------------------------------------

    def collect(self) -> Iterator[Metric]:
        """Reads the rest. In the thread of the HTTP server."""
        self._forget()
        families = {
            name: kind(f"pancakes_{name}", text, labels=labels.split()) for name, kind, text, labels in FAMILIES
        }
        parts = (self._timers(), self._mailboxes(), self._tasks(), self._guards(), self._links(), self._agent())
        for name, where, value in chain(*parts):
            families[name].add_metric(where, value)
        yield from families.values()

    def describe(self) -> Iterator[Metric]:
        """Tells nothing beforehand: what there is, depends on the agent."""
        return iter(())

    def _forget(self) -> None:
        """Forgets the ticks of tasks that have ended: names that come and go must not fill the memory."""
        alive = set(self._kernel.task_timers.all())
        known = {timer: (*_place(timer.component), timer.method) for timer in list(self._late)}
        kept = {where for timer, where in known.items() if timer in alive}
        for timer, where in known.items():
            if timer not in alive:
                self._late.pop(timer, None)
                if where not in kept:
                    self._lateness.remove(*where)

    def _timers(self) -> Iterator[_Value]:
        for timer in self._kernel.task_timers.all():
            where = [*_place(timer.component), timer.method]
            yield "task_rate_hertz", where, timer.rate_hz
            yield "task_ticks", where, timer.ticks
            yield "task_missed_ticks", where, timer.missed_total

    def _mailboxes(self) -> Iterator[_Value]:
        for component in self._kernel.registry.components():
            for channel, box in list(component.actor_inbox.queues.items()):
                where = [*_place(component), channel]
                yield "mailbox_waiting_packets", where, len(box)
                yield "mailbox_handled_packets", where, box.handled
                yield "mailbox_dropped_packets", where, box.dropped()

    def _tasks(self) -> Iterator[_Value]:
        for task in self._kernel.tasks.all():
            where = [self._kernel.agent, task.service, task.name]
            yield "task_running", where, task.life.state is State.RUNNING
            yield "task_starts", where, task.life.incarnation

    def _guards(self) -> Iterator[_Value]:
        now_s = self._kernel.host.now()
        for address, note in self._kernel.guard_notes.all().items():
            where = address.split("/")
            self._takeovers.labels(*where)  # one that was never taken over is told as such
            yield "guard_permit_seconds", where, self._kernel.permits.left_s(note.right) or 0.0
            yield "guard_answering_guardians", where, note.answering(now_s)
            yield "guard_wanted_guardians", where, note.number
            age_s = note.age_s(now_s)
            if age_s is not None:
                yield "guard_checkpoint_age_seconds", where, age_s

    def _links(self) -> Iterator[_Value]:
        for peer in self._kernel.links():
            where = [self._kernel.agent, peer["name"]]
            if peer["rtt_s"] is not None:
                yield "link_round_trip_seconds", where, peer["rtt_s"]
            yield "link_sent_packets", where, peer["packets_out"]
            yield "link_received_packets", where, peer["packets_in"]
            yield "link_sent_bytes", where, peer["bytes_out"]
            yield "link_received_bytes", where, peer["bytes_in"]
            yield "link_waiting_packets", where, sum(peer["waiting"].values())
            for channel, count in peer["dropped"].items():
                yield "link_dropped_packets", [*where, channel], count

    def _agent(self) -> Iterator[_Value]:
        kernel = self._kernel
        yield "undelivered_packets", [kernel.agent], kernel.stream.undelivered
        yield "dead_letters", [kernel.agent], kernel.dead_letters.count
        syncs, written_bytes = kernel.disk_use()
        yield "disk_syncs", [kernel.agent], syncs
        yield "disk_written_bytes", [kernel.agent], written_bytes
        yield "mission_seconds", [kernel.agent], kernel.mission.now()
        if self.battery_level is not None:
            yield "battery_level_ratio", [kernel.agent], self.battery_level


def _place(component: Runnable) -> tuple[str, str, str]:
    """Returns agent, service and task of a component; of a service the task is empty."""
    agent, service, task = (*component.address.split("/"), "", "")[:3]
    return agent, service, task
