"""The launcher's own task: wait for all agents, begin the mission, record its events, and end it.

`Losses` kills agents at the times that the demo sets, and starts them again. `how_slow` reports whether the machine
kept up with a mission in real time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, TextIO

import msgspec
from msgspec.structs import replace

from pancakes.control import Begin, Describe, Follow, History, Reply
from pancakes.events import Event, line_of, record_of
from pancakes.packet import LOG, SYSCTRL, SYSTEM, Packet, agent_of
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, Tick, every, on
from pancakes.tools.demo.demo import Death

BEHIND_S: Final = 0.25
"""The largest delay of the world or of a tick that is not reported, in mission seconds."""
MISSED_SHARE: Final = 0.01
"""The largest share of missed ticks of a task that is not reported; one missed tick is never reported."""
NAMED: Final = 3
"""The most late tasks that are named, worst first; the others are only counted."""


@dataclass(frozen=True, slots=True)
class Ticks:
    """The ticks of a task in a mission.

    Attributes:
        task: the task, as `agent/service/task`.
        ticks: the number of ticks.
        missed: the number of missed ticks.
        late_max_s: the largest lateness, in mission seconds.
    """

    task: str
    ticks: int
    missed: int
    late_max_s: float

    def was_late(self) -> bool:
        """Return whether missed or late ticks may have changed the mission."""
        return self.missed > max(1.0, MISSED_SHARE * (self.ticks + self.missed)) or self.late_max_s > BEHIND_S


def ticks_of(agent: str, description: Mapping[str, Any]) -> list[Ticks]:
    """Return the ticks of an agent's tasks, from its answer to `Describe`."""
    return [
        Ticks(f"{agent}/{it['service']}/{it['task']}", it["ticks"], it["missed"], it["lateness_max_s"])
        for it in description["tasks"]
        if it["ticks"] or it["missed"]
    ]


def late_ones(ticks: Iterable[Ticks]) -> list[dict[str, Any]]:
    """Return the tasks that were late, as plain values, the worst first."""
    late = [it for it in ticks if it.was_late()]
    return [asdict(it) for it in sorted(late, key=lambda it: (-it.missed, -it.late_max_s, it.task))]


def how_slow(timing: Mapping[str, Any]) -> str:
    """Return where the machine fell behind, from `timing.json`; empty if it kept up."""
    parts = []
    if timing.get("behind_max_s", 0.0) > BEHIND_S:
        parts.append(f"the world fell behind the clock by up to {timing['behind_max_s']:.2f} s of mission time")
    late = timing.get("late_tasks", ())
    for it in late[:NAMED]:
        missed = f"missed {it['missed']} of {it['ticks'] + it['missed']} ticks and " if it["missed"] else ""
        parts.append(f"{it['task']} {missed}was up to {it['late_max_s']:.2f} s late")
    if len(late) > NAMED:
        parts.append(f"{len(late) - NAMED} more tasks were late")
    return "; ".join(parts)


def verdict_line(verdict: str, slow: str) -> str:
    """Return a mission's verdict, and where the machine was too slow for it, on one line."""
    if not slow:
        return verdict
    return f"{verdict}, {'though' if verdict == 'PASS' else 'and'} this machine was too slow: {slow}"


def hint_of(verdict: str, timings: Iterable[Mapping[str, Any]]) -> str:
    """Return a hint that a busy machine may be why a live mission failed; empty if it passed or was not live.

    The machine may be the reason even if no tick was late, because messages between agents may be late, too.
    """
    live = [timing for timing in timings if timing.get("mode") == "live"]
    if verdict == "PASS" or not live:
        return ""
    worst = max(live, key=lambda timing: float(timing.get("busy", 0.0)))
    percent = 100 * float(worst.get("busy", 0.0))
    return (
        f"a live mission depends on the machine: its {worst.get('processors', 1)} processors were busy for"
        f" {percent:.0f} % of the mission. Try --speed {worst['speed'] / 2:g}, without other programs, or --virtual,"
        " which does not depend on load"
    )


HAIR_S: Final = 1e-6
"""A tolerance for rounding: a step is due if the mission's clock is at most this much before its time."""


class LossStep(msgspec.Struct, frozen=True):
    """A message from the launcher to the conductor: an agent was killed or restarted.

    Attributes:
        agent: the agent.
        kind: what was done, which is also the kind of the event.
        t_s: the mission time.
    """

    agent: str
    kind: Literal["agent_lost", "agent_returned"]
    t_s: float


class Losses:
    """Kill and restart the agents of a mission's loss at the right times. Use it in the thread that starts agents.

    Args:
        deaths: who is killed when, and comes back when.
        now: the mission's clock.
        kill: kills an agent, by its name.
        start: starts it again on its disk.
        told: takes each step that was done.
    """

    def __init__(
        self,
        deaths: Iterable[Death],
        now: Callable[[], float],
        kill: Callable[[str], None],
        start: Callable[[str], None],
        told: Callable[[LossStep], None],
    ) -> None:
        self._now = now
        self._told = told
        self._steps: list[tuple[LossStep, Callable[[str], None]]] = []
        for death in deaths:
            self._steps.append((LossStep(death.agent, "agent_lost", death.at_s), kill))
            self._steps.append((LossStep(death.agent, "agent_returned", death.back_s), start))

    def wait_s(self) -> float:
        """Return the time until the next step, in mission seconds; infinity if there is none."""
        return max(0.0, self._steps[0][0].t_s - self._now()) if self._steps else math.inf

    def look(self) -> None:
        """Take the steps that are due."""
        while self.wait_s() <= HAIR_S:
            step, act = self._steps.pop(0)
            now_s = self._now()  # read before the step, so that its consequences come later
            act(step.agent)
            self._told(replace(step, t_s=now_s))


ASK_S = 0.25
"""The period, in host time, of requests to an agent that is not ready."""
COUNTDOWN_S = 0.25
"""How long, in host time, before the mission begins all agents get the request to begin it."""
OVERLAP_S = 1.0
"""How much more of an agent's log is requested than the time without the agent, because clocks may differ."""
RECENT = 500
"""The number of newest events that are compared with to find repeated ones."""
LOOK_S = 1.0
"""The period, in host time, of reading the ticks of a live mission."""
FOLLOWED = ((LOG, ("event", "line")), (SYSTEM, ("battery", "world_state")))


class EndMission(msgspec.Struct, frozen=True):
    """A message from the launcher to the conductor: end the mission early.

    Attributes:
        reason: why, as a sentence.
    """

    reason: str


@dataclass
class Mission:
    """The state of a mission while it runs; the live view reads it.

    Attributes:
        agents: the agents that take part.
        duration_s: its length, in mission seconds.
        news_hz: how often, in host time, the launcher gets the state of the world.
        now_s: the mission time on the launcher's clock.
        world_s: the time of the world's newest state.
        state_s: how long after a state of the world the next one comes, in mission time; infinity: unknown.
        behind_s: how far the world is behind the clock now.
        behind_max_s: how far the world was behind the clock at most.
        running: the running tasks of the user, by agent.
        batteries: the newest battery reading, by agent.
        bodies: the newest true state of each body.
        events: all events so far, as records.
        phase: `connecting`, `running`, `over` or `interrupted`.
        waiting_for: the agents that are not ready yet, and why.
        ended_because: why it ended early; empty if it did not.
        ticks: the ticks of each task as far as known, by agent (live only).
        changed: called when something here has changed.
        told: called with each new event.
    """

    agents: tuple[str, ...]
    duration_s: float
    news_hz: float = 10.0
    now_s: float = 0.0
    world_s: float = 0.0
    state_s: float = math.inf
    behind_s: float = 0.0
    behind_max_s: float = 0.0
    running: dict[str, list[str]] = field(default_factory=dict)
    batteries: dict[str, Any] = field(default_factory=dict)
    bodies: dict[str, Any] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    phase: str = "connecting"
    waiting_for: dict[str, str] = field(default_factory=dict)
    ended_because: str = ""
    ticks: dict[str, list[Ticks]] = field(default_factory=dict)
    changed: Callable[[], None] = lambda: None
    told: Callable[[Mapping[str, Any]], None] = lambda record: None

    @property
    def ended(self) -> bool:
        """Whether the mission is over, so that further events do not count."""
        return self.phase in ("over", "interrupted")

    def world_told(self, time_s: float) -> None:
        """The world has told its state at a mission time."""
        if time_s > self.world_s:
            self.state_s = min(self.state_s, time_s - self.world_s)
        self.world_s = time_s

    def look_at_world(self, speed: float) -> None:
        """Measure how far the world is behind the clock, whose `speed` is that of the mission."""
        normal_s = max(speed / self.news_hz, self.state_s)  # the age of the newest state: some come once a second
        self.behind_s = max(0.0, self.now_s - self.world_s - normal_s)
        self.behind_max_s = max(self.behind_max_s, self.behind_s)


class Conductor(TaskCore, Task):
    """Conduct one mission from the launcher's agent.

    It talks to the agents only by packets that any agent may send: `Describe`, `Follow`, `Begin`.

    Args:
        mission: the state that it updates.
        events: path of the events file.
        redial: makes the launcher's mesh dial agents that are not connected at once, without its back-off.
    """

    def __init__(self, *args: Any, mission: Mission, events: Path, redial: Callable[[], None], **others: Any) -> None:
        super().__init__(*args, **others)
        self._mission = mission
        self._redial = redial
        self._path = events
        self._ready: dict[str, list[str]] = {}
        self._followed: dict[str, int] = {}
        self._lost_s: dict[str, float] = {}
        self._away: set[str] = set()  # agents that were killed and have not rejoined the mission yet
        self._returned: set[str] = set()  # those of them that were started again
        self._zero_s: dict[str, float] = {}  # the mission time at which such an agent's clock began again at 0
        self._file: TextIO | None = None

    def on_start(self) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("w", encoding="utf-8")
        self._mission.waiting_for = dict.fromkeys(self._mission.agents, "has not been reached")
        self._ask()

    def on_stop(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    # Before the mission ----------------------------------------------------------------------------------------

    def _ask(self) -> None:
        if self._mission.phase != "connecting":
            return
        for agent in self._mission.agents:
            if agent not in self._ready:
                self.publish(SYSCTRL, Describe(), to=agent)
        self.after_host(ASK_S, self._ask)

    def _ask_returned(self, agent: str) -> None:
        if agent in self._returned and not self._mission.ended:
            self._redial()
            self.publish(SYSCTRL, Describe(), to=agent)
            self.after_host(ASK_S, partial(self._ask_returned, agent))

    @on(SYSCTRL, Reply)
    def on_reply(self, packet: Packet) -> None:
        """Handle an agent's description, its log, or its reply to `Follow`."""
        agent = agent_of(packet.source)
        reply: Reply = packet.body
        if agent not in self._mission.agents:
            return
        if self._mission.phase == "running" and isinstance(reply.result, (list, tuple)):
            self._catch_up(agent, reply.result)
        if self._mission.phase == "running" and isinstance(reply.result, Mapping) and "tasks" in reply.result:
            self._mission.ticks[agent] = ticks_of(agent, reply.result)
            if agent in self._returned and reply.result["ready"]:
                self._rejoin(agent, reply.result)
        if self._mission.phase != "connecting":
            return
        if not reply.ok:
            self._mission.waiting_for[agent] = reply.reason
        elif isinstance(reply.result, Mapping) and "ready" in reply.result:
            self._hear(agent, reply.result)
        elif reply.result is None and agent in self._ready:
            self._followed[agent] = self._followed.get(agent, 0) + 1
            self._begin_if_all_are_ready()

    def _hear(self, agent: str, description: Mapping[str, Any]) -> None:
        missing = [other for other in self._mission.agents if other != agent and other not in description["peers"]]
        if agent in self._ready:
            return
        if not description["ready"]:
            self._mission.waiting_for[agent] = "starts its tasks"
        elif missing:
            self._mission.waiting_for[agent] = f"has not met {', '.join(missing)}"
        else:
            self._ready[agent] = _running(description)
            self._mission.waiting_for.pop(agent, None)
            self._follow(agent)
        self._mission.changed()

    def _follow(self, agent: str) -> None:
        for channel, types in FOLLOWED:
            most_hz = self._mission.news_hz if channel == SYSTEM else 0.0
            self.publish(SYSCTRL, Follow(channel, types, most_hz=most_hz), to=agent)

    def _begin_if_all_are_ready(self) -> None:
        if any(self._followed.get(agent, 0) < len(FOLLOWED) for agent in self._mission.agents):
            return
        self._mission.phase = "running"
        for agent in self._mission.agents:
            self._mission.running[agent] = list(self._ready[agent])
            self._keep({"t_s": 0.0, "agent": agent, "source": agent, "kind": "roster", "tasks": self._ready[agent]})
        begin_s = self.kernel.host.now() + COUNTDOWN_S
        for agent in (*self._mission.agents, self.agent):
            self.publish(SYSCTRL, Begin(begin_s - self.kernel.host.now()), to=agent)
        self.after(self._mission.duration_s, lambda: self.end(""))
        if self.kernel.virtual is None:  # in virtual time no tick is late
            self.after_host(LOOK_S, self._look_at_ticks)

    # During the mission ----------------------------------------------------------------------------------------

    def initial_period_s(self, method: str, period_s: float) -> float:
        # More ticks than news of the world would be useless.
        return super().initial_period_s(method, max(period_s, 1.0 / self._mission.news_hz))

    @every(hz=10)
    def look(self, tick: Tick) -> None:
        """Measure how far the world is behind the clock."""
        mission = self._mission
        if mission.phase != "running":
            return
        mission.now_s = self.now()
        mission.look_at_world(self.kernel.mission.speed)
        mission.changed()
        if self._file is not None:
            self._file.flush()

    def _look_at_ticks(self) -> None:
        if self._mission.phase != "running":
            return
        for agent in self._mission.agents:
            if agent not in self._lost_s and agent not in self._away:
                self.publish(SYSCTRL, Describe(), to=agent)
        self.after_host(LOOK_S, self._look_at_ticks)

    @on(SYSTEM, "battery", queue=64)
    def on_battery(self, packet: Packet) -> None:
        """Remember the newest battery reading of each agent."""
        self._mission.batteries[agent_of(packet.source)] = packet.body

    @on(SYSTEM, "world_state", queue="latest")
    def on_world(self, packet: Packet) -> None:
        """Remember the state of the world."""
        state = packet.body
        self._mission.world_told(state.time_s)
        for body in state.bodies:
            self._mission.bodies[body.name] = body

    @on(LOG, None, queue=8192)
    def on_log(self, packet: Packet) -> None:
        """Record the events of agents."""
        agent = agent_of(packet.source)
        if agent == self.agent:
            self._on_own_log(packet)
            return
        if not self._mission.ended:
            self._note(self._in_mission_time(record_of(packet)))

    def _on_own_log(self, packet: Packet) -> None:
        body = packet.body
        if not isinstance(body, Event) or body.kind not in ("peer_up", "peer_down"):
            return
        peer = str(body.fields.get("peer"))
        if body.kind == "peer_down" and peer == self._mission.agents[0]:
            # A mission cannot continue without its world.
            self.end(f"the agent {peer} is gone: {body.fields.get('reason', '')}")
        elif peer in self._away:
            pass  # it was killed, and rejoins when it is ready
        elif body.kind == "peer_down" and self._mission.phase == "running":
            self._lost_s[peer] = self.now()
        elif peer in self._lost_s:
            # It slept, or its link broke. Its Network Service may have restarted and lost its followers.
            self._follow(peer)
            self.publish(SYSCTRL, History(self.now() - self._lost_s.pop(peer) + OVERLAP_S), to=peer)

    def _catch_up(self, agent: str, records: Sequence[Mapping[str, Any]]) -> None:
        """Add the log of an agent from the time when it was not connected, without records that are known already."""
        known = [record for record in self._mission.events[-RECENT:] if record["agent"] == agent]
        for entry in records:
            record = self._in_mission_time({key: value for key, value in entry.items() if key != "entry"})
            if record["agent"] == agent and record not in known:
                self._note(record)
        if records:
            self.publish(SYSCTRL, History(after=records[-1]["entry"]), to=agent)

    def _on_loss(self, step: LossStep) -> None:
        """Note that an agent was killed or started again."""
        agent = step.agent
        if step.kind == "agent_lost":
            self._away.add(agent)
            self._mission.running[agent] = []
        else:
            self._returned.add(agent)
            self._ask_returned(agent)
        self._keep({"t_s": round(step.t_s, 6), "agent": agent, "source": self.address, "kind": step.kind})

    def _rejoin(self, agent: str, description: Mapping[str, Any]) -> None:
        """Let a restarted agent rejoin the mission, and request its log so far.

        Its mission clock continues at the fleet's time, or begins at 0 if the agent learned that time too late.
        """
        self._returned.discard(agent)
        self._away.discard(agent)
        self._lost_s.pop(agent, None)
        self._mission.running[agent] = _running(description)
        self._zero_s[agent] = self.now() if description["held"] else 0.0
        self.publish(SYSCTRL, Begin(), to=agent)
        self._follow(agent)
        self.publish(SYSCTRL, History(), to=agent)

    def _in_mission_time(self, record: dict[str, Any]) -> dict[str, Any]:
        """Return a record with mission time, because the agent's clock may have begun later than the mission."""
        zero_s = self._zero_s.get(record["agent"], 0.0)
        return {**record, "t_s": round(record["t_s"] + zero_s, 6)} if zero_s else record

    def _note(self, record: dict[str, Any]) -> None:
        """Record an event, and update the running tasks."""
        if record["kind"] == "line" and record["level"] == "debug":
            return
        running = self._mission.running.setdefault(record["agent"], [])
        service = record.get("service")
        if record["kind"] == "task_started" and service not in ("device", "network", "log"):
            if record["task"] not in running:
                running.append(record["task"])
        elif record["kind"] in ("task_stopped", "task_given_up") and record.get("task") in running:
            running.remove(record["task"])
        self._keep(record)

    def _keep(self, record: dict[str, Any]) -> None:
        self._mission.events.append(record)
        if self._file is not None:
            self._file.write(line_of(record) + "\n")
        self._mission.told(record)

    def take_message(self, message: Any) -> Any:
        if isinstance(message, EndMission):
            self.end(message.reason)
        elif isinstance(message, LossStep):
            self._on_loss(message)
        else:
            return super().take_message(message)
        return None

    def end(self, reason: str) -> None:
        """End the mission; then the launcher stops all agents."""
        mission = self._mission
        if mission.ended:
            return
        mission.now_s = min(self.now(), mission.duration_s) if not math.isinf(mission.duration_s) else self.now()
        mission.ended_because = reason
        mission.phase = "over"
        self.on_stop()
        mission.changed()


def _running(description: Mapping[str, Any]) -> list[str]:
    """Return the running tasks of the user on an agent, from its answer to `Describe`."""
    tasks = [task for task in description["tasks"] if task["service"] not in ("device", "network", "log")]
    return [task["task"] for task in tasks if task["state"] == "running"]
