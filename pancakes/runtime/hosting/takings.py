"""Taking a guarded task: a service asks the guardians for their pledges, and owns the task once it has them."""

from __future__ import annotations

from functools import partial
from typing import Final

from pancakes.errors import MigrationError
from pancakes.mesh.guarding import seizing as rules
from pancakes.mesh.guarding.guard_messages import DenyLease, GuardAnswer, Pledge
from pancakes.mesh.guarding.seizing import Seizing
from pancakes.mesh.guarding.taking_over import TakeTask
from pancakes.mesh.migration.effect import Seize
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.peer_talk import PeerTalk
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.hosting.snapshots import rules_of
from pancakes.runtime.hosting.tenancy import Taking

AGAIN_S: Final = 0.25
"""How often guardians that have not answered are asked again, in host time."""
MOST_CALLED: Final = 64
"""So many tasks are being taken at once at the word of guardians; they call again."""
GIVEN_UP_S: Final = 3.0
"""A task that a guardian has called this agent to take is left to others after this time."""


class Takings:
    """Takes tasks for one service. All in that service's actor.

    Args:
        host: the service.
        talk: how it talks to guardians.
    """

    def __init__(self, host: HostingService, talk: PeerTalk) -> None:
        self._host = host
        self._talk = talk
        self._called = 0  # how many are being taken at a guardian's word

    def given(self, place: Place, effect: Seize) -> None:
        """The owner has given a task away, and never acts under its epoch again."""
        commit, record = effect.commit, place.standing.record
        if place.taking is not None and place.taking.seizing.offer == commit.offer:
            return
        try:
            type = Snapshot.decode(record.snapshot).type
        except MigrationError as error:
            self._host.log("error", f"{place.task_id} cannot be taken: {error}")
            return
        self._begin(place, rules.given_away(self._host.agent, record, type, effect.source, commit), None)

    def called(self, place: Place, call: TakeTask, own: Guards) -> None:
        """A guardian says that the owner of a task is silent, and that this agent is to take it.

        Args:
            place: the place of the task.
            call: what the guardian says.
            own: the guards that this agent knows as a guardian itself.
        """
        if place.taking is not None or self._called >= MOST_CALLED:
            return
        seizing = rules.called(self._host.agent, place.standing.record, place.standing.volatile, call, own)
        if seizing is None:
            return
        self._host.places.keep(place)
        self._called += 1
        self._host.event("task_called", task=place.task_id.name, epoch=seizing.epoch.n, silent_s=call.silent_s)
        self._begin(place, seizing, self._host.kernel.host.now() + GIVEN_UP_S)

    def _begin(self, place: Place, seizing: Seizing, until_s: float | None) -> None:
        if place.taking is not None:
            self._end(place, place.taking)
        place.taking = Taking(seizing, until_s)
        self._ask(place, seizing.unasked())
        self._later(place, place.taking)

    def _ask(self, place: Place, guardians: list[GuardianId]) -> None:
        assert place.taking is not None
        for guardian in sorted(guardians, key=lambda one: one != self._talk.me):
            self._talk.to_guardian(guardian, place.taking.seizing.ask())

    def _later(self, place: Place, taking: Taking) -> None:
        taking.again = self._host.after_host(AGAIN_S, partial(self._again, place, taking))

    def _again(self, place: Place, taking: Taking) -> None:
        if place.taking is not taking:
            return
        late = taking.until_s is not None and self._host.kernel.host.now() >= taking.until_s
        if late or rules.is_vain(taking.seizing, place.standing.record):
            self._end(place, taking)
            return
        taking.seizing = rules.asked_anew(taking.seizing, self._host.agent)
        self._ask(place, taking.seizing.unasked())
        self._later(place, taking)

    def _end(self, place: Place, taking: Taking) -> None:
        place.taking = None
        if taking.again is not None:
            taking.again.cancel()
        if taking.until_s is not None:
            self._called -= 1
        if place.standing.record.unborn and place.slot is None:
            self._host.places.drop(place)  # a peer may make up as many tasks as it likes

    def heard(self, place: Place, answer: GuardAnswer) -> None:
        """A guardian has answered."""
        taking = place.taking
        if taking is None or answer.epoch != taking.seizing.epoch:
            return
        if isinstance(answer, Pledge) and answer.body is not None:
            try:
                rules_of(answer.body.snapshot, place.task_id)
            except MigrationError as error:
                self._host.log("warning", f"the pledge of {answer.guardian.agent} does not count: {error}")
                return
        known = taking.seizing.members()
        taking.seizing = seizing = rules.told(taking.seizing, answer)
        if isinstance(answer, DenyLease):
            self._host.log("debug", f"{answer.guardian.agent} does not pledge {place.task_id}: {answer.reason}")
            return
        result = seizing.result()
        if result is not None:
            self._end(place, taking)
            self._host.places.keep(place)
            if not result.source:
                owner, epoch = seizing.checkpoint.epoch.minter, result.epoch.n
                self._host.event("task_taken", task=place.task_id.name, source_agent=owner, epoch=epoch)
                if owner != self._host.agent:
                    place.came_from = owner
            self._host.feed_place(place, result)
        else:
            self._ask(place, [one for one in seizing.unasked() if one not in known])
