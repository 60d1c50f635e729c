"""The Task Migrator: asks the neighbours for bids, and answers theirs (paper §3.4).

It decides where a task goes, never whether it may run there: that is decided by the migration. Cost functions of
plug-ins may wait or fail, so the `Appraiser` calls them in a thread of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.bidding_messages import (
    MIGRATOR,
    AttemptOver,
    BidAwarded,
    HasMoved,
    MigratorBegan,
    MoveOver,
    MoverBegan,
    Negotiate,
)
from pancakes.durable.host_state import IDLE, HostState, Imported, LoadMeter
from pancakes.durable.messages import REGISTRAR, Bid, Known, Refuse, Solicit, is_for
from pancakes.durable.negotiation import Awarded, Exhausted, Negotiation, Outcome
from pancakes.durable.origins import Origins
from pancakes.durable.peer_talk import PeerTalk
from pancakes.durable.record import TaskId
from pancakes.durable.register import Identity
from pancakes.durable.snapshot import offer_of
from pancakes.durable.store import MigrationReports, Records
from pancakes.durable.times import Times
from pancakes.errors import MigrationError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import on, reliable
from pancakes.kernel.mailbox import Reference, tell
from pancakes.mesh.mesh import Mesh
from pancakes.migration import Cost, CostChoice, CostFacts, MigrationReport, appraise, cost_text, is_of_core
from pancakes.packet import NETWORK, SYSTEM, Packet, agent_of, join
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task

APPRAISER: Final = "kernel/Appraiser"


class Appraise(msgspec.Struct, frozen=True):
    """Asks the appraiser for a cost.

    Attributes:
        asker: the actor that gets the answer, `Appraised`.
        number: the number of the question.
        choice: the cost function, or the weight of each of several.
        facts: what they may know.
    """

    asker: Reference
    number: int
    choice: CostChoice
    facts: CostFacts


class Appraised(msgspec.Struct, frozen=True):
    """What a task would cost here.

    Attributes:
        number: the number of the question.
        terms: what the cost is made of.
        refusal: why it cannot be told, as a phrase; empty: it can.
    """

    number: int
    terms: Mapping[str, float]
    refusal: str


class Appraiser(ActorCore):
    """Calls cost functions in a thread of its own: one that waits holds up no other actor.

    Args:
        costs: returns the cost functions that are installed, by name.
    """

    blocking = True

    def __init__(self, *args: Any, costs: Callable[[], Mapping[str, Cost]], **others: Any) -> None:
        super().__init__(*args, **others)
        self._costs = costs

    def take_message(self, message: Any) -> Any:
        if not isinstance(message, Appraise):
            return super().take_message(message)
        terms, refusal = appraise(message.choice, message.facts, self._costs())
        tell(message.asker, Appraised(message.number, terms, refusal))
        return None


KEEP = reliable(1024)
APPRAISED_S = 0.4
"""How long the cost functions of plug-ins have, in host time; the window for bids is a little longer."""
MOST_APPRAISED = 64
"""At most this many tasks wait for their costs, ..."""
MOST_OF_PEER = 16
"""... and this many of one peer."""
SOUGHT_S = 3.0
"""How long it may take to link to the agent that a task is sent to, in host time."""
LINK_LOOK_S = 0.05
FIRST_LOOK_S = 0.5
LOOK_S = 2.0
"""How often, in host time, the load of this agent is measured. A bid tells the last measurement, and waits for none."""


class TaskMigrator(TaskCore, Task):
    """Asks all neighbours for bids, and answers theirs.

    Which task may run where is not decided here but by the migration of the service that owns it.

    Args:
        mesh: says what neighbours there are.
        state: says whether this agent can take a task, and how busy it is.
        records: what is known of tasks here.
        ledgers: keeps the accounts of moves.
    """

    def __init__(
        self, *args: Any, mesh: Mesh, state: HostState, records: Records, ledgers: MigrationReports, **others: Any
    ) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh
        self._talk = PeerTalk(self, mesh)
        self._state = state
        self._ledgers = ledgers
        self._times = Times()
        self._negotiations: dict[TaskId, tuple[Negotiation, Reference]] = {}
        self._meter = LoadMeter()
        self._appraising: dict[int, tuple[str, Solicit]] = {}  # the agents that are to have the answers, by number
        self._questions = 0
        self._holding: dict[TaskId, tuple[str, MigrationReport]] = {}  # who is to keep room for the task
        self._origins = Origins(self, records, self._talk.neighbours)

    def on_start(self) -> None:
        if self.kernel.virtual is None:
            self._meter.look(self.kernel.host.now(), self.kernel.task_timers.all())
            self.after_host(FIRST_LOOK_S, self._measure)
        else:
            # In virtual time nothing of the wall may enter.
            self._state.measured = IDLE
        device_types = {"battery", "reserve", *(it for cost in self._state.costs().values() for it in cost.reads)}
        self.kernel.stream.tap(SYSTEM, self._state.readings.take, tuple(sorted(device_types)))
        for service in self._state.services():
            tell(service, MigratorBegan())

    def on_stop(self) -> None:
        self.kernel.stream.untap(SYSTEM, self._state.readings.take)
        self._state.readings.newest.clear()
        self._state.measured = None
        self._state.negotiated = ()
        appraiser = self.kernel.actor(APPRAISER)
        if appraiser is not None:
            appraiser.stop()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.on_stop()

    # What the services tell that own the tasks -----------------------------------------------------------------

    def take_message(self, message: Any) -> Any:
        match message:
            case Negotiate():
                self._negotiate(message)
            case AttemptOver():
                self._attempt_over(message)
            case HasMoved():
                self._moved(message)
            case MoverBegan():
                self._service_began(message.service)
            case Appraised():
                self._appraised(message)
            case Imported():
                self.on_solicit(message.waiting)
            case _:
                return super().take_message(message)
        return None

    def _negotiate(self, asked: Negotiate, until_s: float = math.inf) -> None:
        now_s = self.kernel.host.now()
        if asked.to and now_s < until_s and asked.to not in self._mesh.neighbours() and self._mesh.seek(asked.to):
            until_s = min(until_s, now_s + SOUGHT_S)
            self.after_host(LINK_LOOK_S, partial(self._negotiate, asked, until_s))
            return
        request = asked.request
        negotiation = Negotiation(
            request,
            asked.lost or self.agent,
            asked.asked_by,
            [*self._mesh.neighbours(), *([self.agent] if asked.lost else [])],
            now_s,
            asked.to,
            asked.dry_run,
            self._times.bid_window_s,
            self._times.patience_s,
            asked.cause,
        )
        self._negotiations[request.task_id] = (negotiation, asked.service)
        self._note()
        outcome = negotiation.begin(now_s)
        for peer in negotiation.asked:
            self._talk.say(peer, MIGRATOR, request)
        if outcome is None:
            window_s = self._times.bid_window_s
            self.after_host(window_s, partial(self._window_closes, negotiation, now_s + window_s))
        self._conclude(request.task_id, outcome)

    def _note(self) -> None:
        """Keeps true what others know of the negotiations."""
        self._state.negotiated = tuple(self._negotiations)

    def _attempt_over(self, over: AttemptOver) -> None:
        task_id, reason = over.task_id, over.refusal.text
        found = self._negotiations.get(task_id)
        if found is not None and over.peer:
            self.event("handoff_failed", task=task_id.name, to=over.peer, reason=reason)
            self._conclude(task_id, found[0].failed(over.peer, over.refusal, self.kernel.host.now()))
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
        told = found[1] is moved.service if found is not None else moved.ledger is not None
        if not told:
            tell(moved.service, MoveOver(moved.task_id, "", None))

    def _account(self, service: Reference, task_id: TaskId, ledger: MigrationReport, note: str, why_not: str) -> None:
        """Keeps the account of a move that is over, publishes it, and tells the service.

        Args:
            service: the service that owns, or owned, the task.
            task_id: the task.
            ledger: the account.
            note: why it came to nothing, or what had come between; kept with the account.
            why_not: what to tell the asker; empty: it has moved.
        """
        self._negotiations.pop(task_id, None)  # of a service that was started again since
        self._note()
        self._ledgers.add(ledger, note, self.now())
        self._tell(service, task_id, ledger, why_not)

    def _tell(self, service: Reference, task_id: TaskId, ledger: MigrationReport, why_not: str) -> None:
        plain = msgspec.to_builtins(ledger)
        self.event("migration", task=task_id.name, **plain)
        tell(service, MoveOver(task_id, why_not, plain))

    def _service_began(self, service: Reference) -> None:
        for task_id, (_, owner) in list(self._negotiations.items()):
            if owner is not service and owner.name == service.name:
                self._finish(task_id, f"{owner.address} was started again")

    # Negotiating -----------------------------------------------------------------------------------------------

    def _window_closes(self, negotiation: Negotiation, due_s: float) -> None:
        task_id = negotiation.request.task_id
        found = self._negotiations.get(task_id)
        if found is not None and found[0] is negotiation:
            # A timer may fire a hair early; the window is closed all the same.
            self._conclude(task_id, negotiation.tick(max(self.kernel.host.now(), due_s)))
            if negotiation.open:
                latest_s = negotiation.latest_s
                self.after_host(latest_s - due_s, partial(self._window_closes, negotiation, latest_s))

    def _conclude(self, task_id: TaskId, outcome: Outcome | None) -> None:
        found = self._negotiations.get(task_id)
        if outcome is None or found is None:
            return
        negotiation, service = found
        if isinstance(outcome, Awarded):
            self._award(task_id, outcome.peer, negotiation, service)
        elif isinstance(outcome, Exhausted):
            self._finish(task_id, str(outcome.error) if outcome.error is not None else "")

    def _award(self, task_id: TaskId, peer: str, negotiation: Negotiation, service: Reference) -> None:
        """One neighbour made the lowest bid: the owner of the task has it keep room, a member has it called."""
        ledger = negotiation.ledger(self.kernel.host.now())
        if service.address == join(self.agent, REGISTRAR):
            tell(service, BidAwarded(task_id, Identity(peer), ledger))
            return
        self._holding[task_id] = (peer, ledger)
        self._talk.say(peer, MIGRATOR, replace(negotiation.request, hold=True))
        self.after_host(self._times.reserve_s, partial(self._not_held, task_id, self._holding[task_id]))

    def _not_held(self, task_id: TaskId, held: tuple[str, MigrationReport]) -> None:
        if self._holding.get(task_id) is held:
            self._hold_failed(task_id, Refusal("unable", "did not answer the reservation in time"))

    def _hold_failed(self, task_id: TaskId, refusal: Refusal) -> None:
        peer, _ = self._holding.pop(task_id)
        found = self._negotiations.get(task_id)
        if found is not None:
            self._attempt_over(AttemptOver(found[1], task_id, peer, refusal, None))

    def _finish(self, task_id: TaskId, reason: str, offer: str = "") -> None:
        negotiation, service = self._negotiations.pop(task_id)
        self._note()
        ledger = replace(negotiation.ledger(self.kernel.host.now()), offer=offer)
        if negotiation.dry_run:
            self._tell(service, task_id, ledger, reason)
        else:
            self._account(service, task_id, ledger, reason, reason)

    @on(NETWORK, Bid, queue=KEEP, addressed=True)
    def on_bid(self, packet: Packet) -> None:
        """A neighbour would take the task, or keeps room for it."""
        body, peer = packet.body, agent_of(packet.source)
        if body.holds:
            holding, found = self._holding.get(body.task_id), self._negotiations.get(body.task_id)
            asked = holding is not None and holding[0] == peer == body.by.agent
            if asked and found is not None and holding is not None and is_for(body, self._talk.me.journal):
                del self._holding[body.task_id]
                tell(found[1], BidAwarded(body.task_id, body.by, holding[1]))
            return
        if (negotiation := self._asking(packet)) is not None:
            now_s = self.kernel.host.now()
            self._conclude(body.task_id, negotiation.bid(peer, body.cost, body.terms, now_s))

    @on(NETWORK, Refuse, queue=KEEP, addressed=True)
    def on_refuse(self, packet: Packet) -> None:
        """A neighbour cannot take the task."""
        body, peer = packet.body, agent_of(packet.source)
        holding = self._holding.get(body.task_id)
        if holding is not None and holding[0] == peer:
            self._hold_failed(body.task_id, body.refusal)
        elif (negotiation := self._asking(packet)) is not None:
            self._conclude(body.task_id, negotiation.refuse(peer, body.refusal, self.kernel.host.now()))

    def _asking(self, packet: Packet) -> Negotiation | None:
        """Return the negotiation that an answer is for; None: it is over, or the answer is for another disk."""
        found = self._negotiations.get(packet.body.task_id)
        if found is None or not is_for(packet.body, self._talk.me.journal):
            return None
        return found[0] if found[0].request.ask == packet.body.ask else None

    # Being asked -----------------------------------------------------------------------------------------------

    @on(NETWORK, Solicit, queue=KEEP, addressed=True)
    def on_solicit(self, packet: Packet) -> None:
        """Answers whether this agent would take a task, and at what cost."""
        if not is_for(packet.body, self._talk.me.journal):
            return
        request: Solicit = packet.body
        peer = agent_of(packet.source)
        if self._state.imports_first(self, peer, request.type, packet):
            return
        if request.hold:
            self._origins.judge(packet, self._hold)
            return
        refusal = self._state.refusal_of(peer, request)
        if refusal is None:
            self._appraise(peer, request)
        else:
            self._refuse(peer, request, refusal)

    def _hold(self, packet: Packet, refusal: Refusal | None) -> None:
        """Keeps room for a task of which it is known where it comes from."""
        peer, request = agent_of(packet.source), packet.body
        refusal = refusal or self._state.reserve(peer, request)
        if refusal is not None:
            self._refuse(peer, request, refusal)
        else:
            self._talk.say(peer, MIGRATOR, Bid(request.task_id, request.ask, 0.0, {}, True, self._talk.me))

    @on(NETWORK, Known, queue=KEEP, addressed=True)
    def on_known(self, packet: Packet) -> None:
        """An agent that was asked says which one has a task."""
        self._origins.told(packet)

    def _appraise(self, peer: str, request: Solicit) -> None:
        """Has the cost of a task worked out: those of the core at once, others in a thread of their own."""
        load = self._state.load(self._mesh.rtt_s(peer))
        if is_of_core(request.cost):
            self._answer(peer, request, *appraise(request.cost, CostFacts(load), self._state.costs()))
            return
        if len(self._appraising) >= MOST_APPRAISED:
            self._is_busy(peer, request, f"works out the costs of {MOST_APPRAISED} tasks already")
            return
        if sum(asker == peer for asker, _ in self._appraising.values()) >= MOST_OF_PEER:
            self._is_busy(peer, request, f"works out the costs of {MOST_OF_PEER} tasks of {peer} already")
            return
        try:
            settings, state = offer_of(request.offer)
        except MigrationError as error:
            self._answer(peer, request, {}, f"cannot tell its cost: {error}")
            return
        self._questions += 1
        number = self._questions
        self._appraising[number] = (peer, request)
        facts = CostFacts(load, self._state.known_readings(), settings, state)
        tell(self._appraiser(), Appraise(self, number, request.cost, facts))
        self.after_host(APPRAISED_S, lambda: self._not_appraised(number))

    def _appraiser(self) -> Reference:
        found = self.kernel.actor(APPRAISER)
        return found or self.kernel.spawn(Appraiser, join(self.agent, APPRAISER), costs=self._state.costs)

    def _appraised(self, found: Appraised) -> None:
        peer, request = self._appraising.pop(found.number, ("", None))
        if request is not None:
            self._answer(peer, request, found.terms, found.refusal)

    def _not_appraised(self, number: int) -> None:
        peer, request = self._appraising.pop(number, ("", None))
        if request is not None:
            refusal = f"its cost function {cost_text(request.cost)!r} did not answer within {APPRAISED_S:g} s"
            self._answer(peer, request, {}, refusal)

    def _answer(self, peer: str, request: Solicit, terms: Mapping[str, float], refusal: str) -> None:
        if refusal:
            self._refuse(peer, request, Refusal("unable", refusal))
        else:
            cost = sum(terms.values())
            self._talk.say(peer, MIGRATOR, Bid(request.task_id, request.ask, cost, dict(terms)))
            self.event("migration_bid", task=request.task_id.name, source_agent=peer, cost=cost, terms=dict(terms))

    def _is_busy(self, peer: str, request: Solicit, text: str) -> None:
        self._refuse(peer, request, Refusal("busy", text, APPRAISED_S))

    def _refuse(self, peer: str, request: Solicit, refusal: Refusal) -> None:
        self._talk.say(peer, MIGRATOR, Refuse(request.task_id, request.ask, refusal))
        self.event("migration_refused", task=request.task_id.name, source_agent=peer, reason=refusal.text)

    def _measure(self) -> None:
        self._state.measured = self._meter.look(self.kernel.host.now(), self.kernel.task_timers.all())
        self.after_host(LOOK_S, self._measure)
