"""What agents know of each other's tasks: one question, one answer, and one memory of answers. In the registrar.

`WhoHas` asks, `Known` answers. Linked agents also tell each other what they own, so that two owners of one task are
noticed. A claim that the rules do not believe from one agent is confirmed by what others say. An agent remembers on
disk how often each other one was started, and tells it if its disk is an old copy.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from pancakes.durable import rules
from pancakes.durable.delivery import COURIER
from pancakes.durable.entry import Entry, Fed, right_of
from pancakes.durable.messages import MOST_ASKED, REGISTRAR, BootRemembered, Fact, Known, WhoHas
from pancakes.durable.peer_talk import LastSaid
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import BLANK, MORE_THAN_MIGRATIONS, Identity, Register, Standing, Wanted, is_quorum
from pancakes.durable.register_messages import CopyNoticed, KnownCame, NeighbourCame, News
from pancakes.durable.rules import MOST_STEP
from pancakes.durable.takeovers import Takeovers
from pancakes.journal import Disk, RecordTable
from pancakes.kernel.mailbox import Reference, tell
from pancakes.mesh.mesh import Mesh
from pancakes.packet import Packet, agent_of
from pancakes.util import codecs

if TYPE_CHECKING:
    from pancakes.durable.registrar import Registrar

MOST_CLAIMS: Final = 4096
"""At most this many claims of one agent are remembered; of more, the one that was heard first is forgotten."""
MOST_AGENTS: Final = 1024
"""Of at most this many agents they are; of more, the one that has said nothing for longest is forgotten."""
MOST_DOUBTS: Final = 8
"""At most this many claims about one task wait to be confirmed; the oldest is forgotten."""
DOUBTED_S: Final = 2.0
"""A claim that nobody has confirmed after this time is forgotten; the agent that makes it says it again."""


class NetworkBegan(msgspec.Struct, frozen=True):
    """The Network Service tells the registrar that packets can go to other agents from now on."""


class NeighbourUp(msgspec.Struct, frozen=True):
    """The agent tells the registrar that a link to another agent stands.

    Attributes:
        peer: the other agent.
        boot: its boot.
    """

    peer: str
    boot: Boot


class Boot(NamedTuple):
    """One life of an agent.

    Attributes:
        journal: the id of its journal.
        number: how often that was opened.
        life: drawn at each opening.
    """

    journal: str
    number: int
    life: str

    def is_before(self, other: Boot) -> bool:
        """Return whether a disk that is at this boot lacks what happened in the other one."""
        if self.journal != other.journal:
            return False
        return self.number < other.number or (self.number == other.number and self.life != other.life)


MOST_JOURNALS: Final = 4
"""Of at most this many journals of one agent the boots are remembered: a disk that was replaced may come back."""


class BootsSeen(msgspec.Struct, frozen=True):
    """What an agent remembers of another one.

    Attributes:
        boots: its latest boot with each journal, the journal that was met last at the end.
    """

    boots: tuple[Boot, ...] = ()

    def after(self, boot: Boot) -> Boot | None:
        """Return what is remembered and cannot be: that boot has a disk without it. None: there is nothing."""
        return next((known for known in self.boots if boot.is_before(known)), None)

    def with_(self, boot: Boot) -> BootsSeen:
        """Return what is remembered once that boot was met; of a copy nothing is."""
        if boot in self.boots or self.after(boot) is not None:
            return self
        others = tuple(known for known in self.boots if known.journal != boot.journal)
        return BootsSeen((*others, boot)[-MOST_JOURNALS:])


class BootMemory:
    """What is remembered of the boots of other agents. One thread at a time.

    It lies on disk, because a fleet whose power has failed, or which is set up from backups, starts all at once: then
    no agent remembers what it has not written down. An agent has one entry, and a new boot costs one write.

    Args:
        disk: what it is kept on.
    """

    def __init__(self, disk: Disk) -> None:
        self._table = RecordTable(disk, "boot", codecs.decoder(BootsSeen), lambda key, why: None)

    def knows_any(self) -> bool:
        """Return whether there is an agent that this one has ever met."""
        return bool(self._table.newest)

    def journals(self) -> dict[str, str]:
        """Return the id of the journal that each agent had last, by its name."""
        return {agent: seen.boots[-1].journal for agent, seen in self._table.newest.items() if seen.boots}

    def met(self, agent: str, boot: Boot) -> Boot | None:
        """Learn of a boot of an agent; return the later one that is remembered, if its disk is an old copy."""
        known = self._table.newest.get(agent, BootsSeen())
        later = known.after(boot)
        seen = known.with_(boot)
        if seen != known and (agent in self._table.newest or len(self._table.newest) < MOST_AGENTS):
            # What cannot be written is remembered until this agent ends; its journal tells people.
            self._table.write(agent, seen, lambda: None, lambda why: None)
        return later


class Claims:
    """What other agents claim to own: of each, its highest claim on each task.

    A claim does not grow false: an agent that owns the task later owns it under a higher epoch.
    """

    def __init__(self) -> None:
        self._of: dict[str, dict[TaskId, Fact]] = {}  # by the agent, the one heard last at the end

    def heard(self, peer: str, claim: Fact) -> None:
        """Learn of a claim."""
        theirs = self._of[peer] = self._of.pop(peer, {})
        known = theirs.get(claim.task_id)
        if known is None or known.register.epoch <= claim.register.epoch:
            theirs[claim.task_id] = claim
        if len(theirs) > MOST_CLAIMS:
            del theirs[next(iter(theirs))]
        if len(self._of) > MOST_AGENTS:
            del self._of[next(iter(self._of))]

    def by_peer(self) -> dict[str, dict[TaskId, Fact]]:
        """Return the claims, by the agent that made them."""
        return {peer: dict(theirs) for peer, theirs in self._of.items()}


class _Doubt(msgspec.Struct):
    """A claim that waits to be confirmed.

    Attributes:
        message: the claim.
        peer: the agent that makes it.
        fed: how it came.
        said: what others have said.
        until_s: when it is forgotten, in host time.
    """

    message: Any
    peer: str
    fed: Fed | None
    said: dict[Identity, Fact]
    until_s: float


class Answers:
    """Asks, answers, and remembers. In the registrar's actor.

    Args:
        registrar: the registrar.
        mesh: says what neighbours there are.
        boots: what is remembered of the boots of other agents.
        takeovers: looks after tasks whose owners are silent.
    """

    def __init__(self, registrar: Registrar, mesh: Mesh, boots: BootMemory, takeovers: Takeovers) -> None:
        self._registrar = registrar
        self._takeovers = takeovers
        self._mesh = mesh
        self._boots = boots
        self._claims = Claims()
        self._doubts: dict[TaskId, list[_Doubt]] = {}
        self._say_so: set[str] = set()  # the agents that take this one's disk for an old copy
        self._unbelieved = LastSaid()

    def network_began(self) -> None:
        """Packets can go to other agents from now on."""
        for hello in self._mesh.connected().values():
            if hello.role == "agent":
                self.met(hello.name, Boot(hello.journal, hello.boot, hello.life))

    def tell_all(self, service: Reference) -> None:
        """Tell a service that has begun what other agents claim."""
        for peer, claims in self._claims.by_peer().items():
            # Some may be of a disk that it had before.
            for by in dict.fromkeys(claim.register.owner for claim in claims.values()):
                theirs = tuple(claim for claim in claims.values() if claim.register.owner == by)
                tell(service, KnownCame(peer, Known(by, (), theirs)))
        for peer in sorted(self._say_so):
            tell(service, CopyNoticed(peer))

    def _tell_services(self, news: News) -> None:
        for service in self._registrar.state.services():
            tell(service, news)

    # Saying what is known --------------------------------------------------------------------------------------

    def fact_of(self, entry: Entry) -> Fact:
        """Return what this agent knows of a task."""
        record, registrar = entry.record, self._registrar
        acts = record.owned and not record.disputed and registrar.kernel.permits.may_act(right_of(record))
        age_s = None if entry.from_disk or not record.snapshot else max(0.0, entry.heard_s - entry.as_of_s)
        return Fact(
            record.task_id, record.register.summary(), entry.lease.beat > 0, acts, age_s, entry.called, record.gave
        )

    def _known(self, task_id: TaskId) -> Fact | None:
        # What others have claimed is not among it: whether they may, is known where the task's type is.
        entry, lost = self._registrar.entries.get(task_id), self._registrar.records.lost(task_id)
        if lost is not None:
            return Fact(task_id, Register(lost.seen, promised=lost.seen))
        return self.fact_of(entry) if entry is not None and entry.register != BLANK else None

    def asked(self, packet: Packet) -> None:
        """Somebody asks what this agent knows of tasks."""
        asked: WhoHas = packet.body
        peer, _, place = packet.source.partition("/")
        facts = tuple(fact for fact in map(self._known, asked.task_ids) if fact is not None)
        self._registrar.talk.tell(peer, place, Known(self._registrar.me, asked.task_ids, facts))
        if asked.silent:
            for task_id in asked.task_ids:
                self._takeovers.asks(peer, task_id)

    def say(self, peer: str, entries: Sequence[Entry]) -> None:
        """Tell another agent what this one knows, unasked."""
        for first in range(0, len(entries), MOST_ASKED):
            facts = tuple(map(self.fact_of, entries[first : first + MOST_ASKED]))
            self._registrar.talk.tell(peer, REGISTRAR, Known(self._registrar.me, (), facts))

    def tell_owned(self, entry: Entry) -> None:
        """This agent owns a task from now on, or under another epoch: all others are told."""
        for peer in self._mesh.neighbours():
            self.say(peer, [entry])

    def ask(self, peers: Iterable[str], task_ids: Sequence[TaskId]) -> None:
        """Ask neighbours about tasks; no peers: all."""
        for peer in tuple(peers) or self._mesh.neighbours():
            for first in range(0, len(task_ids), MOST_ASKED):
                asked = tuple(task_ids[first : first + MOST_ASKED])
                self._registrar.talk.tell(peer, REGISTRAR, WhoHas(asked))

    def met(self, peer: str, boot: Boot) -> None:
        """A link to another agent stands: it is told what this one owns."""
        entries = [it for it in self._registrar.entries.values() if it.record.owned]
        self.say(peer, entries)
        later = self._boots.met(peer, boot)
        if later is not None:
            self._registrar.log(
                "warning", f"the disk of {peer} is an old copy: {_why(self._registrar.agent, later, boot)}"
            )
            self._registrar.talk.tell(peer, REGISTRAR, BootRemembered(*later))
        self._tell_services(NeighbourCame(peer))

    # Hearing what others know ----------------------------------------------------------------------------------

    def told(self, packet: Packet) -> None:
        """Another agent says what it knows of tasks."""
        told: Known = packet.body
        peer = agent_of(packet.source)
        if told.by.agent != peer or peer not in self._registrar.talk.neighbours():
            return
        hosts = peer in self._mesh.neighbours()
        claims = told.claims if hosts else ()
        for claim in claims:
            self._claims.heard(peer, claim)
        for fact in told.facts:
            entry = self._registrar.entries.get(fact.task_id)
            if entry is not None and not hosts and told.by not in entry.record.members:
                continue  # a simulated world owns no task, and knows only of those that it guards
            if entry is None or fact.register.state is not None:
                continue
            if not told.task_ids and fact in claims and entry.record.owned and entry.record.epoch > fact.epoch:
                self.say(peer, [entry])  # it has not heard of that yet
            self._confirmed_by(entry, told.by, fact)
            self._takeovers.seen(told.by, fact)
            if not (fault := self._fault(peer, entry, fact)):
                self._registrar.feed(entry, Fed(rules.Known(told.by, fact.register), peer))
            elif self._unbelieved.is_news(peer, f"{fact.task_id} {fault}"):
                who = "it" if fact.register.owner.agent == peer else str(fact.register.owner)
                text = f"{peer} says that {who} owns {fact.task_id}, and is not believed: {fault}"
                self._registrar.log("warning", text)
        if hosts and (told.task_ids or claims):
            self._tell_services(KnownCame(peer, told))
            self._registrar.kernel.tell(COURIER, KnownCame(peer, told))

    def _fault(self, peer: str, entry: Entry, fact: Fact) -> str:
        """Return why an agent is not believed what it says of a task; empty: it may be."""
        access = self._registrar.kernel.access
        if fact.register.owner.agent != peer:
            return access.fault(peer, "host", entry.record.type) and access.fault(peer, "guard", entry.record.type)
        if not entry.record.unborn and fact.epoch.n > entry.record.seen.n + MOST_STEP:
            return f"the epoch {fact.epoch} is further from {entry.record.seen} than any task comes"
        if entry.record.standing is Standing.YIELDED and entry.record.gave == peer:
            return ""  # it was given the task, whatever it may bring here
        return access.fault(peer, "host", entry.record.type)

    # Confirming ------------------------------------------------------------------------------------------------

    def confirm(self, entry: Entry, message: Any, peer: str, fed: Fed | None) -> None:
        """Have a claim confirmed by what others say."""
        if self._is_confirmed(entry, message, peer, {}):
            self._registrar.feed_later(entry, _confirmed(message, peer, fed))
            return
        now_s, task_id = self._registrar.kernel.host.now(), entry.record.task_id
        doubts = [it for it in self._doubts.get(task_id, ()) if it.until_s > now_s]
        if any(it.message == message and it.peer == peer for it in doubts):
            return  # the others are asked already: their answers are claims too, and would be asked about without end
        doubts.append(_Doubt(message, peer, fed, {}, now_s + DOUBTED_S))
        self._doubts[task_id] = doubts[-MOST_DOUBTS:]
        if others := self._others(entry, peer):
            self.ask(others, (task_id,))

    def _confirmed_by(self, entry: Entry, by: Identity, fact: Fact) -> None:
        task_id, now_s = entry.record.task_id, self._registrar.kernel.host.now()
        for doubt in self._doubts.get(task_id, [])[:]:
            if doubt.until_s <= now_s:
                self._doubts[task_id].remove(doubt)
                continue
            if by.agent == doubt.peer:
                continue
            doubt.said[by] = fact
            if self._is_confirmed(entry, doubt.message, doubt.peer, doubt.said):
                self._doubts[task_id].remove(doubt)
                self._registrar.feed(entry, _confirmed(doubt.message, doubt.peer, doubt.fed))
        if not self._doubts.get(task_id, True):
            del self._doubts[task_id]

    def _is_confirmed(self, entry: Entry, message: Any, peer: str, said: dict[Identity, Fact]) -> bool:
        me, own, lease_runs = self._registrar.me, entry.register, entry.lease.beat > 0
        if isinstance(message, rules.Prepare):
            members = entry.record.members
            return entry.called == peer or any(fact.called == peer for by, fact in said.items() if by in members)
        register = message.register
        epoch = register.epoch
        is_by_person = epoch.n - own.epoch.n >= MORE_THAN_MIGRATIONS // 2
        if isinstance(message, rules.Accept) and me in register.members:
            if me not in own.members or own.unguarded:
                return (
                    own == BLANK
                    or own.owner.agent == peer
                    or any(_knows(it, epoch) for it in said.values())
                    or not self._others(entry, peer)
                )
            if is_by_person and not lease_runs:
                # Its owner says itself that it is paused for another one, or is not there to say anything.
                fact = said.get(own.owner)
                is_gone = own.owner.agent not in self._mesh.neighbours()
                return is_gone or (fact is not None and fact.register.wanted is Wanted.DISPUTED)
            promised = {it for it, fact in said.items() if fact.register.promised >= epoch} | {register.owner}
            return is_quorum(own.sets, promised) if lease_runs else bool(promised - {register.owner})
        if (
            isinstance(message, rules.Known)
            and own.owner == me in own.members
            and not own.unguarded
            and not is_by_person
        ):
            # It lets go of what it has, so its former members and the present ones must need it no more.
            told = {it: fact.register for it, fact in said.items()} | {message.by: register}
            passed = {it for it, has in told.items() if max(has.epoch, has.promised) >= epoch} - {me}
            without = {it for it, has in told.items() if has.epoch >= epoch and has.sets and me not in has.members}
            return is_quorum(own.sets, passed) and is_quorum(register.sets, without)
        if own.owner == me and own.promised <= own.epoch and (own.unguarded or is_by_person):
            # Of another owner nobody else can know. The task is paused, and nothing of it is lost.
            is_owner = register.owner.agent == peer or not own.unguarded
            return is_owner or any(_knows(fact, epoch) for fact in said.values())
        return any(_knows(fact, epoch) for fact in said.values()) or not self._others(entry, peer)

    def _others(self, entry: Entry, peer: str) -> list[str]:
        """Return the linked agents that may confirm what a peer claims of a task."""
        may = {*self._mesh.neighbours(), *(it.agent for it in entry.record.members)}
        return [it for it in self._registrar.talk.neighbours() if it != peer and it in may]

    # Old copies of disks ---------------------------------------------------------------------------------------

    def boot_remembered(self, packet: Packet) -> None:
        """Another agent takes this one's disk for an old copy."""
        peer, own, told = agent_of(packet.source), self._mesh.identity, packet.body
        boot, later = Boot(own.journal, own.boot, own.life), Boot(told.boot_journal, told.number, told.life)
        if peer not in self._mesh.neighbours() or peer in self._say_so or not boot.is_before(later):
            return
        self._say_so.add(peer)
        text = f"{peer} takes the disk of {self._registrar.agent} for an old copy: {_why(peer, later, boot)}"
        self._registrar.log("warning", text)
        self._tell_services(CopyNoticed(peer))


def _confirmed(message: Any, peer: str, fed: Fed | None) -> Fed:
    return Fed(rules.Confirmed(message), peer, accept=fed.accept if fed is not None else None)


def _knows(fact: Fact, epoch: Any) -> bool:
    """Return whether an agent knows by itself that an epoch was minted: it wrote under it, or has promised it."""
    return fact.register.epoch >= epoch or fact.register.promised >= epoch


def _why(agent: str, later: Boot, boot: Boot) -> str:
    if later.number == boot.number:
        return f"{agent} remembers another start of its journal with the same number, {boot.number}"
    return f"{agent} remembers start {later.number} of its journal, and this is start {boot.number}"


def newest_fact(facts: Iterable[Fact | None]) -> Fact | None:
    """Return the fact with the highest epoch; None: there is none. A task is removed under the epoch that it has."""
    known = [fact for fact in facts if fact is not None]
    return max(known, key=lambda fact: (fact.epoch, fact.removed), default=None)


def fact_of(record: Record) -> Fact:
    """Return what a record says, for other agents."""
    return Fact(record.task_id, record.register.summary(), gave=record.gave)
