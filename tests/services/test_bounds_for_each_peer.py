"""What one peer can make another keep has a bound, and leaves others their place."""

from __future__ import annotations

import gc
import random
from typing import ClassVar

import pytest
from services.counting import Count
from services.numbered import Sink
from services.strangers import ask_for_room, heard_by, identity, offer, owns, room, say, tell

from pancakes.control import Describe, Follow, Reply
from pancakes.durable import quotas
from pancakes.durable.delivery import Letter
from pancakes.durable.host_state import MOST_SLOTS
from pancakes.durable.hosting import MOST_GIVEN, MOST_GIVEN_BYTES, TaskLetters
from pancakes.durable.messages import Bid, BootRemembered, Fact, Known, Refuse
from pancakes.durable.quotas import MOST_OFFERED
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Standing
from pancakes.durable.rules import MOST_STEP
from pancakes.durable.times import Times
from pancakes.mesh.memory_network import Quality
from pancakes.mesh.partial_mesh import MOST_KNOWN, MOST_OF_PEER, FewLinks
from pancakes.packet import Fence, Packet, type_name
from pancakes.services.fence_rule import MOST_OF_PEER as MOST_MARKS
from pancakes.services.fence_rule import ClaimRefused, EpochClaim, Mark, May, judged
from pancakes.testing import Fleet
from pancakes.tools.cli.verbs.agent_checks import check_kept
from pancakes.tools.cli.verbs.checks import Facts
from pancakes.util import codecs

COUNT = TaskId("a", "Count")


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": Count, "Sink": Sink})
        made.start("b")
        made.start("c")
        made.connect()
        made.run_for(1.0)
        yield made


def room_for(fleet, name):
    return room(fleet, TaskId("c", name))


def test_room_in_which_nothing_came_is_given_to_others(fleet):
    b, answers = fleet.agents["b"], heard_by(fleet, "c", Bid, Refuse)
    for number in range(MOST_SLOTS + 1):
        ask_for_room(fleet, "c", room_for(fleet, f"T{number}"), "b")
    fleet.run_for(0.5)
    assert [type(it) for it in answers] == [Bid] * MOST_SLOTS + [Refuse]
    fleet.run_for(3 * Times().slot_s)
    ask_for_room(fleet, "c", room_for(fleet, "T1"), "b")
    fleet.run_for(0.5)
    assert isinstance(answers[-1], Bid) and b.agent.records.all() == {}


def brought(fleet, name):
    task_id = TaskId("c", name)
    request = room_for(fleet, name)
    ask_for_room(fleet, "c", request, "b")
    fleet.run_for(0.05)
    say(fleet, "c", offer(fleet, "c", task_id, "b", version=request.version), "b")
    fleet.run_for(0.05)


def test_tasks_that_were_brought_and_taken_back_leave_a_bounded_number_of_marks(fleet, monkeypatch):
    monkeypatch.setattr("pancakes.durable.quotas.MOST_LEFT", 5)
    b, declined = fleet.agents["b"], heard_by(fleet, "c", Refuse)
    for number in range(20):
        brought(fleet, f"T{number}")
        task_id = TaskId("c", f"T{number}")
        taken_back = offer(fleet, "c", task_id, "b", no=2).register._replace(heir=Identity(""))
        say(fleet, "c", Known(taken_back.owner, (), (Fact(task_id, taken_back),)), "b")
        fleet.run_for(0.05)
    assert len([it for it in b.agent.records.all() if it.birthplace == "c"]) == 5
    assert "remembers 5 tasks of c, and no more" in {it.refusal.text for it in declined}
    assert [line for line in b.lines("warning") if "remembers 5 tasks of c, and no more" in line], "doctor tells that"


class Looked(Record, frozen=True):
    """A record that says when it is looked at closely."""

    looks: ClassVar[list[TaskId]] = []

    @property
    def standing(self):
        self.looks.append(self.task_id)
        return Standing.MEMBER


def test_only_what_is_kept_of_the_same_peer_is_counted(monkeypatch):
    """An owner says several times a second that it has a task: what others have brought makes that no slower."""
    me = Identity("me")
    kept = [
        Looked(TaskId(peer, f"T{number}"), Register(Epoch(1, Identity(peer)), sets=((Identity(peer), me),)), me)
        for peer in "abc"
        for number in range(3)
    ]
    monkeypatch.setattr(quotas, "MOST_GUARDED", 3)
    assert quotas.fault_of_room("a", quotas.GUARDED, kept, 0) == "guards 3 tasks of a already (0 bytes), and no more"
    assert {it.birthplace for it in Looked.looks} == {"a"}


def test_an_epoch_that_no_task_comes_to_is_not_taken(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    ask_for_room(fleet, "c", room_for(fleet, "T1"), "b")
    fleet.run_for(0.1)
    say(fleet, "c", offer(fleet, "c", TaskId("c", "T1"), "b", n=MOST_STEP + 1), "b")
    tell(fleet, "c", "a", owns(fleet, "c", COUNT, MOST_STEP + 1))
    fleet.run_for(1.0)
    assert b.agent.records.all() == {}
    assert "Count" in a.running() and a.agent.records.get(COUNT).seen.n == 0
    assert [line for line in a.lines("warning") if "c says that it owns a/Count, and is not believed" in line]


def test_a_number_that_cannot_grow_any_more_does_not_arrive(fleet):
    decode, me = codecs.decoder(Epoch), identity(fleet, "c")
    assert decode(codecs.encode(Epoch(2**53, me)))
    for n in (2**53 + 1, -2):
        with pytest.raises(ValueError, match="Expected `int`"):
            decode(codecs.encode(Epoch(n, me)))


def test_letters_that_a_busy_task_has_not_looked_at_are_bounded_for_each_agent(fleet):
    letters, task, packet = TaskLetters(), fleet.agents["a"].task("Sink"), bytes(100)

    def given(sender, count):
        made = (Letter("a/Sink", f"{sender}#{number}", 1, 1, packet, sender) for number in range(count))
        return sum(letters.give(task, letter, None) for letter in made)

    assert given("c", 2 * MOST_GIVEN) == MOST_GIVEN
    assert given("b", 3) == 3, "those of others have their place"
    letters.looked_at(task, Letter("a/Sink", "c#0", 1, 1, packet, "c"))
    assert letters.give(task, Letter("a/Sink", "new", 1, 1, packet, "c"), None)
    large = [Letter("a/Sink", f"d#{number}", 1, 1, bytes(MOST_GIVEN_BYTES // 4), "d") for number in range(8)]
    assert sum(letters.give(task, letter, None) for letter in large) == 4


def test_facts_that_an_agent_tells_are_kept_once(fleet):
    """Two say that the disk of a is an old copy, so each is asked, and one goes on to tell other things."""
    own = fleet.agents["a"].agent.mesh.identity
    for sayer in "bc":
        say(fleet, sayer, BootRemembered(own.journal, own.boot + 1, "x"), "a")
    for n in range(300):
        tell(fleet, "c", "a", owns(fleet, "c", COUNT, n), task_ids=(COUNT,))
        fleet.run_for(0.01)
    fleet.run_for(1.0)
    gc.collect()
    assert sum(isinstance(it, Fact) and it.owner == "c" for it in gc.get_objects()) < 30


def test_an_agent_follows_channels_under_so_many_addresses(fleet, monkeypatch):
    monkeypatch.setattr("pancakes.services.network.MOST_FOLLOWED", 5)
    c, replies = fleet.agents["c"], []
    c.kernel.stream.tap("sysctrl", lambda packet: replies.append(packet.body))
    for number in range(8):
        asked = Packet("sysctrl", type_name(Follow), f"c/client/F{number}", "a", 0.0, number + 1, Follow("system"))
        c.kernel.stream.publish(asked)
    fleet.run_for(0.5)
    answers = [body for body in replies if isinstance(body, Reply)]
    assert [reply.ok for reply in answers] == [True] * 5 + [False] * 3
    assert answers[-1].reason == "c follows 5 times already, under as many addresses"


def test_an_actuator_keeps_room_for_the_tasks_of_others():
    marks = {f"c/T{number}": Mark(0, "c", "c") for number in range(MOST_MARKS)}
    new = EpochClaim(Fence("c/New", (0, "c")), "c")
    refused = judged("a", new, marks, None, [])
    assert isinstance(refused, ClaimRefused) and "250 tasks of c have commanded it" in refused.reason
    assert isinstance(judged("a", EpochClaim(Fence("b/New", (0, "b")), "b"), marks, None, []), May)


def test_agents_that_one_peer_makes_up_leave_room_for_those_of_others():
    few = FewLinks(4, random.Random(1), 0.0)
    for number in range(MOST_KNOWN):
        few.on_sighting(f"x{number}", (f"tcp://x{number}:1",), 1.0, 10.0, "liar")
    assert few.describe()["known"] == MOST_OF_PEER
    few.on_sighting("honest", ("tcp://honest:1",), 1.0, 10.0, "b")
    assert few.knows("honest")
    few.on_sighting("x1", ("tcp://x1:1",), 0.0, 11.0)
    few.on_sighting("more", ("tcp://more:1",), 1.0, 11.0, "liar")
    assert few.knows("more"), "one that is linked is not made up"


def findings_of(fleet, name):
    return list(check_kept(fleet.agents[name].ask(Describe()).result, Facts()))


def test_doctor_names_a_peer_that_takes_its_room(fleet):
    assert findings_of(fleet, "b") == []
    brought(fleet, "T0")
    assert findings_of(fleet, "b") == [], "one hand-off is under way"
    for number in range(1, MOST_OFFERED):
        brought(fleet, f"T{number}")
    (found,) = findings_of(fleet, "b")
    assert (found.level, found.about) == ("warning", "b")
    assert found.text.startswith("keeps 64 tasks whose hand-off from c is in doubt (")
    assert found.text.endswith("100% of the limit")
    assert "pancakes task forget-peer b c" in found.advice


def test_doctor_names_what_a_peer_has_left_that_is_away(fleet):
    brought(fleet, "T0")
    fleet.crash("c")
    fleet.run_for(3.0)
    (found,) = findings_of(fleet, "b")
    assert found.text.startswith("keeps 1 tasks whose hand-off from c") and found.text.endswith("and c is away")


def test_doctor_names_a_peer_that_has_guarded_tasks_removed_again_and_again():
    row = {"peer": "c", "kind": "removed", "count": 15000, "bytes": 0, "share": 0.92}
    (found,) = check_kept({"agent": "b", "neighbours": ["c"], "kept_of_peers": [row]}, Facts())
    assert "15000 marks of removed guarded tasks of c" in found.text
    assert "pancakes keys revoke c" in found.advice


def test_one_peer_cannot_keep_others_waiting_for_a_place(fleet):
    """A is asked where each of its tasks is, and its answer takes long."""
    fleet.start("d")
    fleet.connect()
    fleet.network.set_quality("a", "b", Quality(latency_s=0.4))
    given = heard_by(fleet, "d", Bid)
    for speaker, number in [*(("c", number) for number in range(100)), ("d", 1000)]:
        ask_for_room(fleet, speaker, room(fleet, TaskId("a", f"T{number}")), "b")
        fleet.run_for(0.002)
    fleet.run_for(0.6)
    assert len(given) == 1
