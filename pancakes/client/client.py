"""Talk to running agents from a script, a notebook or a command: `Client` (docs/client.md).

`task_of` and `channel_of` read names such as `AGENT/TASK` and `AGENT/CHANNEL`. Any thread may use a client. Every error
is a `PancakesError` whose text is a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.client.rows import AgentInfo, EventInfo, ReceivedPacket, TaskInfo
from pancakes.client.session import LOOK_S, FleetDescription, FleetSession, Replies, Session, Target
from pancakes.client.subscriptions import KeepAlive, Subscriber, Subscription, SubscriptionSpec
from pancakes.control import CONTROLS, Channels, Configure, Describe, Migrate, Reply, Reschedule, Restart, Start, Stop
from pancakes.errors import (
    ControlRefusedError,
    NoAnswerError,
    PancakesError,
    PeerLostError,
    RemoteProtocolError,
    UnreachableError,
)
from pancakes.mesh.codec import array_head, encode_packet, packet_from_row, rows_from_payload
from pancakes.mesh.session import PeerBusy
from pancakes.migration import MigrationReport
from pancakes.packet import LOG, NEIGHBOURS, SYSCTRL, TO_TASK, Packet, agent_of, join, type_name
from pancakes.util import codecs
from pancakes.util.text import hint_of

if TYPE_CHECKING:
    from typing_extensions import TypeVar  # `typing` has their defaults only from Python 3.13 on

    Body = TypeVar("Body", default=Any)
else:
    from typing import TypeVar

    Body = TypeVar("Body")
Row = TypeVar("Row")

MAX_WAITING: Final = 10_000
"""At most this many packets wait for a subscriber, unless `max_waiting` gives another number."""
MIGRATE_S: Final = 30.0
"""The time limit of a migration, which may have to wait for the task, and carries its state."""
DESCRIBED_S: Final = 1.0
"""How long an agent's description is used: its mission may have been held, and have begun since."""
BUSY_S: Final = 0.02
"""After how long to send a packet again if there was no room for it."""


def task_of(task: str | TaskInfo) -> tuple[str, str]:
    """Return the agent of a task, and the task as that agent reads it (see `pancakes.control`).

    Raises:
        PancakesError: it is not such a name.
    """
    agent, *rest = str(task).split("/")
    if not agent or len(rest) not in (1, 2) or not all(rest):
        raise PancakesError(f"{str(task)!r} names no task: write it as AGENT/TASK or AGENT/SERVICE/TASK")
    return agent, "/".join(rest)


def channel_of(channel: str) -> tuple[str, str]:
    """Return the agent of a channel, empty if it names none, and the channel's name.

    Raises:
        PancakesError: it is not such a name.
    """
    *agent, name = channel.split("/")
    if len(agent) > 1 or not all([*agent, name]):
        raise PancakesError(f"{channel!r} names no channel: write it as AGENT/CHANNEL, or CHANNEL for all agents")
    return "".join(agent), name


def destination_on(agent: str, to: str) -> str:
    """Return the address on an agent that `SERVICE/TASK` means, with or without the agent before it. Pure.

    Raises:
        PancakesError: it is not such an address.
    """
    if not to:
        return agent
    address = to if agent_of(to) == agent else join(agent, to)
    if to == NEIGHBOURS or to.startswith(TO_TASK) or address.count("/") > 2 or not all(address.split("/")):
        raise PancakesError(f"{to!r} is not a service or task of {agent}: write it as SERVICE/TASK")
    return address


def check_body(body: Any) -> None:
    """Encode and decode a body, as it will be on its way to an agent. Pure.

    Raises:
        PancakesError: a value in it does not fit its type, or cannot travel.
    """
    message = encode_packet(Packet(SYSCTRL, type_name(body), "this program", "", 0.0, 1, body))
    try:
        packet_from_row(rows_from_payload(array_head(1) + message)[0])
    except RemoteProtocolError as error:
        raise PancakesError(f"{type(body).__name__} cannot be sent: {error}") from None


def check_timeout(timeout_s: float | None) -> float | None:
    """Return a time limit as it is; None stays None.

    Raises:
        PancakesError: it is not a time limit.
    """
    if timeout_s is None:
        return None
    if not (isinstance(timeout_s, (int, float)) and math.isfinite(timeout_s) and timeout_s > 0):
        raise PancakesError(f"a time limit is a number of seconds above 0, not {timeout_s!r}")
    return timeout_s


def log_warning(text: str) -> None:
    """Log a sentence as a warning, which Python shows on standard error unless configured otherwise."""
    import logging  # only now: few commands need it

    logging.getLogger("pancakes.client").warning("%s", text)


@dataclass(frozen=True, slots=True)
class _Described:
    """What was learned of an agent to which packets are published.

    Attributes:
        session: the session in its fleet.
        at_s: when it described itself, in host time.
        mission_s: its mission time then.
        speed: mission seconds for each second; 0 if its mission is held.
        channels: its channels.
    """

    session: FleetSession
    at_s: float
    mission_s: float
    speed: float
    channels: tuple[str, ...]


class Client:
    """Speak to the agents of this machine, or to those at given addresses, and through any of them to their fleets.

        with Client() as client:
            for task in client.tasks():
                print(task, task.state, task.rate_hz)

    What cannot be done raises a `PancakesError`, whose text is a sentence. Any thread may use it. At the end of `with`
    all subscribers end, and what was published has arrived. `AsyncClient` is the same for asyncio.

    Args:
        at: an address to begin with (`HOST`, `HOST:PORT` or `local://NAME`), or several; none: what runs on
            this machine. A `Target` names a fleet as well.
        timeout_s: the time limit of each call, in seconds.
        say: takes sentences about what is not an error: an agent is silent, goes or comes back, or a subscriber is
            too slow. It may be called in another thread. By default they are warnings of the logger `pancakes.client`.
        fleet: only agents of this fleet; empty: of any.

    Attributes:
        timeout_s: the same.

    Raises:
        PancakesError: an address or the time limit is not valid, or the runtime directory cannot be used.
    """

    def __init__(
        self,
        at: Target | str | Sequence[str] = (),
        timeout_s: float = 3.0,
        say: Callable[[str], None] = log_warning,
        *,
        fleet: str = "",
    ) -> None:
        check_timeout(timeout_s)
        self.timeout_s = timeout_s
        self._say = say
        self._session = Session(Target.of(at, fleet), timeout_s)
        self._keep_alive = KeepAlive()
        self._described: dict[str, _Described] = {}
        self._unsettled: dict[str, None] = {}  # agents that may not have got all that was published, in order
        self._probed_s = self.now()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        try:
            if kind is None:
                self.settle()
        except PancakesError as fault:
            self._say(f"it is not known whether the last published packets have arrived: {fault}")
        finally:
            self.close()

    def close(self) -> None:
        """End all subscribers, and leave all fleets."""
        self._keep_alive.close()
        self._session.close()

    # What is there ---------------------------------------------------------------------------------------------

    def agents(self, *agents: str, timeout_s: float | None = None) -> list[AgentInfo]:
        """Return what all agents, or those named, report about themselves, by fleet and name.

        Args:
            agents: only these.
            timeout_s: the time limit; None: that of the client.

        Raises:
            UnreachableError: no agent answers in time, or no agent has one of the names.
            ControlRefusedError: agents of two fleets have the same name.
        """
        return [_row(AgentInfo, found, found) for found in self._surveyed(agents, timeout_s)]

    def tasks(self, *agents: str, timeout_s: float | None = None) -> list[TaskInfo]:
        """Return the tasks of all agents, or of those named; arguments and errors are those of `agents`."""
        return [_row(TaskInfo, row, found) for found in self._surveyed(agents, timeout_s) for row in found["tasks"]]

    def settings(self, task: str | TaskInfo, *, timeout_s: float | None = None) -> dict[str, Any]:
        """Return the settings of a task; arguments and errors are those of `configure`."""
        agent, target = task_of(task)
        found: Any = self._ordered(agent, Describe(target), timeout_s).result
        if not isinstance(found, dict) or "settings" not in found:
            raise ControlRefusedError(f"{agent}/{target} is a service, not a task: it has no settings of that kind")
        return dict(found["settings"])

    # What is published -----------------------------------------------------------------------------------------

    def subscribe(
        self,
        channel: str,
        *types: type[Body] | str,
        callback: Callable[[ReceivedPacket[Body]], object] | None = None,
        agents: Sequence[str] = (),
        include_remote: bool = False,
        max_waiting: int = MAX_WAITING,
        timeout_s: float | None = None,
        on_resubscribe: Callable[[str], None] = lambda agent: None,
    ) -> Subscriber[ReceivedPacket[Body]]:
        """Subscribe to a channel, until the subscriber is closed.

        It subscribes again at agents that go away and come back. If this program is too slow, the oldest packets are
        dropped; `Subscriber.missed` counts them.

        Args:
            channel: `AGENT/CHANNEL`; or only `CHANNEL`, for that of all agents, including those that come later.
            types: only packets of these types, classes or their names; none: all. If only the name of a type is known
                here, the body is a plain mapping.
            callback: takes each packet, in a thread of its own, one after the other. Without it the caller reads them.
            agents: only these, if the channel names none.
            include_remote: also packets that other agents sent to the channel.
            max_waiting: at most this many packets wait, fewer if they are large.
            timeout_s: how long the reader waits for one packet; None: no limit.
            on_resubscribe: takes the name of an agent that is subscribed to again: what it published meanwhile was
                missed.

        Raises:
            UnreachableError: there is no such agent, or none at all, or none answers in time.
            ControlRefusedError: the agents have no such channel.
            PancakesError: a class is not a packet type, or an argument makes no sense.
        """
        spec = SubscriptionSpec(
            channel=channel,
            types=tuple(it if isinstance(it, str) else type_name(it) for it in types),
            agents=(agents,) if isinstance(agents, str) else tuple(agents),
            include_remote=include_remote,
            max_waiting=max_waiting,
            on_resubscribe=on_resubscribe,
        )
        return self._subscribe(spec, lambda received: received, callback, timeout_s)

    def events(
        self,
        *agents: str,
        kinds: Collection[str] = (),
        callback: Callable[[EventInfo], object] | None = None,
        max_waiting: int = MAX_WAITING,
        timeout_s: float | None = None,
    ) -> Subscriber[EventInfo]:
        """Subscribe to the events and log lines that all agents, or those named, publish on `log`.

        Args:
            agents: only these.
            kinds: only events of these kinds, such as `task_started`; log lines have the kind `line`. None: all.
            callback: see `subscribe`, as for all others and the errors.
            max_waiting: see `subscribe`.
            timeout_s: see `subscribe`.
        """
        wanted = frozenset((kinds,) if isinstance(kinds, str) else kinds)

        def accepts(packet: Packet) -> bool:
            return not wanted or getattr(packet.body, "kind", packet.type) in wanted

        spec = SubscriptionSpec(
            channel=LOG, types=("event", "line"), agents=agents, max_waiting=max_waiting, accepts=accepts
        )
        return self._subscribe(spec, EventInfo.of, callback, timeout_s)

    def _subscribe(
        self,
        spec: SubscriptionSpec,
        make: Callable[[ReceivedPacket[Any]], Row],
        callback: Callable[[Row], object] | None,
        timeout_s: float | None,
    ) -> Subscriber[Row]:
        """Subscribe; the channel may name its agent."""
        agent, channel = channel_of(spec.channel)
        if agent and spec.agents:
            raise PancakesError(
                f"{spec.channel!r} names its agent: to name others as well, give only the channel, {channel!r}"
            )
        if spec.max_waiting < 1:
            raise PancakesError(f"max_waiting is a number of packets from 1, not {spec.max_waiting}")
        check_timeout(timeout_s)
        name = spec.channel if agent or not spec.agents else ", ".join(f"{it}/{channel}" for it in spec.agents)
        agents = (agent,) if agent else spec.agents
        self._refresh()
        subscription = Subscription(self._session, replace(spec, channel=channel, agents=agents), self._say)
        subscriber = Subscriber(self._session, subscription, make, name, timeout_s, self._say, self._keep_alive.remove)
        self._keep_alive.add(subscriber)
        if callback is not None:
            subscriber.call_for_each(callback)
        return subscriber

    # What is done ----------------------------------------------------------------------------------------------

    def publish(self, channel: str, body: Any, *, to: str = "", timeout_s: float | None = None) -> None:
        """Publish a packet on a channel of an agent, in that agent's mission time.

        It waits only until there is room: `settle` waits for arrival. A slow agent gets only the newest on `system`.

        Args:
            channel: `AGENT/CHANNEL`.
            body: the packet's body, an instance of a packet type.
            to: only to this service or task of the agent, `SERVICE/TASK`; empty: to all that subscribe there.
            timeout_s: the time limit; None: that of the client.

        Raises:
            UnreachableError: the agent is not there.
            NoAnswerError: it is too slow, and takes no packet in time.
            ControlRefusedError: it has no such channel.
            PancakesError: a value in the body does not fit its type, or cannot travel.
        """
        agent, name = channel_of(channel)
        if not agent:
            raise PancakesError(f"{channel!r} names no channel of an agent: write it as AGENT/CHANNEL")
        type_name(body)
        self._refresh_for(agent)
        check_timeout(timeout_s)
        if name == SYSCTRL and type(body) in CONTROLS:
            raise PancakesError(
                f"{type(body).__name__} is a control packet, whose answer counts: client.request({agent!r}, ...)"
            )
        check_body(body)
        known = self._describe(agent, timeout_s)
        if name not in known.channels:
            raise ControlRefusedError(f"{agent} has no channel {name!r}{hint_of(name, known.channels)}")
        stamp_s = known.mission_s + (self.now() - known.at_s) * known.speed
        destination = destination_on(agent, to)
        self._send(agent, lambda: known.session.publish(agent, name, body, stamp_s, destination), timeout_s)

    def send(self, packet: Packet, *, timeout_s: float | None = None) -> None:
        """Send a packet unchanged, such as a recorded one, to the agent that its destination names.

        The errors are those of `publish`.
        """
        check_timeout(timeout_s)
        agent = agent_of(packet.destination)
        session = self._session.fleet_of(agent)
        self._send(agent, lambda: session.send(packet), timeout_s)

    def settle(self, *, timeout_s: float | None = None) -> None:
        """Wait until the agents have got all that was published.

        Raises:
            UnreachableError: one of them does not answer in time.
        """
        check_timeout(timeout_s)
        for agent in list(self._unsettled):
            # A link keeps the order, so the answer comes after all else has arrived.
            self._request(agent, Channels(LOG), timeout_s)
            self._unsettled.pop(agent, None)

    def waiting(self, agent: str) -> int:
        """Return how many packets wait here because an agent, or the link to it, is too slow for them."""
        return self._session.fleet_of(agent).waiting(agent)

    def start(
        self,
        target: str | TaskInfo,
        settings: Mapping[str, Any] | None = None,
        *,
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """Start a stopped task or service, and wait until it runs.

        Args:
            target: `AGENT/TASK`, `AGENT/SERVICE` or `AGENT/SERVICE/TASK`, or a row of `tasks`.
            settings: settings of a task that differ from its configuration's.
            dry_run: only ask whether it could be started.
            timeout_s: the time limit; None: that of the client.

        Returns:
            The agent's reply.

        Raises:
            ControlRefusedError: it runs already, does not exist, or cannot be started; the message says why.
            UnreachableError: there is no such agent.
            NoAnswerError: it does not answer in time.
        """
        agent, name = task_of(target)
        return self._ordered(agent, Start(name, settings, dry_run), timeout_s)

    def stop(
        self,
        target: str | TaskInfo,
        *,
        for_s: float | None = None,
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """Stop a task or a service, and wait until it has ended.

        Args:
            target: see `start`.
            for_s: a service starts again by itself after this time, in mission seconds; None: it does not.
            dry_run: only ask whether it could be stopped.
            timeout_s: the time limit; None: that of the client.

        Returns:
            The agent's reply.

        Raises:
            ControlRefusedError: it does not exist, or must not be stopped now; the message says why.
            UnreachableError: there is no such agent.
            NoAnswerError: it does not answer in time.
        """
        agent, name = task_of(target)
        return self._ordered(agent, Stop(name, for_s, dry_run), timeout_s)

    def restart(
        self,
        target: str | TaskInfo,
        *,
        keep_state: bool = True,
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """Stop a task or a service and start it again, and wait until it runs.

        Args:
            target: see `start`.
            keep_state: whether a task, or each task of a service, keeps its state and settings.
            dry_run: only ask whether it could be restarted.
            timeout_s: the time limit; None: that of the client.

        Returns:
            The agent's reply.

        Raises:
            ControlRefusedError: it does not exist, or cannot be restarted; the message says why.
            UnreachableError: there is no such agent.
            NoAnswerError: it does not answer in time.
        """
        agent, name = task_of(target)
        return self._ordered(agent, Restart(name, keep_state, dry_run), timeout_s)

    def set_rate(
        self,
        task: str | TaskInfo,
        rate_hz: float,
        *,
        timer: str = "",
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """Change the rate of a time-driven task, from its next tick on.

        Args:
            task: `AGENT/TASK` or `AGENT/SERVICE/TASK`, or a row of `tasks`.
            rate_hz: ticks for each second of mission time; 0 stops the ticks.
            timer: the method that ticks, if the task has several; empty: the first.
            dry_run: only ask whether the rate could be changed.
            timeout_s: the time limit; None: that of the client.

        Returns:
            The agent's reply, whose `result` has the rate before.

        Raises:
            ControlRefusedError: the task does not exist, or has no such timer; the message says why.
            UnreachableError: there is no such agent.
            NoAnswerError: it does not answer in time.
        """
        agent, name = task_of(task)
        return self._ordered(agent, Reschedule(name, rate_hz, timer, dry_run), timeout_s)

    def configure(
        self,
        task: str | TaskInfo,
        settings: Mapping[str, Any],
        *,
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """Change some of the settings of a running task; if one of them is refused, nothing changes.

        Args:
            task: `AGENT/TASK` or `AGENT/SERVICE/TASK`, or a row of `tasks`.
            settings: the new values, by name.
            dry_run: only ask whether the task would accept them.
            timeout_s: the time limit; None: that of the client.

        Returns:
            The agent's reply; events on `log` that the change led to carry its `number`.

        Raises:
            ControlRefusedError: the task refuses, or does not exist; the message says why.
            UnreachableError: there is no such agent.
            NoAnswerError: it does not answer in time.
        """
        agent, target = task_of(task)
        return self._ordered(agent, Configure(target, settings, dry_run), timeout_s)

    def migrate(
        self,
        task: str | TaskInfo,
        to: str = "",
        *,
        then: str = "",
        cost: str | dict[str, float] = "tasks",
        dry_run: bool = False,
        timeout_s: float = MIGRATE_S,
    ) -> MigrationReport:
        """Migrate a running task to the neighbour that takes it for the lowest cost, and wait until it runs there.

        Args:
            task: `AGENT/TASK` or `AGENT/SERVICE/TASK`, or a row of `tasks`.
            to: the only neighbour to ask; empty: all.
            then: a task to start on the old agent once this one has left.
            cost: the cost function that the neighbours bid with, or the weight of each of several.
            dry_run: only ask for bids, and migrate nothing.
            timeout_s: the time limit.

        Returns:
            The account of the migration: which neighbours were asked, what each answered, and which has the task.

        Raises:
            ControlRefusedError: no neighbour takes it, or there is no such task; it keeps running where it is.
            UnreachableError: there is no such agent.
            NoAnswerError: no answer came in time; the migration may go on all the same.
        """
        agent, target = task_of(task)
        try:
            reply = self._ordered(agent, Migrate(target, to, then, cost, dry_run), timeout_s)
        except NoAnswerError as error:
            raise NoAnswerError(f"{error}; the migration may go on all the same") from None
        return _row(MigrationReport, reply.result, {"agent": agent})

    # Control packets -------------------------------------------------------------------------------------------

    def request(self, agent: str, body: Any, timeout_s: float | None = None) -> Reply:
        """Send a control packet to one agent, and wait for its reply.

        Args:
            agent: its name.
            body: a control packet's body, such as `Stop("client/ScanTarget")` (`pancakes.control`).
            timeout_s: the time limit; None: that of the client.

        Returns:
            Its reply; if `ok` is False, its `reason` says why.

        Raises:
            UnreachableError: there is no such agent.
            NoAnswerError: it does not answer in time.
            ControlRefusedError: agents of two fleets have this name.
            PancakesError: a value in the body does not fit its type, or cannot travel, so it was not asked.
        """
        check_timeout(timeout_s)
        check_body(body)
        self._refresh_for(agent)
        return self._request(agent, body, timeout_s)

    def describe(self, *agents: str, timeout_s: float | None = None) -> FleetDescription:
        """Return all that agents report about themselves, plain, and a sentence for each silent one; see `agents`."""
        self._refresh()
        return self._session.describe(*agents, timeout_s=check_timeout(timeout_s))

    def request_all(self, body: Any, *agents: str, timeout_s: float | None = None) -> Replies:
        """Send the same control packet to all agents, or those named, at once; the errors are those of `agents`.

        Args:
            body: a control packet's body that changes nothing, such as `Channels()`.
            agents: only these.
            timeout_s: the time limit; None: that of the client.
        """
        self._refresh()
        return self._session.request_all(body, *agents, timeout_s=check_timeout(timeout_s))

    # Which agents are meant ------------------------------------------------------------------------------------

    def is_reachable(self, agent: str, fleet: str = "") -> bool:
        """Return whether an agent of this name can be reached. Waits until it can, or until all others have answered.

        Args:
            agent: its name.
            fleet: only if it is of this fleet; empty: of any.
        """
        self._refresh_for(agent)
        if not self.is_connected(agent, fleet):
            self._session.search(lambda: self.is_connected(agent, fleet))
        return self.is_connected(agent, fleet)

    def is_connected(self, agent: str, fleet: str = "") -> bool:
        """Return whether an agent can be asked now, without waiting; the arguments are those of `is_reachable`."""
        return self._session.is_connected(agent, fleet)

    def is_own(self, name: str) -> bool:
        """Return whether a name that agents report (`by`, the other end of a link) is that of this client."""
        return self._session.is_own(name)

    def use_fleet(self, fleet: str) -> None:
        """Speak only to the agents of one fleet from now on."""
        self._session.use_fleet(fleet)

    def now(self) -> float:
        """Return the host time, in seconds: that of `ReceivedPacket.at_s`."""
        return self._session.now()

    def wait(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until a condition is true, which is checked every 0.1 s.

        Args:
            condition: returns whether it is true; it may ask this client.
            timeout_s: how long at most; None: the time limit of the client.

        Returns:
            Whether it is true now.
        """
        until_s = self._session.until_s(check_timeout(timeout_s))
        while not condition():
            now_s = self.now()
            if now_s >= until_s:
                return False
            self._session.wait(min(until_s, now_s + LOOK_S), lambda: False)
        return True

    # Within ----------------------------------------------------------------------------------------------------

    def _request(self, agent: str, body: Any, timeout_s: float | None) -> Reply:
        until_s = self._session.until_s(timeout_s)
        fleet = self._session.find(agent, until_s)
        number = fleet.request(agent, body)
        self._session.wait(until_s, lambda: fleet.answer(number) is not None)
        answer = fleet.answer(number)
        fleet.forget(number)
        if isinstance(answer, Reply):
            return answer
        raise NoAnswerError(f"{agent} did not answer: {answer or self._session.too_late(timeout_s)}")

    def _ordered(self, agent: str, body: Any, timeout_s: float | None) -> Reply:
        reply = self.request(agent, body, timeout_s)
        if not reply.ok:
            raise ControlRefusedError.of(reply.refusal)
        return reply

    def _surveyed(self, agents: Sequence[str], timeout_s: float | None) -> list[dict[str, Any]]:
        found = self.describe(*agents, timeout_s=timeout_s)
        for sentence in found.silent:
            self._say(sentence)
        return found.agents

    def _describe(self, agent: str, timeout_s: float | None) -> _Described:
        """Return the channels and the mission time of an agent; it is asked if they are not known, or too old."""
        known = self._described.get(agent)
        if known is not None and self.now() - known.at_s < DESCRIBED_S and known.session.is_connected(agent):
            return known
        reply = self._request(agent, Describe(), timeout_s)
        if not reply.ok:
            raise ControlRefusedError.of(reply.refusal)
        found = reply.result
        speed = 0.0 if found["held"] else found["speed"]
        session = self._session.fleet_of(agent)
        known = _Described(session, self.now(), found["mission_s"], speed, tuple(found["channels"]))
        self._described[agent] = known
        return known

    def _send(self, agent: str, send: Callable[[], None], timeout_s: float | None) -> None:
        """Send a packet, again and again while there is no room for it."""
        until_s = self._session.until_s(timeout_s)
        self._unsettled[agent] = None
        while True:
            try:
                send()
                return
            except PeerLostError as error:
                raise UnreachableError(str(error)) from None
            except PeerBusy as error:
                if self.now() >= until_s:
                    limit_s = self.timeout_s if timeout_s is None else timeout_s
                    raise NoAnswerError(f"{agent} is too slow, and had no room within {limit_s:g} s: {error}") from None
                self._session.wait(self.now() + BUSY_S, lambda: False)

    def _refresh(self) -> None:
        """Find what was started since."""
        self._session.refresh()
        if self.now() - self._probed_s >= LOOK_S:  # each probe costs a connection for each address
            self._session.probe_again()
            self._probed_s = self.now()

    def _refresh_for(self, agent: str) -> None:
        if not self.is_connected(agent):
            self._refresh()


def _row(kind: type[Row], plain: Any, description: Mapping[str, Any]) -> Row:
    try:
        return codecs.convert(plain, kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(
            f"{description['agent']} sent an answer that cannot be read here, so it runs another version: {error}"
        ) from None
