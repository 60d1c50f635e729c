"""The Metrics Service: Prometheus text about the agent, on a port of this machine.

[service.metrics]
type = "metrics"
settings = { port = 9464 }
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from pancakes.errors import PancakesError, needing_extra
from pancakes.events import Event
from pancakes.packet import LOG, SYSTEM, Packet, agent_of
from pancakes.runtime.kernel.handlers import on
from pancakes.runtime.kernel.keep import queue
from pancakes.runtime.kernel.task_timer import TaskTimer
from pancakes.service import Service


class MetricsService(Service):
    """Serves metrics over HTTP, in a thread of its own; what an agent does is counted where it happens.

    Attributes:
        port: the port that it is served at, once it is.
    """

    @dataclass
    class Settings:
        """Where it is served.

        Attributes:
            port: the port on 127.0.0.1; 0 takes a free one, which `log` tells.
        """

        port: Annotated[int, Meta(ge=0, le=65535)] = 9464

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._close: Callable[[], None] = lambda: None
        self.port = 0

    def on_start(self) -> None:
        if self.kernel.virtual is not None:
            raise PancakesError(f"{self.address} serves no metrics in virtual time, where no second is a second")
        with needing_extra("there are no metrics"):
            from pancakes.tools.metrics.collector import AgentMetrics
            from pancakes.tools.metrics.metrics_server import HOST, MetricsServer
        self._metrics = AgentMetrics(self.kernel)
        try:
            server = MetricsServer(self.settings.port, self._metrics.registry)
        except OSError as error:
            where = f"{HOST}:{self.settings.port}"
            raise PancakesError(f"{self.address} cannot serve at {where}: {error.strerror or error}") from None
        self.port = server.port
        self._close = server.close
        self.kernel.hear_lateness(self._late)
        self.log("info", f"metrics are at http://{HOST}:{self.port}/metrics")

    def _late(self, tick: tuple[TaskTimer, float]) -> None:
        self._metrics.ticked(*tick)

    @on(LOG, Event, keep=queue(4096))
    def on_event(self, packet: Packet) -> None:
        """Counts what events tell of."""
        if agent_of(packet.source) == self.agent:
            self._metrics.happened(packet.source, packet.body)

    @on(SYSTEM, "battery", keep="latest")
    def on_battery(self, packet: Packet) -> None:
        """Remembers what is left of this agent's battery."""
        if agent_of(packet.source) == self.agent:
            self._metrics.battery_level = packet.body.level

    def on_stop(self) -> None:
        self.kernel.unhear_lateness(self._late)
        self._close()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self.on_stop()
