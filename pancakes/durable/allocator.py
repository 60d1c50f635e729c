"""The rounds of the team's allocation on one agent: when they begin, what is told in them, and what follows.

`auction.Round` decides. This task puts up the tasks of its agent, has their costs worked out as for a bid, and says the
rows. Once a round is over it migrates its own tasks, by the same request as a person: which copy may run where is
decided by the migration. It runs only on agents that take part in the allocation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Migrate, Refusal, Reply
from pancakes.durable.auction import Round, RoundId, RoundTimes
from pancakes.durable.bidding import APPRAISED_S, APPRAISER, Appraise, Appraised, Appraiser
from pancakes.durable.bidding_messages import AllocationAnswered, AllocationAsked
from pancakes.durable.host_state import HostState, Imported
from pancakes.durable.market import (
    MOST_LOTS,
    MOST_NUMBER,
    TOO_MANY,
    AllocationReport,
    Lot,
    Market,
    Offered,
    Row,
    moved_again_price,
)
from pancakes.durable.messages import Solicit
from pancakes.durable.optimum import has_solver, optimum_of
from pancakes.durable.peer_talk import PeerTalk
from pancakes.durable.record import TaskId
from pancakes.durable.snapshot import Snapshot, offer_of
from pancakes.durable.store import Records
from pancakes.errors import MigrationError, PancakesError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import on, reliable
from pancakes.kernel.mailbox import Reference, tell
from pancakes.kernel.registry import TaskEntry
from pancakes.mesh.mesh import Mesh
from pancakes.migration import CostFacts, appraise, is_of_core
from pancakes.packet import NETWORK, SYSCTRL, Packet, agent_of, join
from pancakes.supervision.lifecycle import State
from pancakes.supervision.messages import PeerDown
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task

KEEP: Final = reliable(1024)
HERE: Final = "network/Allocator"
OPTIMIZER: Final = "kernel/Optimizer"
LOOK_S: Final = 1.0
"""How often, in host time, an agent looks whether something has changed."""
BETWEEN_S: Final = 5.0
"""An agent begins no round by itself sooner after the last one that it knows of, in host time."""
SOLVER_S: Final = 5.0
"""How long the best allocation is searched for, in host time."""
MOVING_S: Final = 60.0
"""For how long an agent begins no round while its migrations are not over, in host time."""
LEAST_STEP: Final = 1e-3
"""Costs that differ by less are alike, also if a migration has no price."""
MOST_ASKED: Final = 4
"""How many costs are asked of plug-ins at a time: each has `APPRAISED_S` to answer, and they answer in turn."""
SETTLED_S: Final = 3600.0
"""A task that has stayed on an agent for this long, in host time, migrates at its usual price again."""
OF_HERE: Final = ("busy", "moved", "not_found")
"""Codes of refusals that say nothing of the agent that has won a task."""
MOST_PAST: Final = 256
"""How many past rounds are remembered."""


class Optimize(msgspec.Struct, frozen=True):
    """Asks how good an allocation is; to be answered by `Optimized`.

    Attributes:
        asker: the actor that gets the answer.
        market: what there was to allocate.
        report: the account, which is completed.
    """

    asker: Reference
    market: Market
    report: AllocationReport


class Optimized(msgspec.Struct, frozen=True):
    """The account of a round, with how far it was from the optimum if that could be found."""

    report: AllocationReport


class Optimizer(ActorCore):
    """Looks for the best allocation, in a thread of its own: nothing waits for it but the account."""

    blocking = True

    def take_message(self, message: Any) -> Any:
        if not isinstance(message, Optimize):
            return super().take_message(message)
        # In virtual time a limit of time would give other results each time.
        limit_s = None if self.kernel.virtual is not None else SOLVER_S
        try:
            found = optimum_of(message.market, limit_s)
        except Exception as error:  # a library that cannot be loaded on this computer, for example
            self.kernel.log("warning", f"how good the allocation is, is not known: the solver failed: {error}")
            found = None
        best = found[0] if found is not None else None
        tell(message.asker, Optimized(replace(message.report, optimum=best)))
        return None


class Allocator(TaskCore, Task):
    """Holds the rounds of the team's allocation.

    Args:
        mesh: says what neighbours there are.
        state: says whether this agent can take a task, and how busy it is.
        records: what is known of tasks here.
        at_most: how many of the tasks that are allocated the agent takes.
        crowding: what each of these takes off its bid for the next one.
    """

    def __init__(
        self,
        *args: Any,
        mesh: Mesh,
        state: HostState,
        records: Records,
        at_most: int,
        crowding: float,
        **others: Any,
    ) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh
        self._talk = PeerTalk(self, mesh)
        self._state = state
        self._records = records
        self._at_most = at_most
        self._crowding = crowding
        self._times = RoundTimes()
        self._round: Round | None = None
        self._number = 0
        self._past: dict[RoundId, None] = {}  # rounds that are over or outdated: a late packet begins none again
        self._wanted: list[AllocationAsked] = []
        self._serving: dict[int, AllocationAsked] = {}  # what was asked for, by the number of the round
        self._known: tuple[object, ...] = ()  # what the last round was about, as this agent knows it
        self._steps: dict[str, int | None] = {}  # what lots cost here by cost functions of plug-ins, coarsely
        self._probing: dict[int, str] = {}
        self._to_probe: list[tuple[str, str, Solicit]] = []
        self._probed_s = -math.inf
        self._again_s = -math.inf
        self._barred: dict[str, dict[str, float]] = {}  # until when an agent does not get a task that it refused
        self._dearer: dict[str, tuple[float, float]] = {}  # the price of the next migration, and until when
        self._pricing: dict[int, str] = {}
        self._left_out: set[str] = set()  # tasks whose settings or state are too much to be told
        self._questions = 0
        self._moves: dict[int, tuple[str, str, float]] = {}  # the requests for migrations that are not answered
        self._moves_until_s = -math.inf

    def on_start(self) -> None:
        self._state.allocates = True
        self.after_host(LOOK_S, self._look)

    def on_stop(self) -> None:
        self._state.allocates = False
        optimizer = self.kernel.actor(OPTIMIZER)
        if optimizer is not None:
            optimizer.stop()
        self._refuse_all(Refusal("unable", f"the Allocator of {self.agent} has stopped"))

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.on_stop()

    def take_message(self, message: Any) -> Any:
        match message:
            case AllocationAsked():
                self._ask(message)
            case Appraised():
                self._appraised(message)
            case Imported():
                self._price()
            case Optimized():
                self._account(message.report)
            case PeerDown():
                if self._round is not None:
                    self._round.left(message.peer, self.kernel.host.now())
                    self._go_on()
            case _:
                return super().take_message(message)
        return None

    # When a round begins --------------------------------------------------------------------------------------

    def _ask(self, asked: AllocationAsked) -> None:
        self._wanted.append(asked)
        self._serve()

    def _serve(self) -> None:
        """Begin the next round that was asked for, unless one is under way."""
        if self._wanted and not self._is_busy():
            self._begin(self._wanted.pop(0))

    def _is_busy(self) -> bool:
        return self._round is not None and not self._round.over

    def _look(self) -> None:
        """See whether something has changed that may change the allocation."""
        self.after_host(LOOK_S, self._look)
        now_s = self.kernel.host.now()
        if self._is_busy() or now_s < self._again_s or (self._moves and now_s < self._moves_until_s):
            return
        self._probe(now_s)
        if self._news() != self._known:
            self._begin(None)

    def _news(self) -> tuple[object, ...]:
        """Return what matters: the tasks here, the neighbours, whom a task may go to, and costs, coarsely."""
        lots = self._lots()
        steps = dict(self._steps)
        for key, offered in self._watched(lots).items():
            if offered.lot.request is not None and is_of_core(offered.lot.request.cost):
                cost, _ = self._core_cost(offered.owner, offered.lot.request)
                steps[key] = _step(cost, offered.lot)
        barred = tuple(sorted((key, it.barred) for key, it in lots.items() if it.barred))
        return tuple(sorted(lots)), tuple(self._peers()), barred, tuple(sorted(steps.items()))

    def _watched(self, lots: Mapping[str, Lot]) -> dict[str, Offered]:
        """Return the lots whose costs here matter: those of the last round, its own as they are now."""
        known = self._round.market.lots if self._round is not None else {}
        others = {key: it for key, it in known.items() if it.owner != self.agent and key not in lots}
        return {**others, **{key: Offered(lot, self.agent) for key, lot in lots.items()}}

    def _probe(self, now_s: float) -> None:
        """Have costs worked out by functions of plug-ins now and then: a robot that has driven on may be nearer."""
        if now_s < self._probed_s + BETWEEN_S:
            return
        self._probed_s = now_s
        self._probing.clear()
        watched = self._watched(self._lots())
        self._steps = {key: step for key, step in self._steps.items() if key in watched}
        self._to_probe = [
            (key, it.owner, it.lot.request)
            for key, it in watched.items()
            if it.lot.request is not None and not is_of_core(it.lot.request.cost)
        ]
        self._probe_next()

    def _probe_next(self) -> None:
        while self._to_probe and len(self._probing) < MOST_ASKED:
            self._appraise(self._probing, *self._to_probe.pop(0))

    def _peers(self) -> list[str]:
        hosts = set(self._mesh.neighbours())
        return [name for name in self._talk.neighbours() if name in hosts]

    def _begin(self, asked: AllocationAsked | None) -> None:
        number = self._number % MOST_NUMBER + 1
        while RoundId(number, self.agent) in self._past:  # after the highest number, which anybody may name
            number += 1
        dry_run = asked is not None and asked.dry_run
        self._join(RoundId(number, self.agent), dry_run)
        if asked is not None:
            self._serving[number] = asked
        self.event("allocation_began", round=number, dry_run=dry_run)

    def _join(self, id: RoundId, dry_run: bool) -> None:
        busy = self._is_busy()
        if busy and self._round is not None:
            self._leave(self._round.id)
        self._number = id.number
        now_s = self.kernel.host.now()
        self._round = Round(self.agent, id, dry_run, self._at_most, self._crowding, self._lots(), now_s, self._times)
        self._pricing.clear()
        self._price()
        if not busy:
            self.after_host(self._times.say_again_s, self._tick)

    def _leave(self, id: RoundId) -> None:
        """Another round counts: what was asked for is begun again after that."""
        self._end(id)
        asked = self._serving.pop(id.number, None) if id.starter == self.agent else None
        if asked is not None:
            self._wanted.insert(0, asked)

    def _end(self, id: RoundId) -> None:
        self._past[id] = None
        if len(self._past) > MOST_PAST:
            del self._past[next(iter(self._past))]

    def _refuse_all(self, refusal: Refusal) -> None:
        asked = [*self._serving.values(), *self._wanted]
        self._serving.clear()
        self._wanted.clear()
        for one in asked:
            tell(one.service, AllocationAnswered(one.request, refusal))

    # What is put up, and what it costs --------------------------------------------------------------------------

    def _entries(self) -> dict[str, TaskEntry]:
        """Return the tasks here that are allocated and run, by task."""
        return {
            entry.task_id: entry
            for entry in self.kernel.tasks.all()
            if entry.rule is not None and entry.rule.allocated and entry.task_id and entry.life.state is State.RUNNING
        }

    def _lots(self) -> dict[str, Lot]:
        now_s, mission_s = self.kernel.host.now(), self.now()
        lots, why = {}, {}
        entries = sorted(self._entries().items())
        if len(entries) > MOST_LOTS:
            why[""] = f"{len(entries) - MOST_LOTS} tasks are not allocated, from {entries[MOST_LOTS][0]} on: {TOO_MANY}"
        for key, entry in entries[:MOST_LOTS]:
            task_id, rule = TaskId.parse(key), entry.rule
            record = self._records.get(task_id)
            if record is None or not record.owned or record.under_way:
                continue
            offer = b""
            if record.snapshot and not is_of_core(rule.cost):
                try:
                    offer = Snapshot.decode(record.snapshot).offer()
                except MigrationError as error:
                    why[key] = f"{key} is not allocated: {error}"
                    continue
            until = {peer: it for peer, it in self._barred.get(key, {}).items() if it > now_s}
            self._barred[key] = until
            dearer, until_s = self._dearer.get(key, (0.0, now_s))
            lots[key] = Lot(
                rule.value,
                max(rule.move_price, dearer) if until_s > now_s else rule.move_price,
                rule.takes_mission_s,
                None if rule.ends_by_mission_s is None else rule.ends_by_mission_s - mission_s,
                rule.after,
                rule.together,
                tuple(sorted(until)),
                Solicit(task_id, 0, entry.type, entry.version, entry.service, entry.requires, rule.cost, None, offer),
            )
        self._barred = {key: self._barred[key] for key in lots if self._barred.get(key)}
        for key, sentence in why.items():
            if key not in self._left_out:  # each second they are looked at
                self.log("warning", sentence)
        self._left_out = set(why)
        return lots

    def _price(self) -> None:
        """Tell what each lot costs here: at once if the cost functions are the core's, else once they have answered."""
        auction = self._round
        if auction is None:
            return
        asked = frozenset(self._pricing.values())
        found: dict[str, float] = {}
        refused: dict[str, str] = {}
        for key in auction.unpriced():
            offered = auction.market.lots[key]
            request, owner = offered.lot.request, offered.owner
            if key in asked:
                continue
            if request is None or str(request.task_id) != key:
                refused[key] = f"{owner} does not say what it needs"
                continue
            if owner != self.agent:
                if self._state.imports_first(self, owner, request.type, None):
                    continue
                refusal = self._state.refusal_of(owner, request)
                if refusal is not None:
                    refused[key] = refusal.text
                    continue
            if is_of_core(request.cost):
                cost, why = self._core_cost(owner, request)
                if cost is None:
                    refused[key] = why
                else:
                    found[key] = cost
            elif len(self._pricing) < MOST_ASKED and (why := self._appraise(self._pricing, key, owner, request)):
                refused[key] = why
        auction.price(found, refused, self.kernel.host.now())
        self._say()

    def _facts(self, owner: str) -> CostFacts:
        own = owner == self.agent
        load = self._state.load(0.0 if own else self._mesh.rtt_s(owner))
        # What is allocated counts by its place in the bundle, not as a task that is there anyway.
        return CostFacts(replace(load, active_tasks=max(0, load.active_tasks - len(self._entries()))))

    def _core_cost(self, owner: str, request: Solicit) -> tuple[float | None, str]:
        terms, why = appraise(request.cost, self._facts(owner), self._state.costs())
        return (None, why) if why else (math.fsum(terms.values()), "")

    def _appraise(self, asked: dict[int, str], key: str, owner: str, request: Solicit) -> str:
        """Have cost functions of plug-ins called; return why that cannot be, or an empty string."""
        try:
            settings, state = offer_of(request.offer)
        except MigrationError as error:
            return f"cannot tell its cost: {error}"
        self._questions += 1
        number = self._questions
        asked[number] = key
        facts = replace(self._facts(owner), readings=self._state.known_readings(), settings=settings, state=state)
        appraiser = self.kernel.actor(APPRAISER) or self.kernel.spawn(
            Appraiser, join(self.agent, APPRAISER), costs=self._state.costs
        )
        tell(appraiser, Appraise(self, number, request.cost, facts))
        late = f"its cost function did not answer within {APPRAISED_S:g} s"
        self.after_host(APPRAISED_S, lambda: self._appraised(Appraised(number, {}, late)))
        return ""

    def _appraised(self, found: Appraised) -> None:
        cost = None if found.refusal else math.fsum(found.terms.values())
        probed = self._probing.pop(found.number, "")
        offered = self._watched(self._lots()).get(probed) if probed else None
        if offered is not None:
            self._steps[probed] = _step(cost, offered.lot)
        self._probe_next()
        key = self._pricing.pop(found.number, "")
        if key and self._round is not None and key in self._round.unpriced():
            priced = {} if cost is None else {key: cost}
            self._round.price(priced, {key: found.refusal} if found.refusal else {}, self.kernel.host.now())
            self._go_on()

    # The round ------------------------------------------------------------------------------------------------

    @on(NETWORK, Row, queue=KEEP, addressed=True)
    def on_row(self, packet: Packet) -> None:
        """Another agent says what it puts up, costs and claims."""
        row, peer = packet.body, agent_of(packet.source)
        if peer not in self._peers():
            return  # a terminal, or an agent that is about to go
        id = RoundId(row.number, row.starter)
        auction = self._round
        is_later = auction is None or auction.over or id.is_later_than(auction.id)
        if (auction is None or auction.id != id) and id not in self._past and is_later:
            self._join(id, row.dry_run)
        auction = self._round
        if auction is None:
            return
        if auction.id == id:
            auction.take(peer, row, self.kernel.host.now())
            self._price()
        else:
            auction.answer(peer)  # so it learns of the round that counts
            self._say()

    def _go_on(self) -> None:
        self._price()
        self._say()

    def _say(self) -> None:
        if self._round is None:
            return
        for peer, row in self._round.due(self._peers(), self.kernel.host.now()):
            try:
                self.publish(NETWORK, row, to=join(peer, HERE))
            except PancakesError as error:
                self.log("debug", f"a row did not reach {peer}: {error}")

    def _tick(self) -> None:
        auction = self._round
        if auction is None:
            return
        self._say()
        if auction.tick(self.kernel.host.now()):
            self._end(auction.id)
            self._over(auction)
            self._serve()
        elif not auction.over:
            self.after_host(self._times.say_again_s, self._tick)

    def _over(self, auction: Round) -> None:
        now_s = self.kernel.host.now()
        self._again_s = now_s + BETWEEN_S
        report = auction.report(self._peers(), now_s)
        for peer, fault in report.ignored.items():
            self.log("warning", f"{peer} is left out of the allocation: {fault}")
        if not auction.dry_run:
            self._known = self._news()
            self._moves_until_s = now_s + MOVING_S
            self._moves.clear()
            mine = [it for it in report.lines if it.owner == self.agent and not it.winner]
            self._state.unplaced = {it.task: it.reason for it in mine}
            for line in report.moves:
                if line.owner == self.agent:
                    self._migrate(line.task, line.winner)
                elif line.winner == self.agent:
                    price = moved_again_price(auction.market.lots[line.task].lot)
                    self._dearer[line.task] = price, now_s + SETTLED_S
            self._dearer = {key: it for key, it in self._dearer.items() if it[1] > now_s}
        if auction.id.starter != self.agent:
            return
        if not has_solver():
            self._account(report)
            return
        optimizer = self.kernel.actor(OPTIMIZER) or self.kernel.spawn(Optimizer, join(self.agent, OPTIMIZER))
        tell(optimizer, Optimize(self, auction.market, report))

    def _account(self, report: AllocationReport) -> None:
        """Publish the account of a round that this agent has begun, and answer who asked for it."""
        plain: Mapping[str, Any] = {**msgspec.to_builtins(report), "gap": report.gap}
        self.event("allocation", **plain)
        if not report.dry_run and report.moves:
            moves = ", ".join(f"{it.task} from {it.owner} to {it.winner}" for it in report.moves)
            gap = "" if report.gap is None else f", {report.gap:.1%} below the best allocation"
            self.log("info", f"allocation {report.number}: {moves}; it is worth {report.value:g}{gap}")
        asked = self._serving.pop(report.number, None)
        if asked is not None:
            tell(asked.service, AllocationAnswered(asked.request, None, plain))

    # What follows ---------------------------------------------------------------------------------------------

    def _migrate(self, key: str, to: str) -> None:
        entry = self._entries().get(key)
        if entry is None:
            return
        target = join(entry.service, entry.name)
        packet = self.publish(SYSCTRL, Migrate(target, to, "", entry.rule.cost))
        self._moves[packet.seq] = (key, to, entry.rule.again_s)

    @on(SYSCTRL, Reply, queue=KEEP, addressed=True)
    def on_reply(self, packet: Packet) -> None:
        """A migration is over. An agent that has won a task and refuses it does not get it for a while."""
        found = self._moves.pop(packet.cause[1], None) if packet.cause is not None else None
        refusal = packet.body.refusal
        if found is None or refusal is None:
            return
        if refusal.code in OF_HERE:
            self._known = ()  # the winner has not refused it: the next round decides again
            return
        key, to, again_s = found
        until_s = self.kernel.host.now() + again_s
        self._barred.setdefault(key, {})[to] = until_s
        self.log(
            "warning", f"{key} stays on {self.agent}, and {to} does not get it for {again_s:g} s: {packet.body.reason}"
        )


def _step(cost: float | None, lot: Lot) -> int | None:
    """Return a cost in steps: a change that is smaller than the price of a move would move nothing."""
    return None if cost is None else math.floor(cost / max(lot.move_price, LEAST_STEP) + 0.5)
