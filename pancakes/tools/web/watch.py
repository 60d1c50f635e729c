"""Watch a fleet of processes as a client of its mesh, in a thread of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.client.rates import RateMeter
from pancakes.client.session import FleetSession, Session
from pancakes.client.subscriptions import Subscription, SubscriptionSpec
from pancakes.control import Describe, History, Reply, Traces
from pancakes.errors import ControlRefusedError, NoAnswerError, PancakesError, UnreachableError
from pancakes.packet import LOG, SYSTEM, Cause
from pancakes.tools.web.command_causes import CommandExplainer, FleetTraces
from pancakes.tools.web.feed import FRAMES_HZ, Feed
from pancakes.tools.web.packet_follower import PacketFollower

TURN_S: Final = 0.04
"""How often arrived packets are taken, in seconds."""
LOOK_S: Final = 1.0
"""How often agents are asked to describe themselves, in seconds."""
SILENT_S: Final = 2.5
"""An agent that has not answered for this long is shown as silent, in seconds."""
DETAIL_S: Final = 10.0
"""How often a task is asked for its settings and state, in seconds; after an event about it at the next `LOOK_S`."""
RETRY_S: Final = 0.5
"""How long to wait before the next search for agents if none were found, in seconds."""
RECALL_S: Final = 600.0
"""How far back a new agent is asked for its log, in seconds of mission time."""
MOST_ANSWERS: Final = 20
"""The most replies with earlier log records that one agent is asked for."""
ENDED_S: Final = 1.0
"""Without any agent for this long, the fleet is shown as ended, in seconds."""
ENDED: Final = "the fleet has ended: none of its agents can be reached. You can still look at the timeline"
FOLLOWED: Final = ("battery", "ir", "laser_scan", "motion", "sonar", "world_state")
POSES: Final = ("pose",)


@dataclass
class _PendingRequest:
    """A request that an agent has not answered yet."""

    fleet: FleetSession
    number: int
    until_s: float
    agent: str
    about: str
    answer: Future[Reply] | None = None
    packets: tuple[Cause, ...] = ()


@dataclass
class _MetAgent:
    """When an agent that has been connected was asked, and for what."""

    asked_s: float = -1e9
    answered_s: float = -1e9
    traced_s: float = -1e9
    recalled: int = 0
    detailed_s: dict[str, float] = field(default_factory=dict)
    stale: set[str] = field(default_factory=set)


def fleet_among(described: Iterable[Mapping[str, Any]], fleet: str = "") -> str:
    """Choose a fleet among those of some agents.

    Args:
        described: the results of `Describe` of the agents.
        fleet: the name of the fleet; empty: the only one.

    Raises:
        ControlRefusedError: there are several fleets, and `fleet` is empty.
        UnreachableError: no fleet has that name.
    """
    found = sorted({row["fleet"] for row in described})
    if not fleet and len(found) > 1:
        raise ControlRefusedError(f"several fleets are running, {', '.join(found)}: choose one with --fleet")
    if fleet and fleet not in found:
        raise UnreachableError(f"no agent of the fleet {fleet!r} was found, only of {', '.join(found)}")
    return fleet or found[0]


class Watch:
    """Fill a feed with what a fleet does, from `start` to `close`.

    Args:
        feed: the feed to fill.
        at: addresses to begin with; empty: the agents of this machine.
        fleet: the fleet; empty: the only one.
        timeout_s: the time limit for the first questions, in seconds.
        over: returns whether the watch should end by itself.
    """

    def __init__(
        self,
        feed: Feed,
        at: Sequence[str] = (),
        fleet: str = "",
        timeout_s: float = 3.0,
        over: Callable[[], bool] = lambda: False,
    ) -> None:
        self._feed = feed
        self._at = tuple(at)
        self._fleet = fleet
        self._timeout_s = timeout_s
        self._over = over
        self._stopping = threading.Event()
        self._orders: deque[tuple[str, Any, float, Future[Reply]]] = deque()
        self._thread = threading.Thread(target=self._run, name="page-watch", daemon=True)
        self._follower = PacketFollower(feed, at, lambda: self._fleet, timeout_s)
        self._asked: list[_PendingRequest] = []
        self._met: dict[str, _MetAgent] = {}
        self._rates = RateMeter()
        self._silent: set[str] = set()
        self._traces = FleetTraces()
        self._explainer = CommandExplainer()
        self._seen_s: float | None = None
        self._closed = False

    def start(self) -> None:
        """Begin to watch; wait for agents that have not started yet."""
        self._thread.start()
        self._follower.start()

    def close(self) -> None:
        """Leave the fleet. Not from its own thread."""
        self._stopping.set()
        self._follower.close()
        if self._thread.ident is not None:
            self._thread.join()

    def order(self, agent: str, body: Any, timeout_s: float) -> Future[Reply]:
        """Send an agent a control packet. Any thread.

        Args:
            agent: the name of the agent.
            body: the body of the control packet.
            timeout_s: when to give up, in seconds.

        Returns:
            The reply, or the PancakesError that says why there is none.
        """
        answer: Future[Reply] = Future()
        if self._closed:
            answer.set_exception(UnreachableError("the mission is over: its agents no longer answer"))
            return answer
        self._orders.append((agent, body, timeout_s, answer))
        return answer

    def explain(
        self, agent: str, type_: str = "", t: float | None = None, command: Cause | None = None, step: int = 0
    ) -> dict[str, Any] | None:
        """Return why an agent's actuator was commanded, see `CommandExplainer.explain`; and `left_out`. Any thread."""
        with self._feed.lock:
            found = self._explainer.explain(agent, type_, t, command, step)
            return {**found, "left_out": self._traces.left_out(agent)} if found is not None else None

    # In its thread from here on --------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping.is_set() and not self._over():
            try:
                with Session(self._at, self._timeout_s) as session:
                    self._watch(session)
            except PancakesError as error:
                self._feed.wait_for(str(error))
                self._refuse_all(str(error))
                self._stopping.wait(RETRY_S)
            except Exception as error:
                self._feed.wait_for(f"a defect in Pancakes or in a plug-in: {type(error).__name__}: {error}")
                raise
        self._closed = True
        self._refuse_all("the page no longer watches the fleet")

    def _watch(self, session: Session) -> None:
        found = session.describe().agents
        self._fleet = fleet_among(found, self._fleet)
        session.use_fleet(self._fleet)
        truth = any(row["role"] == "environment" and row["fleet"] == self._fleet for row in found)
        log = SubscriptionSpec(channel=LOG, types=("event", "line"), on_resubscribe=self._recall_again)
        system = SubscriptionSpec(channel=SYSTEM, types=FOLLOWED if truth else FOLLOWED + POSES, max_hz=FRAMES_HZ)
        with Subscription(session, log) as of_log, Subscription(session, system) as of_system:
            self._feed.wait_for("")
            while not self._stopping.wait(TURN_S) and not self._over():
                self._hear(session, of_log)
                self._hear(session, of_system)
                self._tend(session)
                self._check_for_end(session)
                self._feed.record()
            for fleet in session.fleets():
                for hello in fleet.agents():
                    if hello.name in self._met:
                        fleet.request(hello.name, Traces(most=0))

    def _hear(self, session: Session, subscription: Subscription) -> None:
        heard = []
        now_s = session.now()
        while (it := subscription.next(now_s)) is not None:
            heard.append(it)
        if not heard:
            return
        now = self._feed.now()
        with self._feed.lock:
            for it in heard:
                self._feed.model.hear(it.agent, it.packet, now - (now_s - it.at_s))
        if subscription.channel == LOG:
            for it in heard:
                self._notice(it.agent, it.packet)

    def _notice(self, agent: str, packet: Any) -> None:
        """Ask a task again soon after an event about it, because its state may have changed; lines do not matter."""
        met = self._met.get(agent)
        if met is None or packet.type != "event":
            return
        _, _, target = packet.source.partition("/")
        task = packet.body.fields.get("task")
        met.stale.add(f"{target}/{task}" if task and "/" not in target else target)

    def _recall_again(self, agent: str) -> None:
        met = self._met.get(agent)
        if met is not None:
            met.recalled = 0

    def _tend(self, session: Session) -> None:
        """Ask the questions that are due, and take the answers."""
        now_s = session.now()
        fleets = session.fleets()
        for fleet in fleets:
            for hello in fleet.agents():
                met = self._met.setdefault(hello.name, _MetAgent())
                if now_s - met.asked_s >= LOOK_S:
                    met.asked_s = now_s
                    self._ask(fleet, hello.name, Describe(), "look", now_s + SILENT_S)
                    self._ask_details(fleet, hello.name, met, now_s)
            self._ask_traces(fleet, now_s)
        self._take_orders(fleets, now_s)
        self._take_answers(now_s)
        self._take_commands()

    def _check_for_end(self, session: Session) -> None:
        """End the feed if no agent is left; continue it when an agent comes back."""
        now_s = session.now()
        if any(fleet.agents() or fleet.asleep() for fleet in session.fleets()):
            self._seen_s = now_s
            if self._feed.over:
                self._feed.go_on()
        elif self._seen_s is not None and now_s - self._seen_s >= ENDED_S and not self._feed.over:
            self._feed.end(ENDED)

    # Causes of commands, and details of tasks ---------------------------------------------------------------------

    def _ask_traces(self, fleet: FleetSession, now_s: float) -> None:
        for hello in fleet.agents():
            met = self._met[hello.name]
            if now_s - met.traced_s >= self._traces.pause_s(hello.name):
                met.traced_s = now_s
                question = self._traces.question(hello.name)
                self._ask(fleet, hello.name, question, "traces", now_s + SILENT_S).packets = question.packets

    def _take_commands(self) -> None:
        settled = self._traces.settled(self._feed.now())
        if not settled:
            return
        with self._feed.lock:
            for agent in self._explainer.add(settled):
                self._feed.model.commanded(agent, self._explainer.actuators(agent))

    def _ask_details(self, fleet: FleetSession, agent: str, met: _MetAgent, now_s: float) -> None:
        with self._feed.lock:
            running = [f"{service}/{task}" for name, service, task in self._feed.model.running() if name == agent]
        for target in running:
            if target in met.stale or now_s - met.detailed_s.get(target, -1e9) >= DETAIL_S:
                met.detailed_s[target] = now_s
                self._ask(fleet, agent, Describe(target, state=True), "detail", now_s + SILENT_S)
        met.stale.clear()

    def _ask(self, fleet: FleetSession, agent: str, body: Any, about: str, until_s: float) -> _PendingRequest:
        asked = _PendingRequest(fleet, fleet.request(agent, body), until_s, agent, about)
        self._asked.append(asked)
        return asked

    def _take_orders(self, fleets: Sequence[FleetSession], now_s: float) -> None:
        while self._orders:
            agent, body, timeout_s, answer = self._orders.popleft()
            fleet = next((fleet for fleet in fleets if fleet.is_connected(agent)), None)
            if fleet is None:
                answer.set_exception(UnreachableError(f"{agent} cannot be reached"))
                continue
            self._ask(fleet, agent, body, "order", now_s + timeout_s).answer = answer

    def _take_answers(self, now_s: float) -> None:
        left, answered = [], []
        for asked in self._asked:
            answer = asked.fleet.answer(asked.number)
            if answer is None and now_s < asked.until_s:
                left.append(asked)
                continue
            asked.fleet.forget(asked.number)
            if asked.answer is not None:
                self._settle(asked, answer)
            elif isinstance(answer, Reply) and answer.ok:
                answered.append((asked, answer.result))
        self._asked = left
        self._take_looks([(asked, result) for asked, result in answered if asked.about == "look"], now_s)
        now = self._feed.now()
        for asked, result in answered:
            if asked.about == "detail":
                self._feed.take_detail(asked.agent, result)
            with self._feed.lock:
                if asked.about == "recall":
                    self._feed.model.recall(result, now)
                elif asked.about == "traces":
                    self._traces.take(asked.agent, asked.packets, result, now)
            if asked.about == "recall" and result:
                self._recall(asked.fleet, asked.agent, result[-1]["entry"], now_s)

    def _settle(self, asked: _PendingRequest, answer: Reply | str | None) -> None:
        assert asked.answer is not None
        if isinstance(answer, Reply):
            asked.answer.set_result(answer)
        else:
            asked.answer.set_exception(NoAnswerError(f"{asked.agent} did not answer: {answer or 'no reply in time'}"))

    def _take_looks(self, answers: Sequence[tuple[_PendingRequest, Mapping[str, Any]]], now_s: float) -> None:
        described = [result for _, result in answers]
        for it in described:
            self._met[it["agent"]].answered_s = now_s
        silent = {name for name, met in self._met.items() if now_s - met.answered_s >= SILENT_S}
        if not described and silent == self._silent:
            return
        for name in silent - self._silent:
            self._traces.forget(name)
        self._silent = silent
        shown = silent.union(it["agent"] for it in described)
        rows = [row for row in self._rates.update(described) if row["agent"] in shown]
        with self._feed.lock:
            self._feed.model.describe(rows, described, self._feed.now())
        for asked, _ in answers:
            if not self._met[asked.agent].recalled:
                self._recall(asked.fleet, asked.agent, 0, now_s)

    def _recall(self, fleet: FleetSession, agent: str, after: int, now_s: float) -> None:
        met = self._met[agent]
        met.recalled += 1
        if met.recalled <= MOST_ANSWERS:
            self._ask(fleet, agent, History(RECALL_S, after), "recall", now_s + SILENT_S)

    def _refuse_all(self, reason: str) -> None:
        for asked in self._asked:
            if asked.answer is not None:
                asked.answer.set_exception(NoAnswerError(f"{asked.agent} did not answer: {reason}"))
        self._asked = []
        while self._orders:
            *_, answer = self._orders.popleft()
            answer.set_exception(UnreachableError(reason))
