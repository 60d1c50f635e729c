"""Run a demo: as processes over real sockets, or with the same agents in virtual time on one thread.

`make_plan` makes the configurations of the agents for one run, from their own files and the launcher's changes.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import msgspec
from msgspec.structs import replace

from pancakes.agent.agent import Agent
from pancakes.config import Config, load, parse
from pancakes.config.toml_reader import read_values, text_of
from pancakes.errors import ConfigError, PancakesError
from pancakes.kernel.mailbox import tell
from pancakes.mesh.memory_network import Quality
from pancakes.recording.virtual_recorder import VirtualRecorder
from pancakes.simulation.fleet import Fleet
from pancakes.tools.demo.conductor import Conductor, EndMission, Losses, LossStep, Mission, late_ones
from pancakes.tools.demo.demo import Death, Demo, Run
from pancakes.tools.launch.clear_state import check_alone, empty_state
from pancakes.tools.launch.fleet_file import whose
from pancakes.tools.launch.ports import Claim, claim_ports, within_machine
from pancakes.tools.launch.process import AgentProcess, Starter, end_all
from pancakes.tools.launch.temporary_keys import keys_of_run, set_keys
from pancakes.util.clock import MonotonicClock
from pancakes.util.cpu import processor_count, processor_times
from pancakes.util.plugins import Plugins

LAUNCHER = "launcher"


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """One run of a demo, before it starts.

    Attributes:
        demo: the demo.
        out: the folder for all results.
        seed: the run's seed.
        speed: mission seconds per second of host time.
        duration_s: the length of the mission.
        sets: the changes of each agent's file, as for `--set`.
        files: each agent's file.
        configs: the resulting configurations.
        claim: keeps other demos from using the ports of this one, if these are the ports in the files.
    """

    demo: Demo
    out: Path
    seed: int
    speed: float
    duration_s: float
    sets: Mapping[str, tuple[str, ...]]
    files: Mapping[str, Path]
    configs: Mapping[str, Config]
    claim: Claim | None

    def deaths(self) -> list[Death]:
        """Return which agents are killed when, and when they come back."""
        loss = self.demo.loss
        return loss.times(self.seed, self.duration_s) if loss is not None else []

    def peers(self, within_machine: bool) -> tuple[str, ...]:
        """Return an address of each agent: the one within its machine, or its last one."""
        return tuple(config.agent.addresses[0 if within_machine else -1] for config in self.configs.values())

    def buses(self) -> tuple[str, ...]:
        """Return the addresses of the hardware buses, which network faults do not affect."""
        found = {
            str(device.settings["world"]): None
            for config in self.configs.values()
            for device in config.devices.values()
            if "world" in device.settings
        }
        return tuple(found)


def make_plan(
    demo: Demo,
    folder: Path,
    out: Path,
    seed: int,
    speed: float,
    duration_s: float,
    extra: tuple[str, ...],
    live: bool,
    plugins: Plugins | None = None,
    local: bool = False,
) -> DemoPlan:
    """Plan one run.

    Args:
        demo: the demo.
        folder: the folder with the agents' files.
        out: the folder for all results; agents get empty state directories below it.
        seed: the run's seed.
        speed: mission seconds per second of host time.
        duration_s: the length of the mission.
        extra: `AGENT:table.key=value` or `table.key=value` (all agents) from the command line.
        live: whether the run uses real ports; ports that are in use are then replaced by free ones.
        plugins: where drivers and tasks come from; None: the installed ones. Their requirements on the configurations
            are checked here, before anything starts.
        local: whether the agents of a live demo talk only within this machine, without TCP ports.

    Raises:
        PancakesError: a file is missing or invalid.
    """
    files = {agent: folder / f"{agent}.toml" for agent in demo.agents}
    # Each live run has its own fleet: two demos, or a demo and a real robot, on one machine must not become neighbours.
    fleet = f"{demo.name}-{os.getpid()}" if live else demo.name
    sets: dict[str, list[str]] = {}
    for agent in demo.agents:
        sets[agent] = [
            f'agent.fleet="{fleet}"',
            f"agent.seed={seed}",
            f'agent.state_dir="{out / "state" / agent}"',
            f"clock.speed={speed!r}",
            "clock.hold=true",
            "agent.birth_wait_s=0",  # all disks of this fleet are empty, so no agent could know the tasks
            "service.log.settings.console=false",
        ]
        if live:
            # In virtual time these logs would only repeat `events.jsonl`.
            sets[agent].append(f'service.log.settings.file="{out / "logs" / (agent + ".jsonl")}"')
    for task, name in demo.records.items():
        sets[demo.agents[0]].append(f'task.{task}.settings.path="{out / name}"')
    for agent, changes in (demo.arrange(out, live) if demo.arrange is not None else {}).items():
        sets[agent].extend(changes)
    for one in extra:
        agents, change = whose(one, demo.agents)
        for agent in agents:
            sets[agent].append(change)
    plugins = plugins or Plugins()
    claim, other_ports = _claim_ports(files, fleet, local) if live else (None, {})
    for agent, changes in other_ports.items():
        sets[agent].extend(changes)
    try:
        configs = {agent: load(str(files[agent]), sets[agent], plugins) for agent in demo.agents}
    except PancakesError:
        if claim is not None:
            claim.release()
        raise
    frozen = {agent: tuple(changes) for agent, changes in sets.items()}
    return DemoPlan(demo, out, seed, speed, duration_s, frozen, files, configs, claim)


def _claim_ports(files: Mapping[str, Path], fleet: str, local: bool) -> tuple[Claim | None, Mapping[str, list[str]]]:
    """Return the claim on the ports of a live demo, and the settings for other ports, by agent."""
    try:
        tables = {agent: read_values(text_of(str(path)), str(path)).values for agent, path in files.items()}
    except ConfigError:
        return None, {}  # `load` reports the fault with a better message
    if not local:
        return claim_ports(tables)
    claim, other_ports = claim_ports(tables, ("udp",))
    within = within_machine(tables, dict.fromkeys(files, fleet))
    return claim, {agent: [*other_ports.get(agent, ()), *within.get(agent, ())] for agent in files}


def find_configs(demo: Demo, given: Path | None = None) -> Path:
    """Return the folder with the configurations of a demo.

    Args:
        demo: the demo.
        given: the folder from the command line; None: the folder of the demo.

    Raises:
        PancakesError: the folder does not exist.
    """
    folder = demo.configs if given is None else given
    if not folder.is_dir():
        raise PancakesError(
            f"the configurations of the demo {demo.name!r} are not in {folder}: pass their folder as --configs"
        )
    return folder


HOST = MonotonicClock()
"""The clock for processes, independent of the mission's clock."""

READY_S = 30.0
"""How long, in host time, the agents may take to become ready."""
STOP_S = 1.2
"""How long a process may take to end after SIGTERM before it is killed."""
LOOK_S = 0.05
SLICE_S = 1.0
"""The virtual time between two checks for an interruption: some milliseconds of host time."""
NEWS_HZ = 1.0
"""How often, in virtual time, the launcher gets the state of the world; minutes of a mission pass in a second."""
RECORDING = "recording"
"""The folder for the agents' recordings, in the folder for results."""


class Launcher(Agent):
    """The launcher's own agent: a client of the mesh with one task, the conductor."""

    def __init__(self, plan: DemoPlan, mission: Mission, virtual: Any = None) -> None:
        peers = ", ".join(f'"{address}"' for address in plan.peers(within_machine=virtual is None))
        text = f"""
            schema = 1
            [agent]
            name = "{LAUNCHER}"
            role = "client"
            seed = {plan.seed}
            fleet = "{next(iter(plan.configs.values())).agent.fleet}"
            peers = [{peers}]
            [clock]
            speed = {plan.speed!r}
            hold = true
            [service.log.settings]
            console = false
            [task.Conductor]
            type = "pancakes.conductor"
        """
        plugins = Plugins({("pancakes.tasks", "pancakes.conductor"): Conductor})
        conductor = {
            "mission": mission,
            "events": plan.out / "events.jsonl",
            "redial": lambda: self.mesh.redial(),  # late, because the mesh does not exist yet
        }
        arguments = {"Conductor": conductor}
        super().__init__(parse(text, where="the launcher"), plugins, virtual, arguments)

    def end(self, reason: str) -> None:
        """End the mission early. Any thread."""
        tell_conductor(self, EndMission(reason))


def tell_conductor(launcher: Agent, message: EndMission | LossStep) -> None:
    """Send a message to the launcher's task. Any thread."""
    conductor = launcher.kernel.registry.get(f"{LAUNCHER}/client/Conductor")
    if conductor is not None:
        tell(conductor, message)


class Processes:
    """The agents of a live demo, each in its own process.

    They end with the launcher, however it ends.
    """

    def __init__(self, plan: DemoPlan) -> None:
        self._plan = plan
        self._keys: Mapping[str, Path] = {}
        self._starter = Starter()
        self._processes: dict[str, AgentProcess] = {}

    def start(self, keys: Mapping[str, Path]) -> None:
        """Start all agents.

        Args:
            keys: the folders with the keys of agents that get keys.
        """
        self._keys = keys
        (self._plan.out / "logs").mkdir(parents=True, exist_ok=True)
        for agent in self._plan.files:
            self.start_one(agent)

    def start_one(self, agent: str) -> None:
        """Start one agent with its configuration for this run; call it in the thread that started them all."""
        plan = self._plan
        sets = (*plan.sets[agent], *set_keys(self._keys.get(agent)))
        with (plan.out / "logs" / f"{agent}.txt").open("ab") as output:
            self._processes[agent] = self._starter.start(plan.files[agent], sets, output.fileno())

    def kill(self, agent: str) -> None:
        """Kill one agent; `gone` does not report it then."""
        process = self._processes.pop(agent)
        process.kill()
        process.wait()

    def gone(self) -> str:
        """Return a sentence about an agent that has ended by itself; empty if all run."""
        for agent, process in self._processes.items():
            if process.poll() is not None:
                said = (self._plan.out / "logs" / f"{agent}.txt").read_text(encoding="utf-8", errors="replace").strip()
                last = said.splitlines()[-1] if said else "it printed nothing"
                return f"the agent {agent} ended with exit code {process.returncode}: {last}"
        return ""

    def stop(self) -> None:
        """Stop all agents gracefully; kill those that do not stop in time."""
        end_all(self._processes.values(), STOP_S)
        self._starter.close()


def run_live(plan: DemoPlan, mission: Mission, interrupted: threading.Event) -> dict[str, Any]:
    """Run the agents as processes until the mission is over, or `interrupted` is set.

    Returns:
        The wall-clock figures for `timing.json`.

    Raises:
        PancakesError: the agents did not become ready, or another agent of their fleet runs.
    """
    processes = Processes(plan)
    began_s, began_busy = HOST.now(), processor_times()
    launcher: Launcher | None = None
    held = ExitStack()
    try:
        # The state is below `out`, and the fleet is this run's own, unless the command line changed that.
        check_alone(plan.configs.values())
        for config in plan.configs.values():
            empty_state(config)
        processes.start(held.enter_context(keys_of_run(plan.configs)))
        launcher = Launcher(plan, mission)
        launcher.start()
        now = launcher.kernel.mission.now
        losses = Losses(plan.deaths(), now, processes.kill, processes.start_one, partial(tell_conductor, launcher))
        running_s = None
        while mission.phase != "over" and not interrupted.wait(LOOK_S):
            losses.look()
            gone = processes.gone()
            if gone and mission.phase == "connecting":
                raise PancakesError(gone)
            if gone:
                launcher.end(gone)
            if mission.phase == "running" and running_s is None:
                running_s = HOST.now()
            if mission.phase == "connecting" and HOST.now() - began_s > READY_S:
                raise _cannot_begin(mission)
        _settle(mission)
        ended_s, ended_busy = HOST.now(), processor_times()
    finally:
        processes.stop()
        if launcher is not None:
            launcher.stop()
        held.close()
        if plan.claim is not None:
            plan.claim.release()
    return {
        "mode": "live",
        "speed": plan.speed,
        "start_s": (running_s or ended_s) - began_s,
        "wall_s": ended_s - (running_s or ended_s),
        "busy": (ended_busy[0] - began_busy[0]) / max(ended_busy[1] - began_busy[1], 1e-9),
        "processors": processor_count(),
        "behind_max_s": mission.behind_max_s,
        "behind_end_s": mission.behind_s,
        "late_tasks": late_ones(it for agent in mission.agents for it in mission.ticks.get(agent, ())),
    }


def _cannot_begin(mission: Mission) -> PancakesError:
    waiting = "; ".join(f"{agent} {why}" for agent, why in mission.waiting_for.items())
    return PancakesError(f"the mission cannot begin after {READY_S:.0f} s: {waiting}")


def _settle(mission: Mission) -> None:
    """Mark an unfinished mission as interrupted before its agents stop, so that their stop is not recorded."""
    if not mission.ended:
        mission.phase = "interrupted"


class Onlooker(Protocol):
    """Watch a fleet in virtual time, and slow it down so that people can follow. It changes nothing else."""

    def begin(self, fleet: Fleet) -> None:
        """Take the fleet, before anything runs."""

    def joined(self, agent: Agent) -> None:
        """Take an agent that was killed and started again."""

    def slice_s(self) -> float:
        """Return the virtual time until the next call of `pace`."""

    def pace(self) -> None:
        """Process the news, and wait until the fleet may continue."""

    def end(self) -> None:
        """Stop watching: the agents are about to stop."""


def run_virtual(
    plan: DemoPlan,
    mission: Mission,
    interrupted: threading.Event,
    faults: NetworkFaults | None,
    onlooker: Onlooker | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Run the same agents in virtual time, on this thread, until the mission is over or `interrupted` is set.

    Agents are recorded from outside, so that a recording does not change the mission.

    Args:
        plan: the run.
        mission: the state that is updated while the mission runs.
        interrupted: ends the mission early.
        faults: the faults of the network; None: none.
        onlooker: watches the fleet; None: nobody does.
        say: takes a sentence about a recording that is incomplete.

    Returns:
        The wall-clock figures for `timing.json`.

    Raises:
        PancakesError: the agents did not become ready, or cannot be recorded.
    """
    began_s = HOST.now()
    mission.news_hz = NEWS_HZ
    fleet = Fleet(plan.seed, faults.quality if faults is not None else None)
    for address in plan.buses():
        fleet.network.exempt(address)
    recorders: dict[str, VirtualRecorder] = {}

    def start(name: str) -> None:
        config = plan.configs[name]
        agent = fleet.start_config(replace(config, record=None), settle=False, probe=False).agent
        if config.record is not None and config.record.start:
            recorders[name] = VirtualRecorder(agent.kernel, config.record, say)

    def start_again(name: str) -> None:
        start(name)
        if onlooker is not None:
            onlooker.joined(fleet.agents[name].agent)

    def kill(name: str) -> None:
        if name in recorders:
            recorders[name].end()
        fleet.crash(name)

    try:
        for name in plan.configs:
            start(name)
        if onlooker is not None:
            onlooker.begin(fleet)
        launcher = fleet.add(LAUNCHER, lambda virtual: Launcher(plan, mission, virtual)).agent
        now = launcher.kernel.mission.now
        losses = Losses(plan.deaths(), now, kill, start_again, partial(tell_conductor, launcher))
        if not _run_until(fleet, lambda: mission.phase != "connecting", READY_S, interrupted, onlooker, losses):
            raise _cannot_begin(mission)
        running_s = HOST.now()
        if faults is not None:
            faults.arrange(fleet, launcher)
        timeout_s = plan.duration_s * 2 + READY_S
        _run_until(fleet, lambda: mission.phase == "over", timeout_s, interrupted, onlooker, losses)
        if interrupted.is_set():
            _settle(mission)
        ended_s = HOST.now()
    finally:
        if onlooker is not None:
            onlooker.end()
        try:
            fleet.close()
        finally:
            for recorder in recorders.values():
                recorder.end()
    return {
        "mode": "virtual",
        "start_s": running_s - began_s,
        "wall_s": ended_s - running_s,
        "times_real_time": mission.now_s / max(ended_s - running_s, 1e-9),
    }


def _run_until(
    fleet: Fleet,
    reached: Callable[[], bool],
    timeout_s: float,
    interrupted: threading.Event,
    onlooker: Onlooker | None,
    losses: Losses,
) -> bool:
    """Run until something is reached, for at most some virtual time.

    Returns:
        Whether it was reached, or the run was interrupted.
    """
    until_s = fleet.now() + timeout_s
    while fleet.now() < until_s and not interrupted.is_set():
        slice_s = onlooker.slice_s() if onlooker is not None else SLICE_S
        # In virtual time the mission's clock and the fleet's clock are the same.
        if fleet.run_until(reached, min(slice_s, losses.wait_s(), until_s - fleet.now())):
            return True
        losses.look()
        if onlooker is not None:
            onlooker.pace()
    return interrupted.is_set()


class NetworkFaults:
    """The faults of the network of a virtual run, drawn from a seed.

    The network has latency and jitter, and sometimes a link between two agents breaks and is made again.

    Args:
        seed: the seed for the times and places of breaks.
        breaks: how many links break during the mission.
        latency_s: how long a packet travels.
        jitter_s: how much longer it may travel.
    """

    def __init__(self, seed: int, breaks: int = 6, latency_s: float = 0.02, jitter_s: float = 0.02) -> None:
        self._random = random.Random(f"faults/{seed}")
        self._breaks = breaks
        self.quality = Quality(latency_s=latency_s, jitter_s=jitter_s)

    def arrange(self, fleet: Fleet, launcher: Agent) -> None:
        """Draw and schedule the breaks of one mission."""
        names = [name for name in fleet.agents if name != launcher.name]
        for _ in range(self._breaks):
            at_s = fleet.now() + self._random.uniform(5.0, 290.0)
            one, other = self._random.sample(names, 2)
            fleet.dispatcher.call_at(at_s, lambda one=one, other=other: fleet.network.break_links(one, other))  # type: ignore[misc]


def run_of(plan: DemoPlan, mission: Mission) -> Run:
    """Return the run of a mission that is over, for its judge."""
    return Run(plan.out, plan.seed, plan.duration_s, mission.now_s, mission.ended_because, configs_of(plan))


def judge(plan: DemoPlan, run: Run, timing: Mapping[str, Any]) -> dict[str, Any]:
    """Judge a run, write `summary.json` and `timing.json`, and return the summary."""
    summary = plan.demo.judge(run)
    write_results(plan.out, summary, timing)
    return summary


def write_results(out: Path, summary: Mapping[str, Any], timing: Mapping[str, Any]) -> None:
    """Write `summary.json` and `timing.json`."""
    for name, content in (("summary.json", summary), ("timing.json", timing)):
        (out / name).write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def configs_of(plan: DemoPlan) -> Mapping[str, Mapping[str, Any]]:
    """Return the agents' configurations as plain mappings, for a demo's judge."""

    def plain(config: Config) -> dict[str, Any]:
        return {
            "agent": msgspec.to_builtins(config.agent),
            "clock": msgspec.to_builtins(config.clock),
            "devices": {name: dict(device.settings) for name, device in config.devices.items()},
            "services": {name: dict(service.settings) for name, service in config.services.items()},
            "tasks": msgspec.to_builtins(config.tasks),
        }

    return {agent: plain(config) for agent, config in plan.configs.items()}


def fresh(out: Path, results: Sequence[str] = ("trajectory.csv", "paths.png")) -> None:
    """Make the output folder, and remove the state and the results of an earlier run.

    Args:
        out: the folder.
        results: further files in it that the run will write, besides those of every run.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in ("state", "logs", RECORDING):
            shutil.rmtree(out / name, ignore_errors=True)
        for name in ("events.jsonl", "summary.json", "timing.json", *results):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise PancakesError(f"the output folder {out} cannot be used: {error.strerror}") from None
