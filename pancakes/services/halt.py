"""Halts: all actuators of a fleet stop, and only a person lets them move again (docs/halt.md).

An agent that is asked to halt brings its actuators to their safe hold at once, refuses every command from then on, and
tells its neighbours, which do the same and tell theirs. A halt is on disk, so an agent that is started again is still
halted. Nothing that agents tell each other ends a halt: a person ends it at each agent, so no agent that is out of its
mind, or was taken over, makes the others move.

`Halts` is what an agent knows of halts; its rules are pure. `HaltKeeping` is a part of the root.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, Final

import msgspec

from pancakes.control import EndHalt, Halt, Hold, Refusal
from pancakes.errors import ControlRefusedError, PancakesError
from pancakes.journal import Disk, RecordTable
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.timer import OneShot
from pancakes.packet import CTRL, NETWORK, Packet, agent_of, join, packet_type
from pancakes.security.roster import PEOPLE
from pancakes.supervision.lifecycle import Request
from pancakes.util import codecs

KIND: Final = "halt"
KEY: Final = "newest"
ROOT: Final = "kernel"
"""Where on each agent the root is, which hears of halts."""
STANDS_S: Final = 0.4
"""How long, in host time, the answer to a halt waits at most for all actuators to stop."""
LOOK_S: Final = 0.02
AGAIN_S: Final = 0.1
"""Neighbours that have not answered are told again after this host time; on a link that loses packets that also makes
TCP send the lost ones again sooner."""
OFTEN: Final = 20
"""So often; after that each second."""
SELDOM_S: Final = 1.0
WRITE_AGAIN_S: Final = 5.0
"""A halt that could not be written is written again after this host time."""
MOST_KNOWN: Final = 256
"""The most halts that an agent remembers. If another agent still tells of a forgotten one, it halts again."""
MOST_LETTERS: Final = 200


class HaltRecord(msgspec.Struct, frozen=True):
    """The newest halt that an agent knows.

    Attributes:
        id: names it, a random text: halts have no order, so no agent can make those of others count for old.
        origin: the agent that was asked first.
        halted: whether it lasts here.
        by: who asked for it, an address.
        reason: why, for people.
        spread: whether neighbours are told of it.
        known: the ids of all halts that were taken here, the newest last. They halt this agent no more.
    """

    id: str = ""
    origin: str = ""
    halted: bool = False
    by: str = ""
    reason: str = ""
    spread: bool = True
    known: tuple[str, ...] = ()

    @property
    def why(self) -> str:
        """Why actuators are stopped, as a clause; empty: they need not be."""
        if not self.halted:
            return ""
        return f"halted by {agent_of(self.by)}" + (f": {self.reason}" if self.reason else "")


@packet_type("halt.told")
class HaltTold(msgspec.Struct, frozen=True):
    """An agent tells a neighbour that the fleet is halted.

    Attributes:
        id: names the halt.
        origin: the agent that was asked first.
        by: who asked.
        reason: why, for people.
    """

    id: str
    origin: str
    by: str
    reason: str


@packet_type("halt.heard")
class HaltHeard(msgspec.Struct, frozen=True):
    """A neighbour has heard of a halt, whether it is still halted or not.

    Attributes:
        id: names the halt.
    """

    id: str


class PeerMet(msgspec.Struct, frozen=True):
    """The agent tells the root of a new link, while it is halted."""

    peer: str


class Halts:
    """What an agent knows of halts. Any thread may read it; the root changes it.

    Args:
        disk: where it is kept.
        kernel: learns whether actuators may move.
    """

    def __init__(self, disk: Disk, kernel: Kernel) -> None:
        unreadable = ""

        def malformed(key: str, why: str) -> None:
            nonlocal unreadable
            unreadable = why

        self._kernel = kernel
        self._table = RecordTable(disk, KIND, codecs.decoder(HaltRecord), malformed)
        self.record = self._table.newest.get(KEY, HaltRecord())
        if unreadable:  # it may have been halted
            reason = f"its record of halts cannot be read: {unreadable}"
            self.record = HaltRecord(self.new_id(), kernel.agent, True, kernel.agent, reason, False)
        kernel.halt.why = self.record.why

    def new_id(self) -> str:
        """Return the name of a halt that begins now."""
        kernel = self._kernel
        source: random.Random = random.SystemRandom()
        if kernel.virtual is not None:
            source = kernel.random_for(f"halts/{kernel.agent}/{kernel.host.now()}")
        return f"{source.getrandbits(64):016x}"

    def taken(self, record: HaltRecord) -> HaltRecord:
        """Return a record of a halt that is taken now, with all that were taken before it."""
        return msgspec.structs.replace(record, known=(*self.record.known, record.id)[-MOST_KNOWN:])

    def set(self, record: HaltRecord, persisted: Callable[[str], None]) -> None:
        """Take a record: it counts at once, whether it comes to be on disk or not.

        Args:
            record: the record.
            persisted: called once, in the store's thread, with why it is not on disk; empty: it is.
        """
        self.record = record
        self._kernel.halt.why = record.why
        self._table.write(KEY, record, lambda: persisted(""), persisted)

    def describe(self) -> dict[str, Any] | None:
        """Return the halt that lasts here as plain values; None: there is none."""
        it = self.record
        if not it.halted:
            return None
        return {"id": it.id, "origin": it.origin, "by": it.by, "reason": it.reason, "spread": it.spread}


class HaltKeeping:
    """A part of the root: begins halts, tells neighbours, and lets people end halts. In the root's actor.

    Args:
        root: the root.
        halts: what this agent knows of halts.
        answer: answers a request.
    """

    def __init__(
        self, root: ActorCore, halts: Halts, answer: Callable[[Request, Refusal | None, dict[str, Any]], None]
    ) -> None:
        self._root = root
        self._halts = halts
        self._answer = answer
        self._unheard: dict[str, int] = {}  # the neighbours that have not answered, and how often they were told
        self._telling: OneShot | None = None
        self._not_on_disk = ""  # why the newest halt is not
        self._writing = 0  # how many halts are being written down now
        self._behind: list[Request] = []  # who asked for one again meanwhile
        self._refused: set[str] = set()

    def begin(self) -> None:
        """Begin to listen to neighbours. One that was halted when it ended tells them again."""
        self._root.subscribe(NETWORK, HaltTold, self._told)
        self._root.subscribe(NETWORK, HaltHeard, self._heard)
        self.met("")

    def ready(self) -> None:
        """All services run, so the log is heard: tell people why the actuators are stopped, if they are."""
        record = self._halts.record
        if record.halted:
            self._root.log("warning", f"all actuators of {self._root.agent} are stopped, {record.why}")

    def asked(self, body: Halt | EndHalt, request: Request) -> None:
        """Carry out a request, for which its sender has the right.

        Raises:
            ControlRefusedError: something other than a person asks for the end of the halt, or nothing is halted.
        """
        if isinstance(body, EndHalt):
            self._end(body, request)
        elif body.dry_run:
            self._answer(request, None, self._result(request, ""))
        elif (record := self._halts.record).halted and (record.spread or not body.spread):
            # It lasts already. Who asks again, as nothing seems to happen, is answered, and all is done again.
            self._behind.append(request)
            self._hold_all(record)
            if self._not_on_disk:
                self._write(record)
            elif not self._writing:
                self._answer_behind("")
            self.met("")
        else:
            id, agent = body.id[:MOST_LETTERS] or self._halts.new_id(), self._root.agent
            record = HaltRecord(id, agent, True, request.by, body.reason[:MOST_LETTERS], body.spread)
            self._behind.append(request)
            self._halt(record)

    def met(self, peer: str) -> None:
        """There is a link to a new neighbour; empty: there may be some."""
        if self._halts.record.halted and self._halts.record.spread:
            self._tell([peer] if peer else self._neighbours())

    def _halt(self, record: HaltRecord) -> None:
        root = self._root
        record = self._halts.taken(record)
        self._write(record)
        self._hold_all(record)
        root.event("halted", by=record.by, reason=record.reason, id=record.id)
        root.log("warning", f"all actuators of {root.agent} are stopped, {record.why}. To end it: pancakes halt --end")
        if record.spread:
            self._tell(self._neighbours())

    def _hold_all(self, record: HaltRecord) -> None:
        for device in self._root.kernel.registry.devices():
            if device.actuator:
                self._root.publish(CTRL, Hold(record.why), to=device.address)

    def _write(self, record: HaltRecord) -> None:
        """Take a halt, and write it down; who has asked for it is answered after that."""
        root = self._root

        def done(why_not: str) -> None:
            self._writing -= 1
            if self._halts.record is not record:
                return
            if why_not and not self._not_on_disk:
                text = f"the halt is not on disk ({why_not}): {root.agent} may move if it is started again"
                root.log("error", text)
            self._not_on_disk = why_not
            self._answer_behind(why_not)
            if why_not:
                root.after_host(WRITE_AGAIN_S, lambda: self._write_again(record))

        self._writing += 1
        self._halts.set(record, lambda why_not: root.call(lambda: done(why_not)))

    def _write_again(self, record: HaltRecord) -> None:
        if self._halts.record is record and self._not_on_disk and not self._writing:
            self._write(record)

    def _answer_behind(self, why_not: str) -> None:
        behind, self._behind = self._behind, []
        for request in behind:
            self._stand(request, why_not, 0.0)

    def _stand(self, request: Request, why_not: str, waited_s: float) -> None:
        """Answer a request once all actuators are stopped, or it takes too long."""
        if self._late() and waited_s < STANDS_S:
            self._root.after_host(LOOK_S, lambda: self._stand(request, why_not, waited_s + LOOK_S))
        else:
            self._answer(request, None, self._result(request, why_not))

    def _late(self) -> list[str]:
        return self._root.kernel.registry.moving()

    def _result(self, request: Request, why_not: str) -> dict[str, Any]:
        registry = self._root.kernel.registry
        late = self._late()
        stand = [it.name for it in registry.devices() if it.actuator and it.name not in late]
        return {"halt": self._halts.describe(), "actuators": stand, "late": late, "not_on_disk": why_not}

    # Ending ----------------------------------------------------------------------------------------------------

    def _end(self, body: EndHalt, request: Request) -> None:
        root, before = self._root, self._halts.record
        if not self._is_person(agent_of(request.by)):
            raise ControlRefusedError(
                f"{agent_of(request.by)} is no person, and only a person ends a halt: pancakes halt --end", "forbidden"
            )
        if not before.halted:
            raise ControlRefusedError(f"{root.agent} is not halted")
        if body.id not in ("", before.id):
            text = f"another halt lasts on {root.agent} by now, {before.why}: look again"
            raise ControlRefusedError(text, "conflict")
        if body.dry_run:
            self._answer(request, None, self._result(request, ""))
            return
        self._unheard.clear()
        self._not_on_disk = ""
        self._answer_behind("the halt was ended")
        root.event("halt_ended", by=request.by, id=before.id)
        root.log("warning", f"{agent_of(request.by)} has ended the halt: the actuators of {root.agent} may move again")
        record = msgspec.structs.replace(before, halted=False)

        def persisted(why_not: str) -> None:
            root.call(lambda: self._answer(request, None, self._result(request, why_not)))

        self._halts.set(record, persisted)

    def _is_person(self, peer: str) -> bool:
        """Return whether a peer is a terminal, script or page of a person, and no agent."""
        found = self._root.kernel.access.bearer_of(peer)
        return found is not None and found[0].role in PEOPLE

    # Neighbours ------------------------------------------------------------------------------------------------

    def _neighbours(self) -> list[str]:
        return [link["name"] for link in self._root.kernel.links() if link["role"] != "client"]

    def _tell(self, peers: list[str]) -> None:
        self._unheard.update(dict.fromkeys(peers, 0))
        if self._telling is not None:
            self._telling.cancel()
        self._tell_again()

    def _tell_again(self) -> None:
        self._telling = None
        record, linked = self._halts.record, self._neighbours()
        self._unheard = {peer: count for peer, count in self._unheard.items() if peer in linked}
        if not (record.halted and self._unheard):
            return
        for peer, count in self._unheard.items():
            self._say(peer, HaltTold(record.id, record.origin, record.by, record.reason))
            self._unheard[peer] = count + 1
        fresh = any(count < OFTEN for count in self._unheard.values())
        self._telling = self._root.after_host(AGAIN_S if fresh else SELDOM_S, self._tell_again)

    def _say(self, peer: str, body: HaltTold | HaltHeard) -> None:
        try:
            self._root.publish(NETWORK, body, to=join(peer, ROOT))
        except PancakesError as error:
            self._root.log("debug", f"{peer} was not told of the halt: {error}")

    def _told(self, packet: Packet) -> None:
        root, peer, told = self._root, agent_of(packet.source), packet.body
        if packet.destination != root.address or not isinstance(told, HaltTold):
            return
        if fault := root.kernel.access.fault(peer, "halt", root.agent, join(root.agent, "")):
            if peer not in self._refused:
                self._refused.add(peer)
                root.log("warning", f"{peer} asks for a halt, which is refused: {fault}")
            return
        if not told.id or max(map(len, (told.id, told.origin, told.by))) > MOST_LETTERS:
            return
        # Of a halt that was ended here, an agent that is still halted may speak for long.
        if told.id not in self._halts.record.known:
            self._halt(HaltRecord(told.id, told.origin, True, told.by, told.reason[:MOST_LETTERS]))
        self._say(peer, HaltHeard(told.id))

    def _heard(self, packet: Packet) -> None:
        heard = packet.body
        if packet.destination == self._root.address and isinstance(heard, HaltHeard):
            if heard.id == self._halts.record.id:
                self._unheard.pop(agent_of(packet.source), None)
