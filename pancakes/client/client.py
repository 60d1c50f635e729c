"""Talk to running agents from a script, a notebook or a command: `Client` (docs/client.md).

`Publisher` stamps packets with the mission time of the agent that gets them. `task_of` and `channel_of` read names such
as `AGENT/TASK` and `AGENT/CHANNEL`. Any thread may use a client. Errors are `PancakesError`s whose text is a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar, overload

import msgspec

from pancakes.client.mesh_client import MeshClient, Replies, Survey, Where
from pancakes.client.rows import AgentRow, EventRow, HeardPacket, TaskRow
from pancakes.client.session import LOOK_S, Door
from pancakes.client.subscriptions import Following, Subscriber, Tender
from pancakes.control import CONTROLS, Channels, Configure, Describe, Migrate, Reply
from pancakes.durable.ledger import Ledger
from pancakes.errors import ControlRefused, NoAnswer, PancakesError, PeerLost, RemoteProtocolError, Unreachable
from pancakes.mesh.codec import Encoder, array_head, packet_from_row, rows_from_payload
from pancakes.mesh.session import PeerBusy
from pancakes.packet import LOG, NEIGHBOURS, SYSCTRL, TO_TASK, Packet, agent_of, join, type_name
from pancakes.util import codecs
from pancakes.util.text import hint_of


def task_of(task: str | TaskRow) -> tuple[str, str]:
    """Returns the agent of a task, and the task as that agent reads it (see `pancakes.control`).

    Raises:
        PancakesError: it is no such name.
    """
    agent, *rest = str(task).split("/")
    if not agent or len(rest) not in (1, 2) or not all(rest):
        raise PancakesError(f"{str(task)!r} names no task: write it as AGENT/TASK or AGENT/SERVICE/TASK")
    return agent, "/".join(rest)


def channel_of(channel: str) -> tuple[str, str]:
    """Returns the agent of a channel, empty where it names none, and the channel's name.

    Raises:
        PancakesError: it is no such name.
    """
    *agent, name = channel.split("/")
    if len(agent) > 1 or not all([*agent, name]):
        raise PancakesError(f"{channel!r} names no channel: write it as AGENT/CHANNEL, or CHANNEL for all agents")
    return "".join(agent), name


ANEW_S: Final = 1.0
"""How old what is known of an agent's mission may be: it may have been held, and have begun."""
AGAIN_S: Final = 0.02
"""When a packet is tried again for which there was no room."""


@dataclass(frozen=True, slots=True)
class _Known:
    """What is known of an agent that packets go to.

    Attributes:
        door: leads to it.
        at_s: when it told the rest, in host time.
        mission_s: its mission time then.
        speed: mission seconds for each second; 0 where its mission is held.
        channels: its channels.
    """

    door: Door
    at_s: float
    mission_s: float
    speed: float
    channels: tuple[str, ...]


class Publisher:
    """Sends packets to agents, in order. One thread at a time.

    Args:
        client: reaches the agents.
    """

    def __init__(self, client: MeshClient) -> None:
        self._client = client
        self._known: dict[str, _Known] = {}
        self._unsettled: dict[str, None] = {}

    def publish(self, agent: str, channel: str, body: Any, to: str, timeout_s: float | None) -> None:
        """Publishes a packet on a channel of an agent; see `pancakes.client.Client.publish`."""
        if channel == SYSCTRL and type(body) in CONTROLS:
            raise PancakesError(
                f"{type(body).__name__} is a control packet, whose answer counts: client.request({agent!r}, ...)"
            )
        check_body(body)
        known = self._of(agent, timeout_s)
        if channel not in known.channels:
            raise ControlRefused(f"{agent} has no channel {channel!r}{hint_of(channel, known.channels)}")
        stamp_s = known.mission_s + (self._client.now() - known.at_s) * known.speed
        destination = destination_on(agent, to)
        self._try(agent, lambda: known.door.publish(agent, channel, body, stamp_s, destination), timeout_s)

    def send(self, packet: Packet, timeout_s: float | None) -> None:
        """Sends a packet as it stands; see `pancakes.client.Client.send`."""
        agent = agent_of(packet.destination)
        door = self._client.door(agent)
        self._try(agent, lambda: door.send(packet), timeout_s)

    def settle(self, timeout_s: float | None) -> None:
        """Waits until all agents have got what was sent to them; see `pancakes.client.Client.settle`."""
        for agent in list(self._unsettled):
            # A link keeps the order, so the answer comes after all else has arrived.
            self._client.request(agent, Channels(LOG), timeout_s)
            self._unsettled.pop(agent, None)

    def _of(self, agent: str, timeout_s: float | None) -> _Known:
        known = self._known.get(agent)
        now_s = self._client.now()
        if known is not None and now_s - known.at_s < ANEW_S and known.door.connected(agent):
            return known
        reply = self._client.request(agent, Describe(), timeout_s)
        if not reply.ok:
            raise ControlRefused(reply.reason)
        told = reply.result
        speed = 0.0 if told["held"] else told["speed"]
        door = self._client.door(agent)
        self._known[agent] = _Known(door, self._client.now(), told["mission_s"], speed, tuple(told["channels"]))
        return self._known[agent]

    def _try(self, agent: str, send: Any, timeout_s: float | None) -> None:
        limit_s = self._client.timeout_s if timeout_s is None else timeout_s
        until_s = self._client.now() + limit_s
        self._unsettled[agent] = None
        while True:
            try:
                send()
                return
            except PeerLost as error:
                raise Unreachable(str(error)) from None
            except PeerBusy as error:
                if self._client.now() >= until_s:
                    raise NoAnswer(f"{agent} is too slow, and found no room within {limit_s:g} s: {error}") from None
                self._client.wait(self._client.now() + AGAIN_S, lambda: False)


def check_body(body: Any) -> None:
    """Takes a body apart as the agent will that gets it; pure.

    Raises:
        PancakesError: a value in it does not fit its type, or cannot travel.
    """
    message = Encoder().packet(Packet(SYSCTRL, type_name(body), "this program", "", 0.0, 1, body))
    try:
        packet_from_row(rows_from_payload(array_head(1) + message)[0])
    except RemoteProtocolError as error:
        raise PancakesError(f"{type(body).__name__} cannot be sent: {error}") from None


def destination_on(agent: str, to: str) -> str:
    """Returns the address on an agent that is meant by `SERVICE/TASK`, with the agent before it or without; pure.

    Raises:
        PancakesError: it is no such address.
    """
    if not to:
        return agent
    address = to if agent_of(to) == agent else join(agent, to)
    if to == NEIGHBOURS or to.startswith(TO_TASK) or address.count("/") > 2 or not all(address.split("/")):
        raise PancakesError(f"{to!r} is no service or task of {agent}: write it as SERVICE/TASK")
    return address


Body = TypeVar("Body")
Row = TypeVar("Row")

MOST_WAITING: Final = 10_000
"""So many packets wait for a subscriber where it does not say another number."""
MOVE_S: Final = 30.0
"""The time limit of a move, which may have to wait for the task, and carries its state."""


def say_in_log(text: str) -> None:
    """Says something by Python's `logging`, which shows it on standard error unless it is told otherwise."""
    import logging  # only now: few commands need it

    logging.getLogger("pancakes.client").warning("%s", text)


class Client:
    """Speaks to the agents of this machine, or to those at given addresses, and through any of them to their fleets.

        with Client() as client:
            for task in client.tasks():
                print(task, task.state, task.rate_hz)

    What cannot be done raises a `PancakesError`, whose text is a sentence. Any thread may use it. At the end of `with`
    all subscribers end, and what was published has arrived. `AsyncClient` is its twin for asyncio.

    Args:
        at: an address to begin with (`HOST:PORT`, `tcp://HOST:PORT` or `local://NAME`), or several; none: what runs on
            this machine. A `Where` names a fleet as well.
        timeout_s: the time limit of each call, in seconds.
        say: takes sentences about what is no error: an agent that is silent, goes or comes back, a subscriber that is
            too slow. It may be called in another thread. Without, they are warnings of the logger `pancakes.client`.

    Attributes:
        timeout_s: the same.

    Raises:
        PancakesError: one of them is no address, the time limit is none, or the runtime directory cannot be used.
    """

    def __init__(
        self,
        at: Where | str | Sequence[str] = (),
        timeout_s: float = 3.0,
        say: Callable[[str], None] = say_in_log,
    ) -> None:
        self.timeout_s = checked(timeout_s)
        self._say = say
        self._mesh = MeshClient(at, timeout_s)
        self._publisher = Publisher(self._mesh)
        self._tender = Tender()
        self._looked_s = self.now()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        try:
            if kind is None:
                self.settle()
        except PancakesError as fault:
            self._say(f"whether the last packets that were published have arrived is not known: {fault}")
        finally:
            self.close()

    def close(self) -> None:
        """Ends all subscribers, and leaves all fleets."""
        self._tender.close()
        self._mesh.close()

    # What is there ---------------------------------------------------------------------------------------------

    def agents(self, *agents: str, timeout_s: float | None = None) -> list[AgentRow]:
        """Returns what all agents, or those named, say of themselves, by fleet and name.

        Args:
            agents: only these.
            timeout_s: the time limit; None: that of the client.

        Raises:
            Unreachable: no agent answers in time, or there is none of a name.
            ControlRefused: agents of two fleets bear a name.
        """
        return [_row(AgentRow, told, told) for told in self._surveyed(agents, timeout_s)]

    def tasks(self, *agents: str, timeout_s: float | None = None) -> list[TaskRow]:
        """Returns the tasks of all agents, or of those named; arguments and errors are those of `agents`."""
        return [_row(TaskRow, row, told) for told in self._surveyed(agents, timeout_s) for row in told["tasks"]]

    def settings(self, task: str | TaskRow, *, timeout_s: float | None = None) -> dict[str, Any]:
        """Returns the settings of a task; arguments and errors are those of `configure`."""
        agent, target = task_of(task)
        found: Any = self._ordered(agent, Describe(target), timeout_s).result
        if not isinstance(found, dict) or "settings" not in found:
            raise ControlRefused(f"{agent}/{target} is a service, not a task: it has no settings of that kind")
        return dict(found["settings"])

    # What is heard ---------------------------------------------------------------------------------------------

    @overload
    def subscribe(
        self,
        channel: str,
        *types: str,
        callback: Callable[[HeardPacket[Any]], object] | None = None,
        agents: Sequence[str] = (),
        foreign: bool = False,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
        followed_anew: Callable[[str], None] = lambda agent: None,
    ) -> Subscriber[HeardPacket[Any]]: ...

    @overload
    def subscribe(
        self,
        channel: str,
        *types: type[Body],
        callback: Callable[[HeardPacket[Body]], object] | None = None,
        agents: Sequence[str] = (),
        foreign: bool = False,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
        followed_anew: Callable[[str], None] = lambda agent: None,
    ) -> Subscriber[HeardPacket[Body]]: ...

    def subscribe(
        self,
        channel: str,
        *types: Any,
        callback: Callable[[HeardPacket[Any]], object] | None = None,
        agents: Sequence[str] = (),
        foreign: bool = False,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
        followed_anew: Callable[[str], None] = lambda agent: None,
    ) -> Subscriber[HeardPacket[Any]]:
        """Listens to a channel, from now on until the subscriber is closed.

        Agents that go away are listened to again when they come back. Where this program is too slow the oldest packets
        fall out; `Subscriber.missed` counts them.

        Args:
            channel: `AGENT/CHANNEL`; or only `CHANNEL`, for that of all agents, those too that come later.
            types: only packets of these types, classes or their names; none: all. Of a type that is known here by name
                alone the body is a plain mapping.
            callback: takes each packet, in a thread of its own, one after the other. Without, the caller reads them.
            agents: only these, where the channel names none.
            foreign: whether packets count that came to the channel from other agents.
            most: so many packets wait at the most, of large ones fewer.
            timeout_s: how long the reader waits for one packet; None: without end.
            followed_anew: takes the name of an agent that is listened to again: what it said meanwhile was missed.

        Raises:
            Unreachable: there is no such agent, or none at all, or none answers in time.
            ControlRefused: the agents have no such channel.
            PancakesError: a class is no packet type, or an argument makes no sense.
        """
        names = [it if isinstance(it, str) else type_name(it) for it in types]
        return self._subscriber(
            channel, names, lambda heard: heard, callback, agents, foreign, most, timeout_s, followed_anew
        )

    def events(
        self,
        *agents: str,
        kinds: Collection[str] = (),
        callback: Callable[[EventRow], object] | None = None,
        most: int = MOST_WAITING,
        timeout_s: float | None = None,
    ) -> Subscriber[EventRow]:
        """Listens to what all agents, or those named, say on `log`: events, and lines for people.

        Args:
            agents: only these.
            kinds: only events of these kinds, such as `task_started`; `line` is that of lines. None: all.
            callback: see `subscribe`, as all others and the errors.
            most: see there.
            timeout_s: see there.
        """
        wanted = frozenset((kinds,) if isinstance(kinds, str) else kinds)

        def wants(packet: Packet) -> bool:
            return not wanted or getattr(packet.body, "kind", packet.type) in wanted

        return self._subscriber(
            LOG, ("event", "line"), EventRow.of, callback, agents, False, most, timeout_s, lambda agent: None, wants
        )

    # What is done ----------------------------------------------------------------------------------------------

    def publish(self, channel: str, body: Any, *, to: str = "", timeout_s: float | None = None) -> None:
        """Publishes a packet on a channel of an agent, in that agent's mission time.

        It waits for nothing but room: see `settle`. Of readings on `system` the newest counts where the agent is slow.

        Args:
            channel: `AGENT/CHANNEL`.
            body: the packet's body, an instance of a packet type.
            to: only to this service or task of the agent, `SERVICE/TASK`; empty: to all that subscribe there.
            timeout_s: the time limit; None: that of the client.

        Raises:
            Unreachable: the agent is not there.
            NoAnswer: it is too slow, and takes no packet in time.
            ControlRefused: it has no such channel.
            PancakesError: a value in the body does not fit its type, or cannot travel.
        """
        agent, name = channel_of(channel)
        if not agent:
            raise PancakesError(f"{channel!r} names no channel of an agent: write it as AGENT/CHANNEL")
        type_name(body)
        self._look_for(agent)
        self._publisher.publish(agent, name, body, to, limit(timeout_s))

    def send(self, packet: Packet, *, timeout_s: float | None = None) -> None:
        """Sends a packet as it stands, such as a recorded one, to the agent that its destination names.

        The errors are those of `publish`.
        """
        self._publisher.send(packet, limit(timeout_s))

    def settle(self, *, timeout_s: float | None = None) -> None:
        """Waits until the agents have got all that was published.

        Raises:
            Unreachable: one of them does not answer in time.
        """
        self._publisher.settle(limit(timeout_s))

    def configure(
        self,
        task: str | TaskRow,
        settings: Mapping[str, Any],
        *,
        dry_run: bool = False,
        timeout_s: float | None = None,
    ) -> Reply:
        """Changes some of the settings of a running task; all of them are good, or nothing changes.

        Args:
            task: `AGENT/TASK` or `AGENT/SERVICE/TASK`, or a row of `tasks`.
            settings: the new values, by name.
            dry_run: only asks whether it would be done.
            timeout_s: the time limit; None: that of the client.

        Returns:
            The agent's reply; events on `log` that the change led to bear its `number`.

        Raises:
            ControlRefused: the task refuses, or there is none; the sentence says why.
            Unreachable: there is no such agent.
            NoAnswer: it was asked, and does not answer in time.
        """
        agent, target = task_of(task)
        return self._ordered(agent, Configure(target, settings, dry_run), timeout_s)

    def migrate(
        self,
        task: str | TaskRow,
        to: str = "",
        *,
        then: str = "",
        cost: str | dict[str, float] = "tasks",
        dry_run: bool = False,
        timeout_s: float = MOVE_S,
    ) -> Ledger:
        """Moves a running task to the neighbour that takes it for the lowest cost, and waits until it runs there.

        Args:
            task: `AGENT/TASK` or `AGENT/SERVICE/TASK`, or a row of `tasks`.
            to: the only neighbour to ask; empty: all.
            then: a task to start where the other was, once it has gone.
            cost: the cost function that the neighbours bid with, or the weight of each of several.
            dry_run: only asks for bids, and moves nothing.
            timeout_s: the time limit.

        Returns:
            The account of the move: which neighbours were asked, what each said, and which has the task.

        Raises:
            ControlRefused: no neighbour takes it, or there is no such task; it goes on where it is.
            Unreachable: there is no such agent.
            NoAnswer: no answer came in time; the move may go on all the same.
        """
        agent, target = task_of(task)
        try:
            reply = self._ordered(agent, Migrate(target, to, then, cost, dry_run), timeout_s)
        except NoAnswer as error:
            raise NoAnswer(f"{error}; the move may go on all the same") from None
        return _row(Ledger, reply.result, {"agent": agent})

    # Control packets -------------------------------------------------------------------------------------------

    def request(self, agent: str, body: Any, timeout_s: float | None = None) -> Reply:
        """Asks one agent for something by a control packet, and waits for its answer.

        Args:
            agent: its name.
            body: a control packet's body, such as `Stop("client/ScanTarget")` (`pancakes.control`).
            timeout_s: the time limit; None: that of the client.

        Returns:
            Its reply; where `ok` is False, its `reason` says why not.

        Raises:
            Unreachable: there is no such agent.
            NoAnswer: it was asked, and does not answer in time.
            ControlRefused: agents of two fleets bear this name.
            PancakesError: a value in the body does not fit its type, or cannot travel, so it was not asked.
        """
        limit_s = limit(timeout_s)
        check_body(body)
        self._look_for(agent)
        return self._mesh.request(agent, body, limit_s)

    def survey(self, *agents: str, timeout_s: float | None = None) -> Survey:
        """Returns all that agents say of themselves, plain, and a sentence for each that was silent; see `agents`."""
        self._look()
        return self._mesh.survey(*agents, timeout_s=limit(timeout_s))

    def ask_each(self, body: Any, *agents: str, timeout_s: float | None = None) -> Replies:
        """Asks all agents, or those named, the same, all at once; the errors are those of `agents`.

        Args:
            body: a control packet's body that changes nothing, such as `Channels()`.
            agents: only these.
            timeout_s: the time limit; None: that of the client.
        """
        self._look()
        return self._mesh.ask_each(body, *agents, timeout_s=limit(timeout_s))

    # Which agents are meant ------------------------------------------------------------------------------------

    def is_there(self, agent: str, fleet: str = "") -> bool:
        """Returns whether an agent of this name can be reached: as soon as it is, or once all others have answered.

        Args:
            agent: its name.
            fleet: only where it is of this fleet; empty: of any.
        """
        self._look_for(agent)
        return self._mesh.is_there(agent, fleet)

    def is_connected(self, agent: str, fleet: str = "") -> bool:
        """Returns whether an agent can be asked now, without a wait; the arguments are those of `is_there`."""
        return self._mesh.is_connected(agent, fleet)

    def is_own(self, name: str) -> bool:
        """Returns whether a name that agents tell (`by`, the other end of a link) is that of this client."""
        return self._mesh.is_own(name)

    def waiting(self, agent: str) -> int:
        """Returns how many packets wait here because an agent, or the way to it, is too slow for them."""
        return self._mesh.door(agent).waiting(agent)

    def narrow(self, fleet: str) -> None:
        """Speaks to the agents of one fleet alone from now on."""
        self._mesh.narrow(fleet)

    def now(self) -> float:
        """Returns the host time, in seconds: that of `HeardPacket.at_s`."""
        return self._mesh.now()

    def wait(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Waits until a condition is true, which is looked at every 0.1 s.

        Args:
            condition: returns whether it is true; it may ask this client.
            timeout_s: how long at most; None: the time limit of the client.

        Returns:
            Whether it is true now.
        """
        limit_s = limit(timeout_s)
        until_s = self.now() + (self.timeout_s if limit_s is None else limit_s)
        while not condition():
            now_s = self.now()
            if now_s >= until_s:
                return False
            self._mesh.wait(min(until_s, now_s + LOOK_S), lambda: False)
        return True

    # Within ----------------------------------------------------------------------------------------------------

    def _subscriber(
        self,
        channel: str,
        types: Sequence[str],
        make: Callable[[HeardPacket[Any]], Row],
        callback: Callable[[Row], object] | None,
        agents: Sequence[str],
        foreign: bool,
        most: int,
        timeout_s: float | None,
        followed_anew: Callable[[str], None],
        wants: Callable[[Packet], bool] = lambda packet: True,
    ) -> Subscriber[Row]:
        agent, name = channel_of(channel)
        if agent and agents:
            raise PancakesError(f"{channel!r} names its agent: name others as well with the channel alone, {name!r}")
        if most < 1:
            raise PancakesError(f"at least one packet has to be able to wait: most is a number from 1, not {most}")
        names = (agent,) if agent else (agents,) if isinstance(agents, str) else tuple(agents)
        limit_s = limit(timeout_s)
        self._look()
        following = Following(
            self._mesh, name, types, foreign, names, self._say, followed_anew, most_waiting=most, wants=wants
        )
        told = channel if agent or not names else ", ".join(f"{it}/{name}" for it in names)
        subscriber = Subscriber(self._mesh, following, make, told, limit_s, self._say, self._tender.remove)
        self._tender.add(subscriber)
        if callback is not None:
            subscriber.give_to(callback)
        return subscriber

    def _surveyed(self, agents: Sequence[str], timeout_s: float | None) -> list[dict[str, Any]]:
        found = self.survey(*agents, timeout_s=timeout_s)
        for sentence in found.silent:
            self._say(sentence)
        return found.agents

    def _ordered(self, agent: str, body: Any, timeout_s: float | None) -> Reply:
        reply = self.request(agent, body, timeout_s)
        if not reply.ok:
            raise ControlRefused(reply.reason)
        return reply

    def _look(self) -> None:
        """Finds what was started since the last look."""
        self._mesh.look_again()
        if self.now() - self._looked_s >= LOOK_S:  # which costs each address a connection
            self._mesh.greet_again()
            self._looked_s = self.now()

    def _look_for(self, agent: str) -> None:
        if not self._mesh.is_connected(agent):
            self._look()


def checked(timeout_s: float) -> float:
    """Returns a time limit.

    Raises:
        PancakesError: it is none.
    """
    if not (isinstance(timeout_s, (int, float)) and math.isfinite(timeout_s) and timeout_s > 0):
        raise PancakesError(f"a time limit is a number of seconds above 0, not {timeout_s!r}")
    return timeout_s


def limit(timeout_s: float | None) -> float | None:
    """As `checked`; None stays None."""
    return None if timeout_s is None else checked(timeout_s)


def _row(kind: type[Row], plain: Any, told: Mapping[str, Any]) -> Row:
    try:
        return codecs.convert(plain, kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(
            f"{told['agent']} answers what cannot be read here, so it is of another version: {error}"
        ) from None
