"""The Metrics Service: Prometheus text about the agent, on a port of this machine.

[service.metrics]
type = "metrics"
settings = { port = 9464, token = true }
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from pancakes.errors import PancakesError, needing_extra
from pancakes.events import Event
from pancakes.kernel.handlers import on
from pancakes.kernel.timer import HeardTick
from pancakes.packet import LOG, SYSTEM, Packet, agent_of
from pancakes.security.key_store import write_private
from pancakes.service import Service
from pancakes.util.runtime_dir import make_directory, runtime_dir


class MetricsService(Service):
    """Serve metrics over HTTP, in its own thread. Events are counted where they happen.

    Attributes:
        port: the port of the server; 0 before it runs.
    """

    @dataclass
    class Settings:
        """The settings of the server.

        Attributes:
            port: the port on 127.0.0.1; 0 takes a free one, which is logged.
            token: whether a request must have a token, because other users of this machine reach 127.0.0.1 too. The
                token is in the file `metrics-PORT.token` of the runtime directory, which only this user can read; each
                start makes a new one.
        """

        port: Annotated[int, Meta(ge=0, le=65535)] = 9464
        token: bool = False

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._close: Callable[[], None] = lambda: None
        self.port = 0

    def on_start(self) -> None:
        if self._actor.kernel.virtual is not None:
            raise PancakesError(f"{self.address} serves no metrics in virtual time: they need real seconds")
        with needing_extra("there are no metrics"):
            from pancakes.tools.metrics.prometheus import HOST, AgentMetrics, MetricsServer
        self._metrics = AgentMetrics(self._actor.kernel)
        try:
            token = secrets.token_urlsafe(24) if self.settings.token else ""
            server = MetricsServer(self.settings.port, self._metrics.registry, token)
        except OSError as error:
            where = f"{HOST}:{self.settings.port}"
            raise PancakesError(f"{self.address} cannot serve at {where}: {error.strerror or error}") from None
        try:
            shown = self._write_token(token, server.port) if token else ""
        except BaseException:
            server.close()
            raise
        self.port = server.port
        self._close = server.close
        self._actor.kernel.hear_ticks(self._late)
        self.log("info", f"metrics are at http://{HOST}:{self.port}/metrics{shown}")

    def _late(self, heard: HeardTick) -> None:
        timer, tick, _ = heard
        self._metrics.ticked(timer, tick.lateness_s)

    @on(LOG, Event, queue=4096)
    def on_event(self, packet: Packet) -> None:
        """Count events of this agent."""
        if agent_of(packet.source) == self.agent:
            self._metrics.happened(packet.source, packet.body)

    @on(SYSTEM, "battery", queue="latest")
    def on_battery(self, packet: Packet) -> None:
        """Remember the level of this agent's battery."""
        if agent_of(packet.source) == self.agent:
            self._metrics.battery_level = packet.body.level

    def on_stop(self) -> None:
        self._actor.kernel.unhear_ticks(self._late)
        self._close()
        if self.settings.token and self.port:
            _token_file(self.port).unlink(missing_ok=True)

    def _write_token(self, token: str, port: int) -> str:
        path = _token_file(port)
        try:
            make_directory(path.parent)
            write_private(path, token.encode())
        except OSError as error:
            raise PancakesError(f"{self.address} cannot write its token to {path}: {error.strerror}") from None
        return f", for requests with the token in {path}"

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self.on_stop()


def _token_file(port: int) -> Path:
    return runtime_dir() / f"metrics-{port}.token"
