"""A whole fleet and its world as an object: reset from a seed, step by step, read between the steps."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from msgspec.structs import replace

from pancakes.config import Config, load
from pancakes.control import Begin
from pancakes.mesh.memory_network import Quality
from pancakes.packet import LOG, SYSCTRL
from pancakes.sim.simulated_world import SimulatedWorld
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.simulation.agent_handle import PATIENCE_S, AgentHandle, SimulationError
from pancakes.simulation.fleet import Faults, Fleet, build_config, has_met, meeting, registered, silent
from pancakes.util.plugins import Plugins

READY_S = 120.0
"""How long, in virtual time, the agents have at a reset to become ready and to meet."""
MOST_NAMED = 8
"""At most this many agents that another one has not met are named."""
COUNTDOWN_S = 0.25
"""How long before the mission begins all agents get the order to begin, in virtual time."""
DIGITS = 7
"""Mission time is rounded to this many decimals, so that rounding errors of many small steps do not add up."""
LATE_S = 1e-8
"""A step ends this much late, so that it includes what happens at its very end, however its time is rounded."""


class Simulation:
    """Run agents and their world in virtual time: build once, reset and step as often as you like.

    First it is built: by `add` in code, by `load` from a configuration file, by `of_demo` from a demo. `reset` starts
    all agents, waits until they are ready and have met, and lets their mission clocks begin, together, at 0. `step`
    runs them. Between two steps nothing runs, so all may be read. The same seed and the same calls give the same run.
    What is only read changes nothing.

    It belongs to the thread that uses it. Any number of simulations may be used side by side.

    Args:
        quality: how well agents hear each other; None: as on a good network. Hardware buses are always perfect.
        channels: what the probe of each agent listens to, from its start on; empty: everything, which takes memory as
            long as it runs. `log` and `sysctrl` are needed by `events`, `lines` and `ask`.

    Raises:
        SimulationError: it is asked for what it cannot do; the message says what to do instead.
    """

    def __init__(self, *, quality: Quality | None = None, channels: tuple[str, ...] = (LOG, SYSCTRL)) -> None:
        self._quality = quality
        self._channels = channels
        self._configs: dict[str, Config] = {}
        self._classes: dict[str, type] = {}
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._fleet: Fleet | None = None
        self._zero_s = 0.0

    @classmethod
    def of_demo(cls, name: str, sets: Sequence[str] = (), *, out: str | PathLike[str] = "", **options: Any) -> Self:
        """Return a simulation of the agents of a demo that is installed; of a comparison, those of its mission.

        It has no launcher: nothing ends it, judges it or kills an agent.

        Args:
            name: the demo's name, as in `pancakes demo NAME`.
            sets: changes of its configurations, as `--set` takes them: `AGENT:table.key=value` or `table.key=value`.
            out: the folder for the files that its tasks write; empty: one that `close` removes.
            options: as for `Simulation`.

        Raises:
            PancakesError: there is no such demo, or a change of its configurations is refused.
        """
        from pancakes.tools.demo import Comparison
        from pancakes.tools.demo.launcher import find_configs, fresh, make_plan

        plugins = Plugins()
        found = plugins.get("pancakes.demos", name)
        demo = found.mission if isinstance(found, Comparison) else found
        made = cls(**options)
        if not out:
            made._folder = tempfile.TemporaryDirectory(prefix="pancakes-simulation-")
        folder = Path(out or made._folder.name).absolute() if made._folder else Path(out).absolute()
        fresh(folder, tuple(demo.records.values()))
        plan = make_plan(demo, find_configs(demo), folder, 0, 1.0, demo.duration_s, tuple(sets), False, plugins)
        for config in plan.configs.values():
            made._enter(replace(config, record=None))
        return made

    # How it is built ---------------------------------------------------------------------------------------------

    def add(
        self,
        name: str,
        text: str = "",
        *,
        tasks: Mapping[str, Any] | None = None,
        devices: Mapping[str, Any] | None = None,
        filters: Mapping[str, Any] | None = None,
        services: Mapping[str, Any] | None = None,
        classes: Mapping[str, type] | None = None,
        **agent: Any,
    ) -> Self:
        """Add an agent that is made in code. It takes part from the next `reset` on.

        Args:
            name: its name. An agent of this name that was added before is replaced.
            text: its configuration as TOML; `schema` and `[agent]` may be left out.
            tasks: tasks by name, besides those of `text`: a class, or a mapping with a class or entry point name as
                `type` and the other keys of `[task.NAME]`.
            devices: devices by name, likewise with drivers.
            filters: filters of actuators by name, likewise; `device` names the actuator.
            services: services by name, likewise; a default service may be given with only its settings.
            classes: classes that `text` names, by name.
            agent: keys of `[agent]`. Without `listen` it listens at `tcp://NAME:7400` and knows those added before.

        Returns:
            The simulation.
        """
        others = [config for config in self._configs.values() if config.agent.name != name]
        agent = {**meeting(name, others, agent.get("links")), **agent}
        parts = {"tasks": tasks, "devices": devices, "filters": filters, "services": services, "classes": classes}
        made = build_config(name, text, **parts, **agent)
        self._classes.update(made.classes)
        self._enter(made.config)
        return self

    def load(
        self, path: str | PathLike[str], sets: Sequence[str] = (), *, classes: Mapping[str, type] | None = None
    ) -> Self:
        """Add the agent of a configuration file, with its own address and its own peers.

        Args:
            path: the file.
            sets: changes of it, each as `table.key=value`.
            classes: classes that it names, by name, if they are not installed.

        Returns:
            The simulation.

        Raises:
            ConfigError: the file has faults; the message names every one.
        """
        self._classes.update(classes or {})
        self._enter(silent(load(path, ["agent.birth_wait_s=0", *sets], registered(self._classes))))
        return self

    def _enter(self, config: Config) -> None:
        self._configs[config.agent.name] = replace(config, clock=replace(config.clock, speed=1.0, hold=True))

    # How it runs -------------------------------------------------------------------------------------------------

    def reset(self, seed: int = 0) -> None:
        """End the agents that run, and start all again on empty disks; the mission is then held at 0.

        Args:
            seed: draws all that is drawn: noise, starts, the order of the actors, jitter, faults.

        Raises:
            SimulationError: there is no agent, or they were not ready or had not met in 120 s of virtual time.
            PancakesError: an agent cannot start: two have one address, a class is missing, ...
        """
        if not self._configs:
            raise SimulationError("this simulation has no agents yet: add some by `add`, `load` or `of_demo`")
        self._end()
        fleet = Fleet(seed, self._quality, self._classes, self._channels)
        self._fleet = fleet
        try:
            for config in self._configs.values():
                for device in config.devices.values():
                    if "world" in device.settings:
                        fleet.network.exempt(str(device.settings["world"]))
                fleet.start_config(replace(config, agent=replace(config.agent, seed=seed)), settle=False)
            self._begin(list(self._configs))
        except BaseException:
            self._end()
            raise
        self._zero_s = fleet.now()

    def _begin(self, names: Sequence[str]) -> None:
        """Wait until agents are ready and have met all others, and start their mission clocks."""
        fleet, late = self._running(), list(names)
        members: dict[str, dict[str, None]] = {}
        for name in self.agents:
            members.setdefault(self._configs[name].agent.fleet, {})[name] = None

        def there() -> bool:  # called after each event, so it checks all of a large fleet only if it must
            while late and self._is_there(late[-1], members):
                late.pop()
            late.extend([] if late else [name for name in names if not self._is_there(name, members)])
            return not late

        if not fleet.run_until(there, READY_S):
            missing = [name for name in names if not self._is_there(name, members)]
            waiting = "; ".join(f"{name} {self._lacks(name, members)}" for name in missing[:MOST_NAMED])
            waiting += f"; and so on with {len(missing)} agents in all" if len(missing) > MOST_NAMED else ""
            raise SimulationError(f"the simulation cannot begin after {READY_S:g} s of virtual time: {waiting}")
        begin_s = fleet.now() + COUNTDOWN_S
        for name in names:
            self.agents[name].publish(SYSCTRL, Begin(begin_s - fleet.now()))
        fleet.run_for(COUNTDOWN_S)

    def _is_there(self, name: str, members: Mapping[str, Collection[str]]) -> bool:
        """Return whether an agent is ready, and has met enough others; `members`: the agents of each fleet."""
        found, config = self.agents[name].agent, self._configs[name].agent
        fleet = members[config.fleet]
        met = found.mesh.connected()
        if not found.ready.is_set() or not has_met(config.links, len(met), len(fleet) - 1):
            return False
        return has_met(config.links, sum(other in fleet for other in met), len(fleet) - 1)

    def _lacks(self, name: str, members: Mapping[str, Collection[str]]) -> str:
        """Return what an agent waits for that is not there yet."""
        found = self.agents[name].agent
        if not found.ready.is_set():
            return "is not ready"
        met = found.mesh.connected()
        unmet = [other for other in members[self._configs[name].agent.fleet] if other != name and other not in met]
        more = f" and {len(unmet) - MOST_NAMED} others" if len(unmet) > MOST_NAMED else ""
        return f"has not met {', '.join(unmet[:MOST_NAMED])}{more}"

    def step(self, seconds: float) -> None:
        """Run all agents for this many seconds of virtual time.

        Raises:
            SimulationError: it was not reset, or `seconds` is less than 0 or endless.
        """
        if not 0.0 <= seconds < math.inf:
            raise SimulationError(f"a simulation cannot step by {seconds} s: a step is 0 s or more, and ends")
        fleet = self._running()
        fleet.run_to(self._zero_s + round(self.now_s + seconds, DIGITS) + LATE_S)

    def step_until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
        """Run all agents until a condition is true.

        Args:
            condition: is checked after each event.
            timeout_s: how long at most, in virtual seconds.

        Returns:
            Whether it became true.
        """
        return self._running().run_until(condition, timeout_s)

    def crash(self, name: str) -> None:
        """End an agent as a power cut does; what its disk has not yet got is lost."""
        self._handle(name)
        self._running().crash(name)

    def stop(self, name: str) -> None:
        """Stop an agent gracefully."""
        self._handle(name)
        self._running().stop(name)

    def restart(self, name: str) -> AgentHandle:
        """Start an agent again that was stopped or has crashed, on its disk.

        Virtual time passes until it is ready and has met the others. Its mission goes on at the time of its fleet.
        """
        if name in self.agents:
            raise SimulationError(f"the agent {name} runs: it is started again once it was stopped or has crashed")
        if name not in self._configs:
            raise SimulationError(self._unknown(name, self._configs))
        handle = self._running().restart(name, settle=False)
        self._begin([name])
        return handle

    # What is read ------------------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """Mission time: virtual seconds since the reset."""
        return round(self._running().now() - self._zero_s, DIGITS)

    @property
    def agents(self) -> Mapping[str, AgentHandle]:
        """The agents that run, by name."""
        return MappingProxyType(self._running().agents)

    @property
    def faults(self) -> Faults:
        """Injects faults, until the next reset."""
        return self._running().faults

    def tasks(self) -> list[dict[str, Any]]:
        """Return a description of each task of each agent, as `pancakes task list --json` prints it."""
        return [task for handle in self.agents.values() for task in handle.tasks()]

    def task(self, agent: str, name: str, service: str = "client") -> Any:
        """Return the actor of a task that runs: read its `state` and `settings`, and change nothing."""
        return self._handle(agent).task(name, service)

    def where(self, task: str) -> list[str]:
        """Return the agents on which a user's task runs now."""
        return [name for name, handle in self.agents.items() if task in handle.running()]

    def world(self) -> WorldState:
        """Return the truth: what all bodies of the simulated world do, as of its newest step.

        The world advances each time that it publishes its state (`sim.world`: `state_hz`, 20 Hz) or is asked by a
        device.

        Raises:
            SimulationError: no agent runs a simulated world, `sim.world` or another.
        """
        for handle in self.agents.values():
            for entry in handle.kernel.tasks.all():
                found = handle.component(f"{entry.service}/{entry.name}")
                if found is not None and isinstance(found.facade, SimulatedWorld):
                    return found.facade.truth()
        raise SimulationError("no agent of this simulation runs a simulated world, such as 'sim.world'")

    def body(self, name: str) -> BodyState:
        """Return the truth about one body of the simulated world."""
        bodies = {body.name: body for body in self.world().bodies}
        if name not in bodies:
            raise SimulationError(f"the simulated world has no body {name!r}, only {', '.join(bodies) or 'none'}")
        return bodies[name]

    def _handle(self, name: str) -> AgentHandle:
        if name not in self.agents:
            raise SimulationError(self._unknown(name, self.agents))
        return self.agents[name]

    @staticmethod
    def _unknown(name: str, known: Mapping[str, Any]) -> str:
        return f"the simulation has no agent {name!r}, only {', '.join(known) or 'none'}"

    def _running(self) -> Fleet:
        if self._fleet is None:
            raise SimulationError("this simulation does not run: call `reset` first")
        return self._fleet

    # How it ends -------------------------------------------------------------------------------------------------

    def _end(self) -> None:
        fleet, self._fleet = self._fleet, None
        if fleet is not None:
            fleet.close()

    def close(self) -> None:
        """Stop all agents. What was built stays, so it may be reset again, without the files of a demo."""
        self._end()
        if self._folder is not None:
            self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()
