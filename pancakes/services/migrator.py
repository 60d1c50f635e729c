"""The Task Migrator: finds the neighbour that takes a task, and carries what the two agents say (paper §3.4)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from pancakes.errors import MigrationError, PancakesError, RemoteProtocolError
from pancakes.kernel.component import Component
from pancakes.kernel.handlers import on
from pancakes.kernel.keep import reliable
from pancakes.kernel.tell import tell
from pancakes.migration.capability import Capability
from pancakes.migration.cost import Cost, HostLoad, cost_of, cost_text
from pancakes.migration.ledger import Ledger
from pancakes.migration.messages import (
    Abort,
    Activated,
    Bid,
    Commit,
    HandOffMessage,
    Message,
    Moved,
    Nak,
    Piece,
    Prepared,
    Refuse,
    Reserve,
    Reserved,
    Solicit,
    Transfer,
    Unknown,
    addressed,
    is_for,
)
from pancakes.migration.negotiation import Awarded, Exhausted, Negotiation, Outcome
from pancakes.migration.pieces import Assembly, cut
from pancakes.migration.record import TaskId
from pancakes.migration.slots import Slot, Slots
from pancakes.migration.snapshot import Snapshot
from pancakes.migration.times import Times
from pancakes.net.mesh import Mesh
from pancakes.packet import NETWORK, SYSTEM, Packet, agent_of, join
from pancakes.services.bidding_messages import (
    Accounted,
    AttemptOver,
    BidAwarded,
    BrokenOff,
    Came,
    HasMoved,
    MigratorBegan,
    MoveOver,
    Negotiate,
    SendTo,
    ServiceBegan,
)
from pancakes.services.ledgers import Ledgers
from pancakes.services.load import IDLE, Load, LoadMeter
from pancakes.task import Task

if TYPE_CHECKING:
    from pancakes.hosting.client import ClientService

ADDRESS = "network/TaskMigrator"
KEEP = reliable(1024)
FIRST_LOOK_S = 0.5
LOOK_S = 2.0
"""How often, in host time, the load of this agent is measured. A bid tells the last measurement, and waits for none."""


class Hosting:
    """What this agent could be to a task from elsewhere: which types, cost functions and records it has.

    Args:
        role: the agent's role.
        version: returns the version in which a task type is installed and can be imported; None where it is not.
        costs: returns the cost functions, by name.
        recorded: returns the name of the service whose record of a task is on disk, running or not; empty: none.
    """

    def __init__(
        self,
        role: str,
        version: Callable[[str], str | None],
        costs: Callable[[], Mapping[str, Cost]],
        recorded: Callable[[TaskId], str],
    ) -> None:
        self.role = role
        self.version = version
        self.costs = costs
        self.recorded = recorded


class PeerDown(msgspec.Struct, frozen=True):
    """The Network Service tells the migrator that a peer has gone.

    Attributes:
        peer: the peer.
    """

    peer: str


class TaskMigrator(Task):
    """Asks all neighbours for bids, answers theirs, and carries the messages of hand-offs.

    Which task may run where is not decided here but by the hand-off of the service that owns it.

    Attributes:
        battery_level: what is left of this agent's battery, from 0 to 1, as it last said; None before that.
        measured: how busy the agent was lately; None before the first look.
    """

    def __init__(self, *args: Any, mesh: Mesh, hosting: Hosting, ledgers: Ledgers, **others: Any) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh
        self._hosting = hosting
        self._ledgers = ledgers
        self._times = Times()
        self._negotiations: dict[TaskId, tuple[Negotiation, Component]] = {}
        self._assembly = Assembly()
        self._slots = Slots()
        self.battery_level: float | None = None
        self._meter = LoadMeter()
        # In virtual time nothing of the wall may enter.
        self.measured: Load | None = IDLE if self.kernel.virtual is not None else None

    def on_start(self) -> None:
        if self.kernel.virtual is None:
            self._meter.look(self.kernel.host.now(), self.kernel.registry.components())
            self.after_host(FIRST_LOOK_S, self._measure)
        for service in self._durable_services():
            tell(service, MigratorBegan())

    # What the services tell that own the tasks -----------------------------------------------------------------

    def on_receive(self, message: Any) -> Any:
        match message:
            case Negotiate():
                self._negotiate(message)
            case AttemptOver():
                self._attempt_over(message)
            case HasMoved():
                self._moved(message)
            case BrokenOff():
                self._account(message.service, message.task_id, message.ledger, message.reason, message.reason)
            case ServiceBegan():
                self._service_began(message.service)
            case SendTo():
                self._send(message.peer, message.message)
            case PeerDown():
                self._assembly.drop(message.peer)  # a snapshot that was on its way would come anew
            case _:
                return super().on_receive(message)
        return None

    def _negotiate(self, asked: Negotiate) -> None:
        now_s = self.kernel.host.now()
        request = asked.request
        negotiation = Negotiation(
            request,
            self.agent,
            asked.asked_by,
            self._mesh.neighbours(),
            now_s,
            asked.to,
            asked.dry_run,
            self._times.bid_window_s,
        )
        self._negotiations[request.task_id] = (negotiation, asked.service)
        outcome = negotiation.begin(now_s)
        for peer in negotiation.asked:
            self._say(peer, request)
        if outcome is None:
            self.after_host(self._times.bid_window_s, lambda: self._window_closes(negotiation))
        self._conclude(request.task_id, outcome)

    def _attempt_over(self, over: AttemptOver) -> None:
        task_id, reason = over.task_id, over.reason
        found = self._negotiations.get(task_id)
        if found is not None and over.peer:
            self.event("handoff_failed", task=task_id.name, to=over.peer, reason=reason)
            self._conclude(task_id, found[0].failed(over.peer, reason, self.kernel.host.now()))
        elif found is not None:
            self._finish(task_id, reason)
        elif over.ledger is not None:
            ledger = over.ledger.stayed("", reason) if over.peer else over.ledger
            self._account(over.service, task_id, ledger, reason, reason)

    def _moved(self, moved: HasMoved) -> None:
        found = self._negotiations.get(moved.task_id)
        if found is not None:
            found[0].moved(moved.peer, self.kernel.host.now())
            self._finish(moved.task_id, "", moved.epoch)
        elif moved.ledger is not None:
            self._account(moved.service, moved.task_id, moved.ledger.moved(moved.epoch), moved.note, "")
        tell(moved.service, Accounted(moved.task_id))

    def _account(self, service: Component, task_id: TaskId, ledger: Ledger, note: str, why_not: str) -> None:
        """Keeps the account of a move that is over, publishes it, and tells the service.

        Args:
            service: the service that owns, or owned, the task.
            task_id: the task.
            ledger: the account.
            note: why it came to nothing, or what had come between; kept with the account.
            why_not: what to tell the asker; empty: it has moved.
        """
        self._negotiations.pop(task_id, None)  # of a service that has been started anew since
        self._ledgers.add(ledger, note, self.now())
        self._tell(service, task_id, ledger, why_not)

    def _tell(self, service: Component, task_id: TaskId, ledger: Ledger, why_not: str) -> None:
        plain = msgspec.to_builtins(ledger)
        self.event("migration", task=task_id.name, **plain)
        tell(service, MoveOver(task_id, why_not, plain))

    def _service_began(self, service: Component) -> None:
        for task_id, (_, owner) in list(self._negotiations.items()):
            if owner is not service and owner.name == service.name:
                self._finish(task_id, f"{owner.address} was started anew")

    def _send(self, peer: str, message: HandOffMessage) -> None:
        if isinstance(message, Transfer):
            for piece in cut(message):
                self._say(peer, piece)
        else:
            self._say(peer, message)

    def connected(self, peer: str) -> bool:
        """Returns whether there is a link to an agent now. Any thread."""
        return any(hello.name == peer for hello in self._mesh.connected())

    def refuse_stop(self) -> str:
        """Says why the network must not sleep now; empty: it may. Any thread."""
        if self._negotiations:
            names = ", ".join(str(task_id) for task_id in list(self._negotiations))
            return f"the network of {self.agent} must not sleep while {names} is being moved"
        for service in self._durable_services():
            reason = service.refuse_stop()
            if reason:
                return reason
        return ""

    # Negotiating -----------------------------------------------------------------------------------------------

    def _window_closes(self, negotiation: Negotiation) -> None:
        task_id = negotiation.request.task_id
        found = self._negotiations.get(task_id)
        if found is not None and found[0] is negotiation:
            # A timer may fire a hair early; the window is closed all the same.
            self._conclude(task_id, negotiation.tick(max(self.kernel.host.now(), negotiation.deadline_s)))

    def _conclude(self, task_id: TaskId, outcome: Outcome | None) -> None:
        found = self._negotiations.get(task_id)
        if outcome is None or found is None:
            return
        negotiation, service = found
        if isinstance(outcome, Awarded):
            ledger = negotiation.ledger(self.kernel.host.now())
            tell(service, BidAwarded(task_id, outcome.peer, negotiation.request, ledger))
        elif isinstance(outcome, Exhausted):
            self._finish(task_id, str(outcome.error) if outcome.error is not None else "")

    def _finish(self, task_id: TaskId, reason: str, offer: str = "") -> None:
        negotiation, service = self._negotiations.pop(task_id)
        ledger = replace(negotiation.ledger(self.kernel.host.now()), offer=offer)
        if negotiation.dry_run:
            self._tell(service, task_id, ledger, reason)
        else:
            self._account(service, task_id, ledger, reason, reason)

    @on(NETWORK, Bid, keep=KEEP)
    def on_bid(self, packet: Packet) -> None:
        """A neighbour would take the task."""
        self._answered(
            packet, lambda negotiation, bid, now_s: negotiation.bid(agent_of(packet.source), bid.cost, bid.terms, now_s)
        )

    @on(NETWORK, Refuse, keep=KEEP)
    def on_refuse(self, packet: Packet) -> None:
        """A neighbour cannot take the task."""
        self._answered(
            packet, lambda negotiation, refuse, now_s: negotiation.refuse(agent_of(packet.source), refuse.reason, now_s)
        )

    def _answered(self, packet: Packet, take: Callable[[Negotiation, Any, float], Outcome | None]) -> None:
        if not self._believes(packet):
            return
        found = self._negotiations.get(packet.body.task_id)
        if found is not None and found[0].request.ask == packet.body.ask:
            self._conclude(packet.body.task_id, take(found[0], packet.body, self.kernel.host.now()))

    # Being asked -----------------------------------------------------------------------------------------------

    @on(SYSTEM, "battery", keep="latest")
    def on_battery(self, packet: Packet) -> None:
        """Remembers what is left of this agent's battery."""
        if agent_of(packet.source) == self.agent:
            self.battery_level = packet.body.level

    @on(NETWORK, Solicit, keep=KEEP)
    def on_solicit(self, packet: Packet) -> None:
        """Answers whether this agent would take a task, and at what cost."""
        if not self._believes(packet):
            return
        request: Solicit = packet.body
        peer = agent_of(packet.source)
        refusal = self._refusal(request)
        if not refusal:
            try:
                terms = dict(cost_of(request.cost, self._hosting.costs()).terms(self._load(peer)))
            except MigrationError as error:
                refusal = f"cannot tell its cost: {error}"
            except Exception as error:  # a cost function is a plug-in, and may raise anything
                name = cost_text(request.cost)
                refusal = f"its cost function {name!r} failed: {type(error).__name__}: {error}"
        if refusal:
            self._say(peer, Refuse(request.task_id, request.ask, refusal))
            self.event("migration_refused", task=request.task_id.name, source_agent=peer, reason=refusal)
        else:
            cost = sum(terms.values())
            self._say(peer, Bid(request.task_id, request.ask, cost, terms))
            self.event("migration_bid", task=request.task_id.name, source_agent=peer, cost=cost, terms=terms)

    def _refusal(self, request: Solicit) -> str:
        registry = self.kernel.registry
        names: dict[str, TaskId] = {}
        services = self._durable_services()
        for service in services:
            for slot in list(service.slots.values()):
                names[slot.name] = service.places.id_of(slot)
        for task_id in self._slots.kept(self.kernel.host.now()):
            names.setdefault(task_id.name, task_id)
        version = self._hosting.version(request.type)
        keeper = self._keeper(request.task_id)
        recorded = keeper.name if keeper is not None else self._hosting.recorded(request.task_id)
        capability = Capability(
            role=self._hosting.role,
            devices=tuple(registry.device_types()),
            types={request.type: version} if version is not None else {},
            services=tuple(service.name for service in services),
            records={request.task_id: recorded} if recorded else {},
            names=names,
            costs=tuple(self._hosting.costs()),
            battery_level=self.battery_level,
        )
        refusal = capability.refusal_of(request)
        if refusal:
            return refusal
        place = join(self.agent, request.service, request.task_id.name)
        for device in registry.devices():
            if not device.actuator or device.type not in request.requires:
                continue
            holder = registry.holder(device.name)
            if holder:
                return f"{device.name} is held by {holder}"
            taken = registry.taken(device.name, place)
            if taken:
                return taken
        return ""

    def _measure(self) -> None:
        self.measured = self._meter.look(self.kernel.host.now(), self.kernel.registry.components())
        self.after_host(LOOK_S, self._measure)

    def _load(self, asker: str) -> HostLoad:
        running = sum(
            1 for service in self._durable_services() for slot in list(service.slots.values()) if slot.task is not None
        )
        battery_level = self.battery_level
        if battery_level is None and "battery" in self.kernel.registry.device_types():
            battery_level = math.nan
        measured = self.measured
        return HostLoad(
            active_tasks=running + len(self._slots.kept(self.kernel.host.now())),
            battery_level=battery_level,
            agent_share=measured.agent_share if measured is not None else None,
            host_share=measured.host_share if measured is not None else None,
            lateness_share=measured.lateness_share if measured is not None else None,
            rtt_s=self._mesh.rtt_s(asker),
        )

    # Handing over ----------------------------------------------------------------------------------------------

    @on(NETWORK, Reserve, keep=KEEP)
    @on(NETWORK, Reserved, keep=KEEP)
    @on(NETWORK, Nak, keep=KEEP)
    @on(NETWORK, Prepared, keep=KEEP)
    @on(NETWORK, Commit, keep=KEEP)
    @on(NETWORK, Activated, keep=KEEP)
    @on(NETWORK, Abort, keep=KEEP)
    @on(NETWORK, Unknown, keep=KEEP)
    @on(NETWORK, Moved, keep=KEEP)
    def on_message(self, packet: Packet) -> None:
        """Gives a hand-off message to the service that owns the task."""
        if not self._believes(packet):
            return
        message = packet.body
        peer = agent_of(packet.source)
        refusal = name = ""
        if isinstance(message, Reserve):
            name = message.request.service
            self._slots.free(message.task_id)
            refusal = self._refusal(message.request)
            if not refusal:
                until_s = self.kernel.host.now() + self._times.slot_s
                self._slots.keep(message.task_id, Slot(peer, message.offer, until_s))
        elif isinstance(message, (Commit, Abort)):
            self._assembly.end(peer, message.task_id)
        self._hand_over(peer, message, refusal, name)

    @on(NETWORK, Piece, keep=KEEP)
    def on_piece(self, packet: Packet) -> None:
        """Takes a piece of a snapshot in; gives the whole to the service that it names."""
        if not self._believes(packet):
            return
        piece: Piece = packet.body
        peer = agent_of(packet.source)
        try:
            transfer = self._assembly.add(peer, piece)
            if transfer is None:
                return
            service = Snapshot.decode(transfer.snapshot).service
        except (RemoteProtocolError, PancakesError) as error:
            self._say(peer, Nak(piece.task_id, piece.offer, str(error)))
            return
        self._slots.free(piece.task_id)
        self._hand_over(peer, transfer, "", service)

    def _hand_over(self, peer: str, message: HandOffMessage, refusal: str, name: str) -> None:
        """Gives a message to the service that has a record of its task, else to the one of the name that it says.

        Of a message that names none any service can say that no record is left; but not while there is one, and the
        service that has it does not run: its peer says it again.
        """
        owner = self._keeper(message.task_id)
        if owner is None and (name or not self._hosting.recorded(message.task_id)):
            services = self._durable_services()
            owner = next((service for service in services if not name or service.name == name), None)
        if owner is None:
            if isinstance(message, (Reserve, Transfer)):
                reason = refusal or f"runs no service {name!r} that takes tasks in"
                self._say(peer, Nak(message.task_id, message.offer, reason))
            return
        tell(owner, Came(peer, message, refusal))

    def _keeper(self, task_id: TaskId) -> ClientService | None:
        """Returns the service that runs and has a record of a task."""
        return next((service for service in self._durable_services() if service.knows(task_id)), None)

    def _durable_services(self) -> list[ClientService]:
        return [
            component  # type: ignore[misc]
            for component in self.kernel.registry.components()
            if getattr(component, "durable", False)
        ]

    # Talking ---------------------------------------------------------------------------------------------------

    def _say(self, peer: str, message: Message) -> None:
        journal = next((hello.journal for hello in self._mesh.connected() if hello.name == peer), "")
        if not journal:
            return
        try:
            self.publish(NETWORK, addressed(message, journal), to=join(peer, ADDRESS))
        except PancakesError as error:
            self.log("debug", f"{type(message).__name__} did not reach {peer}: {error}")

    def _believes(self, packet: Packet) -> bool:
        """Returns whether a message was meant for this agent with this disk, and not for a former one."""
        return is_for(packet.body, self._mesh.identity.journal)
