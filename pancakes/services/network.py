"""The Network Service: what goes to other agents and comes from them (paper §3.3).

A `Follower` sends the packets of a channel to an agent that follows it: each at once, or at times the newest of each
source and type, for pages that only show how things are.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Final

from msgspec import Meta, Struct, field
from msgspec.structs import replace

from pancakes.control import Allocate, Follow, ReloadKeys, Stop, Unfollow
from pancakes.durable.answers import NetworkBegan
from pancakes.durable.bidding import TaskMigrator
from pancakes.durable.bidding_messages import ALLOCATOR, AllocationAnswered, AllocationAsked
from pancakes.durable.host_state import HostState
from pancakes.durable.messages import REGISTRAR
from pancakes.durable.store import MigrationReports, Records
from pancakes.errors import ControlRefusedError, PancakesError, PeerLostError, UnknownChannelError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import Tick, every
from pancakes.kernel.kernel import Kernel
from pancakes.mesh.event_loop import BUSY_POLL_S
from pancakes.mesh.link import LinkTimes
from pancakes.mesh.mesh import Mesh
from pancakes.migration import TAKE_PART
from pancakes.packet import Packet, agent_of, join
from pancakes.service import Service
from pancakes.settings import FilePath
from pancakes.supervision.lifecycle import Request
from pancakes.supervision.messages import PeerDown
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot
from pancakes.task import Task, TaskSpec

SOON_S: Final = 0.0075
"""After a pause, a follower with a limited rate gets the first packet this much later, together with the packets that
come meanwhile. Nearly all ticks come at multiples of 5 ms: a packet between two of them puts off none."""
SOON_SHARE: Final = 0.25
"""The same as a share of the time between two sendings, if that is less."""
LEAST_HZ: Final = 0.001
"""No follower may ask for less: until its next sending it is remembered, even if it has gone meanwhile."""
MOST_KEPT: Final = 4096
"""At most this many sources and types are distinguished: a peer that makes them up must not fill the memory."""


class Follower:
    """Sends packets to an agent that follows a channel: each at once, or at times the newest of each source and type.

    The second is for a page that only shows how things stand. One sending takes all that came since the last, in a turn
    of its own: in the publishers' turns, which most often come together, it would put off the ticks behind them.
    Measured with a page open at the demo: by that alone the lateness p99 of 200 ticks a second on each agent rose from
    0.75 to 0.89 ms, and now all that a page asks for raises it by 3 %.

    Args:
        owner: the component in whose turns is sent what did not leave at once.
        mesh: the way to the follower.
        agent: the follower's agent.
        include_remote: whether packets of other agents count.
        most_hz: the limit of packets a second from each source and of each type, `LEAST_HZ` or more; 0: all.
    """

    def __init__(self, owner: ActorCore, mesh: Mesh, agent: str, include_remote: bool, most_hz: float) -> None:
        self._owner = owner
        self._mesh = mesh
        self._agent = agent
        self._include_remote = include_remote
        self._period_s = 1.0 / most_hz if most_hz else 0.0
        self._due_s = -math.inf
        self._newest: dict[tuple[str, str], Packet] = {}
        # Held while it sends again and again, until nothing has come since the last time.
        self._sends = threading.Lock()

    def take(self, packet: Packet) -> None:
        """Take a packet that was published. In any thread."""
        # What came from elsewhere has been seen there; what follows itself would never end.
        if not (self._include_remote or agent_of(packet.source) == self._owner.agent):
            return
        if not self._period_s:
            self._send(packet)
            return
        key = (packet.source, packet.type)
        newest = self._newest
        if len(newest) >= MOST_KEPT and key not in newest:
            return
        newest.pop(key, None)  # so that a source's packets leave in the order in which it published them
        newest[key] = packet
        self._begin()

    def end(self) -> None:
        """Send nothing any more of what waits."""
        self._newest.clear()

    def _begin(self) -> None:
        if self._sends.acquire(False):
            self._send_later()

    def _send_later(self) -> None:
        now_s = self._owner.kernel.host.now()
        # From sending to sending, not from when it came to be done: so it stays between the ticks.
        self._due_s = max(self._due_s + self._period_s, now_s + min(SOON_S, SOON_SHARE * self._period_s))
        self._owner.after_host(self._due_s - now_s, self._send_newest)

    def _send_newest(self) -> None:
        """In the owner's turn."""
        newest = self._newest
        if not newest:
            self._sends.release()
            if newest:  # it came just now, and was left to us
                self._begin()
            return
        for key in list(newest):
            packet = newest.pop(key, None)
            if packet is not None:
                self._send(packet)
        # Here and not with the next packet, whose publisher would have to wake the timer's thread for it.
        self._send_later()

    def _send(self, packet: Packet) -> None:
        try:
            self._mesh.send(replace(packet, destination=self._agent), retry=True)
        except PancakesError:
            # A follower that is slow or gone misses something; the mesh counts it. To log it would never end.
            pass


CLIENT = "NetworkClient"

MOST_FOLLOWED: Final = 256
"""So often the components of one other agent follow channels of this one."""


class NetworkClient(Task):
    """Takes what is bound for other agents and gives it to the mesh (paper §3.3).

    It takes it in the publisher's own thread, so that sending costs no hop; it is the task that decides whether there
    is a way out at all.

    Args:
        mesh: the mesh.
        began: called once there is a way out.
    """

    def __init__(self, *args: Any, mesh: Mesh, began: Callable[[], None] = lambda: None, **others: Any) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh
        self._on_began = began

    def on_start(self) -> None:
        self._actor.kernel.stream.gateway = self.send
        self._on_began()
        self._actor.kernel.tell(REGISTRAR, NetworkBegan())

    def on_stop(self) -> None:
        self._actor.kernel.stream.gateway = None

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self._actor.kernel.stream.gateway = None

    def send(self, packet: Packet) -> None:
        """Send a packet. In the publisher's thread.

        A packet for an agent that is away is dropped and counted, as a packet without a subscriber is on any channel.
        One for an agent that was never linked is also told: its name may be wrong.

        Raises:
            LocalProtocolError: it cannot travel.
            PeerBusy: the peer is too slow, and the channel may not lose packets.
        """
        try:
            self._mesh.send(packet)
        except PeerLostError:
            self._actor.kernel.stream.undelivered += 1
            self._actor.kernel.unheard.elsewhere(packet, self._mesh.connected())


class Discovery(Task):
    """Tells the neighbours which agents there are, at a rate that can be lowered to save power (paper §3.4)."""

    def __init__(self, *args: Any, mesh: Mesh, **others: Any) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh

    @every(hz=1)
    def announce(self, tick: Tick) -> None:
        """Send a beacon to every peer."""
        self._mesh.announce()


class AllocationSettings(Struct):
    """How an agent takes part in the team's allocation.

    Attributes:
        at_most: how many of the tasks that are allocated it takes.
        crowding: what each of these takes off its bid for the next one, in the unit of the tasks' costs.
    """

    at_most: Annotated[int, Meta(ge=0, le=256)] = 3
    crowding: Annotated[float, Meta(ge=0, le=1e9)] = 1.0


class NetworkService(ServiceCore, Service):
    """Enables communication with other agents (paper §3.3)."""

    # There is one mesh, and other agents know the Task Migrator by its address.
    only_name: ClassVar[str] = "network"

    class Settings(Struct):
        """How it talks.

        Attributes:
            discovery_hz: beacons for each second of mission time.
            heartbeat_s: a sign of life is sent if nothing else was for this time, in seconds of host time; a peer that
                is silent for four times as long is gone.
            busy_poll_s: how long the network's thread stays awake for the next packet if one comes after the other
                within that time, in seconds of host time; a dialogue of two tasks is three times as quick. 0, never,
                saves power.
            insecure: whether it speaks over TCP although it has no keys, so that nothing is encrypted and no peer is
                checked. Where it has keys, it uses them.
            keys: the folder with the agent's keys; empty: where `pancakes keys join` puts them.
            allocation: how it takes part in the team's allocation of tasks; None: it does not.
            transports: settings of transports, by the scheme of their addresses: `{ tcp = { dial_s = 2.0 } }`.
        """

        discovery_hz: Annotated[float, Meta(ge=0, le=1000)] = 1.0
        heartbeat_s: Annotated[float, Meta(ge=0.05, le=60)] = LinkTimes().heartbeat_s
        busy_poll_s: Annotated[float, Meta(ge=0, le=0.01)] = BUSY_POLL_S
        insecure: bool = False
        keys: FilePath = ""
        allocation: AllocationSettings | None = None
        transports: dict[str, dict[str, bool | int | float | str | list[str]]] = field(default_factory=dict)

    def __init__(
        self,
        *args: Any,
        mesh: Mesh,
        state: HostState,
        records: Records,
        ledgers: MigrationReports,
        began: Callable[[], None] = lambda: None,
        mdns: bool = False,
        **others: Any,
    ) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh
        self._on_began = began
        self._mdns = mdns
        self._state = state
        self._records = records
        self._ledgers = ledgers
        self._followers: dict[tuple[str, str], Follower] = {}
        self._for_s: float | None = None  # how long it is to sleep, in mission time

    def own_tasks(self) -> Sequence[TaskSpec]:
        mesh = {"mesh": self._mesh}
        knows = {"state": self._state, "records": self._records, "ledgers": self._ledgers}
        specs = [
            TaskSpec(CLIENT, NetworkClient, arguments={**mesh, "began": self._on_began}),
            TaskSpec("Discovery", Discovery, rate_hz=self.settings.discovery_hz, arguments=mesh),
            TaskSpec("TaskMigrator", TaskMigrator, arguments={**mesh, **knows}),
        ]
        if self._mdns and self.kernel.virtual is None:  # in virtual time the network is in memory
            from pancakes.services.mdns import Mdns  # only now: most agents announce nothing

            specs.append(TaskSpec("Mdns", Mdns, arguments=mesh))
        part = self.settings.allocation
        if part is not None:
            from pancakes.durable.allocator import Allocator  # late: most agents take no part

            takes = {"at_most": part.at_most, "crowding": part.crowding}
            shared = {**mesh, "state": self._state, "records": self._records, **takes}
            specs.append(TaskSpec(ALLOCATOR, Allocator, arguments=shared))
        return specs

    def on_start(self) -> None:
        # The mesh outlives the service, so that a port that was taken stays taken while the network sleeps.
        self._mesh.wake()

    def close(self, for_s: float | None = None) -> None:
        self._for_s = for_s
        super().close(for_s)

    def on_stop(self) -> None:
        for channel, by in list(self._followers):
            self._unfollow(channel, by)
        if not self.kernel.stopping:
            for_s = self._for_s
            self._mesh.sleep(for_s / self.kernel.mission.speed if for_s is not None else None)

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        # Its successor knows nothing of them, and an agent that follows again would get everything twice.
        for channel, by in list(self._followers):
            self._unfollow(channel, by)

    @classmethod
    def refuse_stop(cls, kernel: Kernel, name: str, arguments: Mapping[str, Any], for_s: float | None) -> str:
        address = join(kernel.agent, name)
        networked = {device.type for device in kernel.registry.devices() if device.networked}
        for task in kernel.tasks.all():
            needed = networked.intersection(task.requires)
            if needed and kernel.registry.get(task.address) is not None:
                types = ", ".join(sorted(needed))
                return f"{address} must not sleep while {task.address} needs {types} from elsewhere"
        state: HostState = arguments["state"]
        moving = ", ".join(map(str, dict.fromkeys((*state.negotiated, *state.under_way()))))
        if moving:
            return f"the network of {kernel.agent} must not sleep while {moving} is being moved"
        shortest = state.shortest_lease
        if shortest is None or (for_s is not None and for_s / kernel.mission.speed <= shortest.lease_s / 2):
            return ""
        return (
            f"the network of {kernel.agent} must not sleep longer than {shortest.lease_s / 2:g} s of the host's time,"
            f" because this agent guards {shortest.task_id}: give that task a longer lease_s, or no guard"
        )

    def take_message(self, message: Any) -> Any:
        if isinstance(message, AllocationAnswered):
            self.reply(message.request, message.refusal, message.result)
            return None
        if not isinstance(message, PeerDown):
            return super().take_message(message)
        self.kernel.tell(join(self.name, ALLOCATOR), message)
        for channel, by in list(self._followers):
            if agent_of(by) == message.peer:
                self._unfollow(channel, by)
        return None

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if isinstance(body, Follow):
            self._follow(body, request)
        elif isinstance(body, Allocate):
            if not self.kernel.tell(join(self.name, ALLOCATOR), AllocationAsked(self, request, body.dry_run)):
                raise ControlRefusedError(
                    f"{self.agent} takes no part in the allocation: {TAKE_PART} of its configuration",
                    "unsupported",
                )
        elif isinstance(body, Unfollow):
            self._unfollow(body.channel, request.by)
            self.reply(request)
        elif isinstance(body, ReloadKeys):
            try:
                self.reply(request, result=self._mesh.reload_keys(body.dry_run))
            except PancakesError as error:
                raise ControlRefusedError(str(error), error.code) from None
        elif isinstance(body, Stop) and slot is not None and slot.name == CLIENT and agent_of(request.by) != self.agent:
            # Without it no answer leaves.
            raise ControlRefusedError(
                f"{slot.address} cannot be stopped from elsewhere: no packet from elsewhere could start it again"
            )
        else:
            super().carry_out_command(body, slot, request)

    def _follow(self, body: Follow, request: Request) -> None:
        by = request.by
        if agent_of(by) == self.agent:
            raise ControlRefusedError(
                f"{by} is on this agent: it can subscribe to {body.channel!r} itself", "unsupported"
            )
        destination = agent_of(by)
        hello = self._mesh.connected().get(destination)
        if hello is None:
            # It has asked and gone, and no agent would ever end what it began.
            raise ControlRefusedError(f"{destination} is not connected, so it cannot follow {body.channel!r}", "unable")
        if body.include_remote and hello.role != "client":
            # Two agents that follow each other would send one packet to and fro for ever.
            raise ControlRefusedError(
                f"{destination} is no client, so it cannot follow what others send to {self.agent}", "unsupported"
            )
        if body.most_hz != 0 and not LEAST_HZ <= body.most_hz < math.inf:
            raise ControlRefusedError(
                f"most_hz must be 0 (all), or {LEAST_HZ:g} or more a second, not {body.most_hz}", "invalid"
            )
        self._unfollow(body.channel, by)
        if sum(agent_of(it) == destination for _, it in self._followers) >= MOST_FOLLOWED:
            raise ControlRefusedError(
                f"{destination} follows {MOST_FOLLOWED} times already, under as many addresses", "busy"
            )
        follower = Follower(self, self._mesh, destination, body.include_remote, body.most_hz)
        try:
            self.kernel.stream.tap(body.channel, follower.take, body.types, by=by)
        except UnknownChannelError as error:
            raise ControlRefusedError(str(error), error.code) from None
        self._followers[body.channel, by] = follower
        self.reply(request)

    def _unfollow(self, channel: str, by: str) -> None:
        follower = self._followers.pop((channel, by), None)
        if follower is not None:
            self.kernel.stream.untap(channel, follower.take)
            follower.end()
