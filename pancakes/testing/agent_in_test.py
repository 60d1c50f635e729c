"""One agent in a test, in virtual time or on threads."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final

from msgspec.structs import replace

from pancakes.events import LogLine
from pancakes.mesh.address import LOCAL
from pancakes.packet import LOG, covers, join
from pancakes.runtime.agent import Agent
from pancakes.runtime.config import Config
from pancakes.runtime.hosting.bidding_messages import MIGRATOR
from pancakes.runtime.supervision.slot import Slot
from pancakes.service import Service
from pancakes.simulation.agent_handle import PATIENCE_S, AgentHandle
from pancakes.simulation.made_in_code import parts, registered
from pancakes.simulation.probe import Probe

OWN: Final = ("client", "device", "log", "network", MIGRATOR)
"""Pancakes' own actors, by their addresses on an agent, besides those at `kernel` and below it."""


class AgentInTest(AgentHandle):
    """One agent, and what a test asks of it; what does not come in time fails the test.

    Attributes:
        may_fail: those of Pancakes' own actors that the test itself makes fail: `client`, `kernel/Courier`. Where
            another one of these fails, `FleetInTest` and `threaded_agent` fail the test at its end.
    """

    failure: ClassVar[type[Exception]] = AssertionError

    def __init__(self, agent: Agent, probe: Probe) -> None:
        super().__init__(agent, probe)
        self.may_fail: set[str] = set()
        self._outcomes: list[BaseException] = []
        agent.kernel.unraised = self._outcomes.append

    def raise_outcome(self) -> None:
        """Ends the test as a task on a thread has asked for, by `pytest.fail` or `pytest.skip`."""
        outcomes = sys.modules.get("_pytest.outcomes")  # the tests may be run by something else
        for error in self._outcomes:
            if outcomes is not None and isinstance(error, outcomes.OutcomeException):
                raise error

    def failures(self) -> list[str]:
        """Returns how Pancakes' own actors on this agent have failed that may not. Tasks and a user's services may."""
        own, kernel = [join(self.name, actor) for actor in OWN], join(self.name, "kernel")
        may = {join(self.name, actor) for actor in self.may_fail}
        failures = []
        for packet in self.probe.packets(LogLine, lambda line: bool(line.traceback)):
            address = packet.body.text.partition(" ")[0]
            if address not in may and (address in own or covers(kernel, address)):
                failures.append(packet.body.text)
        return failures

    def slot(self, name: str, service: str = "client") -> Slot:
        """Returns the place of a task in its service."""
        owner = self.component(service)
        assert isinstance(owner, Service), f"{self.name} has no service {service}"
        return owner.slots[name]

    def log_tail(self, count: int = 30) -> str:
        """Returns the last lines and events on its `log`, one a line, as `pancakes log` shows them."""
        from click import unstyle  # only where something went wrong

        from pancakes.runtime.services.log import record_of
        from pancakes.tools.cli.verbs.log import text_of

        return "\n".join(unstyle(text_of(record_of(packet))) for packet in self.probe.packets(channel=LOG)[-count:])

    def stop(self) -> None:
        """Stops the agent in good order."""
        self.agent.stop()

    def left(self) -> list[str]:
        """Returns the addresses of the services and tasks that still run although the agent has ended."""
        if not self.agent.stopping.is_set():
            return [f"{self.name} (the whole agent)"]
        own = (join(self.name, "kernel"), join(self.name, "test"))  # these end with the kernel's threads
        return [
            component.address
            for component in self.kernel.registry.components()
            if not component.actor_stopped.is_set() and not any(covers(place, component.address) for place in own)
        ]


def assert_none_failed(agents: Iterable[AgentInTest]) -> None:
    """Fails a test in which actors of Pancakes' own have failed that may not."""
    failures = [failure for agent in agents for failure in agent.failures()]
    assert not failures, "\n".join(["actors of Pancakes' own have failed, and are not in `may_fail`:", *failures])


@contextmanager
def threaded_agent(
    name: str = "a",
    text: str = "",
    *,
    tasks: Mapping[str, Any] | None = None,
    devices: Mapping[str, Any] | None = None,
    services: Mapping[str, Any] | None = None,
    classes: Mapping[str, type] | None = None,
    state_dir: Path | None = None,
    **agent: Any,
) -> Iterator[AgentInTest]:
    """Runs an agent on threads and in real time, as on a robot, and stops it at the end of the `with`.

    Args:
        name, text, tasks, devices, services, agent: as for `FleetInTest.start`. It listens at `local://NAME`
            as well, where the other agents of this process find it.
        classes: classes that `text` names, by name.
        state_dir: its state directory; None: one that is removed afterwards.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-test-") as directory:
        agent = {"state_dir": str(state_dir or Path(directory) / name), **agent}
        made = parts(name, text, tasks, devices, services, agent)
        found = AgentInTest.on(Agent(_apart(made.config), registered({**(classes or {}), **made.classes})))
        found.agent.start()
        try:
            assert found.agent.ready.wait(PATIENCE_S), f"{name} was not ready within {PATIENCE_S:g} s"
            yield found
        except AssertionError:  # often because the test waited for a task that has ended it
            found.raise_outcome()
            raise
        finally:
            found.stop()
        found.raise_outcome()
        assert_none_failed([found])


@cache
def _sockets() -> tempfile.TemporaryDirectory[str]:
    """Returns where agents of this process find each other, apart from all others of the machine."""
    return tempfile.TemporaryDirectory(prefix="pancakes-test-")


def _apart(config: Config) -> Config:
    network = config.services["network"]
    transports = network.settings.get("transports", {})
    local = {"directory": _sockets().name, **transports.get(LOCAL, {})}
    settings = {**network.settings, "transports": {**transports, LOCAL: local}}
    return replace(config, services={**config.services, "network": replace(network, settings=settings)})
