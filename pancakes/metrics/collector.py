"""The metrics of an agent: some are counted as things happen, the others are read at each request."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from prometheus_client import CollectorRegistry, Counter, GCCollector, Histogram, PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from pancakes.events import Event
from pancakes.kernel.component import Component
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Runnable
from pancakes.kernel.task_timer import TaskTimer
from pancakes.life.life import State
from pancakes.packet import join
from pancakes.service import Service
from pancakes.services.network import NetworkService

BUCKETS_S: Final = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


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
        if event.kind == "migration" and not fields.get("dry_run"):
            self._migrations.labels(agent, fields["outcome"]).inc()
        elif event.kind == "task_arrived":
            self._arrivals.labels(agent).inc()
        elif event.kind == "task_failed":
            service = (*source.split("/"), "")[1]  # a service tells it of its own tasks
            self._failures.labels(agent, service, fields["task"], fields["then"]).inc()
        elif event.kind in ("asked", "rate_changed", "settings_changed"):
            self._requests.labels(agent, str(fields.get("what", event.kind))).inc()

    # When it is asked for --------------------------------------------------------------------------------------

    def collect(self) -> Iterator[Metric]:
        """Reads the rest. In the thread of the HTTP server."""
        components = self._kernel.registry.components()
        self._forget(components)
        yield from self._timers(components)
        yield from self._mailboxes(components)
        yield from self._tasks(components)
        yield from self._links()
        yield from self._agent()

    def describe(self) -> Iterator[Metric]:
        """Tells nothing beforehand: what there is, depends on the agent."""
        return iter(())

    def _forget(self, components: list[Component]) -> None:
        """Forgets the ticks of tasks that have ended: names that come and go must not fill the memory."""
        alive = {timer for component in components for timer in list(component.timers.values())}
        known = {timer: (*_place(timer.component), timer.method) for timer in list(self._late)}
        kept = {where for timer, where in known.items() if timer in alive}
        for timer, where in known.items():
            if timer not in alive:
                self._late.pop(timer, None)
                if where not in kept:
                    self._lateness.remove(*where)

    def _timers(self, components: list[Component]) -> Iterator[Metric]:
        labels = ["agent", "service", "task", "timer"]
        rate = GaugeMetricFamily("pancakes_task_rate_hertz", "The rate that was asked for.", labels=labels)
        ticks = CounterMetricFamily("pancakes_task_ticks", "Ticks so far.", labels=labels)
        missed = CounterMetricFamily("pancakes_task_missed_ticks", "Ticks that were left out.", labels=labels)
        for component in components:
            for timer in list(component.timers.values()):
                where = [*_place(component), timer.method]
                rate.add_metric(where, timer.rate_hz)
                ticks.add_metric(where, timer.ticks)
                missed.add_metric(where, timer.missed_total)
        yield from (rate, ticks, missed)

    def _mailboxes(self, components: list[Component]) -> Iterator[Metric]:
        labels = ["agent", "service", "task", "channel"]
        waiting = GaugeMetricFamily("pancakes_mailbox_waiting_packets", "Packets that wait.", labels=labels)
        handled = CounterMetricFamily("pancakes_mailbox_handled_packets", "Packets taken out.", labels=labels)
        dropped = CounterMetricFamily(
            "pancakes_mailbox_dropped_packets", "Packets that a reader wanted and lost.", labels=labels
        )
        for component in components:
            for channel, box in list(component.actor_inbox.queues.items()):
                where = [*_place(component), channel]
                waiting.add_metric(where, len(box))
                handled.add_metric(where, box.handled)
                dropped.add_metric(where, box.dropped())
        yield from (waiting, handled, dropped)

    def _tasks(self, components: list[Component]) -> Iterator[Metric]:
        labels = ["agent", "service", "task"]
        running = GaugeMetricFamily("pancakes_task_running", "Whether a task runs.", labels=labels)
        starts = CounterMetricFamily("pancakes_task_starts", "How often a task was started.", labels=labels)
        for service in [component for component in components if isinstance(component, Service)]:
            for slot in list(service.slots.values()):
                where = [service.agent, service.name, slot.name]
                running.add_metric(where, slot.life.state is State.RUNNING)
                starts.add_metric(where, slot.life.incarnation)
        yield from (running, starts)

    def _links(self) -> Iterator[Metric]:
        network = self._kernel.registry.get(join(self._kernel.agent, "network"))
        peers = network.links() if isinstance(network, NetworkService) else []
        labels = ["agent", "peer"]
        trip = GaugeMetricFamily("pancakes_link_round_trip_seconds", "Round trip of a link, smoothed.", labels=labels)
        counted = {
            "packets_out": CounterMetricFamily("pancakes_link_sent_packets", "Packets sent.", labels=labels),
            "packets_in": CounterMetricFamily("pancakes_link_received_packets", "Packets received.", labels=labels),
            "bytes_out": CounterMetricFamily("pancakes_link_sent_bytes", "Bytes sent.", labels=labels),
            "bytes_in": CounterMetricFamily("pancakes_link_received_bytes", "Bytes received.", labels=labels),
        }
        waiting = GaugeMetricFamily("pancakes_link_waiting_packets", "Packets that wait for a peer.", labels=labels)
        dropped = CounterMetricFamily(
            "pancakes_link_dropped_packets", "Packets that a slow peer missed.", labels=[*labels, "channel"]
        )
        for peer in peers:
            where = [self._kernel.agent, peer["name"]]
            if peer["rtt_s"] is not None:
                trip.add_metric(where, peer["rtt_s"])
            for key, family in counted.items():
                family.add_metric(where, peer[key])
            waiting.add_metric(where, sum(peer["waiting"].values()))
            for channel, count in peer["dropped"].items():
                dropped.add_metric([*where, channel], count)
        yield from (trip, *counted.values(), waiting, dropped)

    def _agent(self) -> Iterator[Metric]:
        kernel = self._kernel
        undelivered = CounterMetricFamily(
            "pancakes_undelivered_packets", "Packets that no subscriber took.", labels=["agent"]
        )
        undelivered.add_metric([kernel.agent], kernel.stream.undelivered)
        dead = CounterMetricFamily("pancakes_dead_letters", "Packets whose handler failed.", labels=["agent"])
        dead.add_metric([kernel.agent], kernel.letters.count)
        mission = GaugeMetricFamily("pancakes_mission_seconds", "The agent's mission clock.", labels=["agent"])
        mission.add_metric([kernel.agent], kernel.mission.now())
        level = GaugeMetricFamily("pancakes_battery_level_ratio", "What is left of the battery.", labels=["agent"])
        if self.battery_level is not None:
            level.add_metric([kernel.agent], self.battery_level)
        yield from (undelivered, dead, mission, level)


def _place(component: Runnable) -> tuple[str, str, str]:
    """Returns agent, service and task of a component; of a service the task is empty."""
    agent, service, task = (*component.address.split("/"), "", "")[:3]
    return agent, service, task
