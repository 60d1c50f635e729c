"""The launcher's own task: it waits for all agents, begins the mission, records its events, and ends it.

`Losses` kills an agent at the time that the demo says, and starts it again. `how_slow` reports whether the machine
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
from pancakes.kernel.handlers import queue
from pancakes.packet import LOG, SYSCTRL, SYSTEM, Packet, agent_of
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, Tick, every, on
from pancakes.tools.demo.demo import Loss

BEHIND_S: Final = 0.25
"""A world that lies further behind the clock than this, or a tick that is later, in mission seconds, is said to."""
MISSED_SHARE: Final = 0.01
"""So is a task that missed a larger share of its ticks, and more than one."""
NAMED: Final = 3
"""The most tasks that are named, those that missed most; of the others the number is told."""


@dataclass(frozen=True, slots=True)
class Ticks:
    """How a task's ticks came.

    Attributes:
        task: the task, as `agent/service/task`.
        ticks: how many came.
        missed: how many never did.
        late_max_s: how late the latest was, in mission seconds.
    """

    task: str
    ticks: int
    missed: int
    late_max_s: float

    def was_late(self) -> bool:
        """Return whether so many were missed, or one was so late, that it may have changed the mission."""
        return self.missed > max(1.0, MISSED_SHARE * (self.ticks + self.missed)) or self.late_max_s > BEHIND_S


def ticks_of(agent: str, description: Mapping[str, Any]) -> list[Ticks]:
    """Return how the ticks of an agent's tasks came, from its answer to `Describe`."""
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
    """Return where the machine fell behind, as it stands in `timing.json`; empty if it kept up."""
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
    """Return a mission's verdict, and where the machine was too slow for it, in one line."""
    if not slow:
        return verdict
    return f"{verdict}, {'though' if verdict == 'PASS' else 'and'} this machine was too slow: {slow}"


def hint_of(verdict: str, timings: Iterable[Mapping[str, Any]]) -> str:
    """Return what the machine has to do with a mission that has failed in real time; empty: nothing.

    Where ticks were in time a mission may fail of the machine all the same: a message between two agents that comes
    late is no late tick.
    """
    live = [timing for timing in timings if timing.get("mode") == "live"]
    if verdict == "PASS" or not live:
        return ""
    worst = max(live, key=lambda timing: float(timing.get("busy", 0.0)))
    percent = 100 * float(worst.get("busy", 0.0))
    return (
        f"in real time the machine counts: its {worst.get('processors', 1)} processors were busy for {percent:.0f} %"
        f" of the mission. Try --speed {worst['speed'] / 2:g}, without other programs, or --virtual, which no load"
        " changes"
    )


HAIR_S: Final = 1e-6
"""A step whose time has come is due, even where rounding puts the mission's clock a hair before it."""


class LossStep(msgspec.Struct, frozen=True):
    """Something that was done about an agent, as the launcher tells the conductor.

    Attributes:
        agent: the agent.
        kind: what was done: it was killed, or it was started again. So the event is called, too.
        t_s: when, in mission time.
    """

    agent: str
    kind: Literal["agent_lost", "agent_returned"]
    t_s: float


class Losses:
    """The steps of a mission's loss, one after the other. In the thread that starts agents.

    Args:
        loss: what is to happen; None: nothing.
        seed: the run's seed.
        now: the mission's clock.
        kill: ends an agent at once, by its name.
        start: starts it again on its disk.
        told: takes each step that was done.
    """

    def __init__(
        self,
        loss: Loss | None,
        seed: int,
        now: Callable[[], float],
        kill: Callable[[str], None],
        start: Callable[[str], None],
        told: Callable[[LossStep], None],
    ) -> None:
        self._now = now
        self._told = told
        self._steps: list[tuple[LossStep, Callable[[str], None]]] = []
        if loss is not None:
            at_s = loss.at_s(seed)
            self._steps.append((LossStep(loss.agent, "agent_lost", at_s), kill))
            self._steps.append((LossStep(loss.agent, "agent_returned", at_s + loss.away_s), start))

    def wait_s(self) -> float:
        """Return how long it is until something is to be done, in mission seconds; infinity: nothing ever is."""
        return max(0.0, self._steps[0][0].t_s - self._now()) if self._steps else math.inf

    def look(self) -> None:
        """Do what is due."""
        while self.wait_s() <= HAIR_S:
            step, act = self._steps.pop(0)
            now_s = self._now()  # before it is done: what follows from it comes later
            act(step.agent)
            self._told(replace(step, t_s=now_s))


ASK_S = 0.25
"""How often, in host time, an agent that is not ready is asked again."""
COUNTDOWN_S = 0.25
"""How long, in host time, before the mission begins all agents are told."""
OVERLAP_S = 1.0
"""The log is asked for this much more than the time without the agent: its clock may be a little off."""
RECENT = 500
"""The number of newest events among which a repeated one is looked for."""
LOOK_S = 1.0
"""How often, in host time, it reads how late the ticks of a live mission are."""
FOLLOWED = ((LOG, ("event", "line")), (SYSTEM, ("battery", "world_state")))


class EndMission(msgspec.Struct, frozen=True):
    """The launcher tells the conductor to end the mission before its time.

    Attributes:
        reason: why, as a sentence.
    """

    reason: str


@dataclass
class Mission:
    """What is known of a mission while it runs; the live view reads it.

    Attributes:
        agents: the agents that take part.
        duration_s: how long it lasts, in mission seconds.
        news_hz: how often, in host time, the launcher hears where everything is.
        now_s: the mission time, as the launcher's clock says it.
        world_s: the time of the world's newest state.
        behind_s: how far the world lies behind the clock, now and at the most.
        running: the user's tasks that run, by agent.
        batteries: the newest battery reading, by agent.
        bodies: the newest true state of each body.
        events: all events so far, as records.
        phase: `connecting`, `running`, `over` or `interrupted`.
        waiting_for: the agents that are not ready yet, and why.
        ended_because: why it ended early; empty if it did not.
        ticks: how the ticks of each task came as far as that is known, by agent (live only).
    """

    agents: tuple[str, ...]
    duration_s: float
    news_hz: float = 10.0
    now_s: float = 0.0
    world_s: float = 0.0
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
        """Whether nothing that happens counts any more."""
        return self.phase in ("over", "interrupted")


class Conductor(TaskCore, Task):
    """Conduct one mission from the launcher's agent.

    It talks to the agents only by packets that any agent may send: `Describe`, `Follow`, `Begin`.

    Args:
        mission: what it fills in.
        events: path of the events file.
        redial: has the launcher's mesh dial the agents that are not connected now, and not when it is time to.
    """

    def __init__(self, *args: Any, mission: Mission, events: Path, redial: Callable[[], None], **others: Any) -> None:
        super().__init__(*args, **others)
        self._mission = mission
        self._redial = redial
        self._path = events
        self._ready: dict[str, list[str]] = {}
        self._followed: dict[str, int] = {}
        self._lost_s: dict[str, float] = {}
        self._away: set[str] = set()  # agents that were killed, and are not taken up again yet
        self._returned: set[str] = set()  # those of them that were started again
        self._zero_s: dict[str, float] = {}  # the mission time at which the clock of such an agent began from scratch
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
        """An agent says how far it is, or that it sends what it was asked to."""
        agent = agent_of(packet.source)
        reply: Reply = packet.body
        if agent not in self._mission.agents:
            return
        if self._mission.phase == "running" and isinstance(reply.result, (list, tuple)):
            self._catch_up(agent, reply.result)
        if self._mission.phase == "running" and isinstance(reply.result, Mapping) and "tasks" in reply.result:
            self._mission.ticks[agent] = ticks_of(agent, reply.result)
            if agent in self._returned and reply.result["ready"]:
                self._take_up(agent, reply.result)
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

    # While it runs ---------------------------------------------------------------------------------------------

    def initial_period_s(self, method: str, period_s: float) -> float:
        # Without a viewer there is no need to look more often than there is news.
        return super().initial_period_s(method, max(period_s, 1.0 / self._mission.news_hz))

    @every(hz=10)
    def look(self, tick: Tick) -> None:
        """See how far the world lies behind the clock."""
        mission = self._mission
        if mission.phase != "running":
            return
        mission.now_s = self.now()
        news_s = self.kernel.mission.speed / mission.news_hz  # so old the newest state may be of itself
        mission.behind_s = max(0.0, mission.now_s - mission.world_s - news_s)
        mission.behind_max_s = max(mission.behind_max_s, mission.behind_s)
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

    @on(SYSTEM, "battery", keep=queue(64))
    def on_battery(self, packet: Packet) -> None:
        """Remember the newest battery reading of each agent."""
        self._mission.batteries[agent_of(packet.source)] = packet.body

    @on(SYSTEM, "world_state", keep="latest")
    def on_world(self, packet: Packet) -> None:
        """Remember where everything is."""
        state = packet.body
        self._mission.world_s = state.time_s
        for body in state.bodies:
            self._mission.bodies[body.name] = body

    @on(LOG, None, keep=queue(8192))
    def on_log(self, packet: Packet) -> None:
        """Keep what happens."""
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
            # Without its world the mission has no ground to stand on.
            self.end(f"the agent {peer} is gone: {body.fields.get('reason', '')}")
        elif peer in self._away:
            pass  # it was killed, and is taken up again once it is ready
        elif body.kind == "peer_down" and self._mission.phase == "running":
            self._lost_s[peer] = self.now()
        elif peer in self._lost_s:
            # It slept, or its link broke. Its Network Service may be a new one, which knows nothing of followers.
            self._follow(peer)
            self.publish(SYSCTRL, History(self.now() - self._lost_s.pop(peer) + OVERLAP_S), to=peer)

    def _catch_up(self, agent: str, records: Sequence[Mapping[str, Any]]) -> None:
        """Take what an agent said while it could not be heard, as far as that was not heard after all."""
        heard = [record for record in self._mission.events[-RECENT:] if record["agent"] == agent]
        for entry in records:
            record = self._in_mission_time({key: value for key, value in entry.items() if key != "entry"})
            if record["agent"] == agent and record not in heard:
                self._note(record)
        if records:
            self.publish(SYSCTRL, History(after=records[-1]["entry"]), to=agent)

    def _on_loss(self, step: LossStep) -> None:
        """An agent was killed, or was started again."""
        agent = step.agent
        if step.kind == "agent_lost":
            self._away.add(agent)
            self._mission.running[agent] = []
        else:
            self._returned.add(agent)
            self._ask_returned(agent)
        self._keep({"t_s": round(step.t_s, 6), "agent": agent, "source": self.address, "kind": step.kind})

    def _take_up(self, agent: str, description: Mapping[str, Any]) -> None:
        """An agent is back that was killed, and what it has said so far is asked for.

        Its mission goes on at the fleet's time; if it could not hear that in time, it begins from scratch.
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
        """Return a record of an agent, whose clock may have begun later than the mission."""
        zero_s = self._zero_s.get(record["agent"], 0.0)
        return {**record, "t_s": round(record["t_s"] + zero_s, 6)} if zero_s else record

    def _note(self, record: dict[str, Any]) -> None:
        """Keep a record, and what follows from it."""
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
        """End the mission; the launcher then stops all agents."""
        mission = self._mission
        if mission.ended:
            return
        mission.now_s = min(self.now(), mission.duration_s) if not math.isinf(mission.duration_s) else self.now()
        mission.ended_because = reason
        mission.phase = "over"
        self.on_stop()
        mission.changed()


def _running(description: Mapping[str, Any]) -> list[str]:
    """Return the user's tasks that run on an agent, from its answer to `Describe`."""
    tasks = [task for task in description["tasks"] if task["service"] not in ("device", "network", "log")]
    return [task["task"] for task in tasks if task["state"] == "running"]
