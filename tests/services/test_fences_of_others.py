"""No agent that never had a task keeps the task's own commands from an actuator."""

import pytest
from services.test_durable_fences import Circle, Wheels

from pancakes.control import Describe, Migrate, Migrations, SetFence, Start, Stop
from pancakes.devices import Twist
from pancakes.durable.messages import REGISTRAR, Accept, Fact, Known, Prepare, addressed
from pancakes.durable.record import TaskId
from pancakes.durable.register import NO_EPOCH, Epoch, Identity, Register
from pancakes.durable.rules import NO_WRITE
from pancakes.durable.snapshot import Snapshot
from pancakes.mesh.memory_network import Quality
from pancakes.packet import Fence, Packet
from pancakes.services.fence_rule import Mark
from pancakes.testing import Fleet

CIRCLE = TaskId("a", "Circle")
CLASSES = {"test.Circle": Circle}
REMOTE = {"type": "network.motors", "settings": {"target": "far/device/wheels"}}


@pytest.fixture
def fleet():
    Wheels.told = []
    with Fleet(3, classes=CLASSES) as made:
        yield made


def forge(fleet, speaker, epoch, task_id="a/Circle", to="far/device/wheels", for_s=0.3):
    """An agent commands an actuator of another as if a task of some epoch did."""
    agent = fleet.agents[speaker]
    source = f"{speaker}/device/wheels"
    packet = Packet(
        "ctrl", "motors", source, to, agent.kernel.mission.now(), 1, Twist(9.0, 0.0), fence=Fence(task_id, epoch)
    )
    agent.agent.mesh.send(packet)
    fleet.run_for(for_s)


def marks(agent):
    return {it["task_id"]: (it["epoch"], it["brought_by"]) for it in agent.ask(Describe("wheels")).result["fences"]}


def identity(fleet, name):
    return Identity(name, fleet.agents[name].agent.mesh.identity.journal)


def says(fleet, by, owner, n, to="far/device/wheels"):
    """An agent says that another one has the task."""
    epoch = Epoch(n, identity(fleet, owner))
    told = Known(identity(fleet, by), (CIRCLE,), (Fact(CIRCLE, Register(epoch), gave=owner if owner != by else ""),))
    fleet.agents[by].publish("network", told, to=to)


def drives(fleet, agent="far"):
    Wheels.told.clear()
    fleet.run_for(1.0)
    return (agent, 0.1) in Wheels.told and (agent, 9.0) not in Wheels.told


@pytest.mark.parametrize("epoch", [(1, "z"), (10**12, "z")])
def test_a_stranger_to_a_task_does_not_lock_it_out_of_its_own_wheels(fleet, epoch):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    fleet.start("z")
    fleet.connect()
    fleet.run_for(0.5)
    forge(fleet, "z", epoch, to="a/device/wheels")
    assert drives(fleet, "a") and marks(a) == {"a/Circle": (0, "a")}


def test_a_stranger_does_not_lock_the_task_of_another_out_of_wheels_elsewhere(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    fleet.start("a", devices={"wheels": REMOTE}, tasks={"Circle": {"type": Circle, "start": False}})
    fleet.start("z")
    fleet.connect()
    forge(fleet, "z", (5, "z"))
    assert marks(far) == {} and far.kernel.registry.holder("wheels") == "", "and it does not keep them either"
    (refused,) = far.events("command_refused", by="z/device/wheels")
    assert refused["reason"] == (
        "a does not know that z was given a/Circle; `pancakes task recover` shows which agent has it, and sets that"
        " right"
    )
    assert fleet.agents["a"].ask(Start("Circle")).ok
    assert drives(fleet) and marks(far) == {"a/Circle": (0, "a")}


def test_a_task_goes_on_commanding_wheels_elsewhere_wherever_it_moves(fleet):
    """From its birthplace to a second agent and to a third, which the agent of the wheels has not met with it."""
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a", devices={"wheels": REMOTE}, tasks={"Circle": Circle})
    b = fleet.start("b", devices={"wheels": REMOTE})
    c = fleet.start("c", devices={"wheels": REMOTE})
    fleet.connect()
    assert drives(fleet) and marks(far) == {"a/Circle": (0, "a")}
    assert a.ask(Migrate("Circle", to="b")).ok
    assert drives(fleet) and marks(far) == {"a/Circle": (1, "b")}
    assert b.ask(Migrate("Circle", to="c")).ok
    assert drives(fleet) and marks(far) == {"a/Circle": (2, "c")}
    assert c.ask(Migrate("Circle", to="a")).ok
    assert drives(fleet) and marks(far) == {"a/Circle": (3, "a")}
    assert far.events("command_refused") == []


def test_moves_that_wheels_did_not_see_are_told_by_those_that_made_them(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    names = ("a", "b", "c", "d")
    for name in names:
        tasks = {"Circle": {"type": Circle, "start": True}} if name == "a" else {}
        fleet.start(name, devices={"wheels": REMOTE}, tasks=tasks)
    fleet.connect()
    fleet.run_for(0.5)
    fleet.network.partition(["far"])
    fleet.run_for(5.0)
    for source, to in zip(names, names[1:], strict=False):
        assert fleet.agents[source].ask(Migrate("Circle", to=to)).ok
    fleet.network.heal()
    fleet.connect()
    fleet.run_for(2.0)
    assert drives(fleet) and marks(far) == {"a/Circle": (3, "d")}


def lost(fleet):
    """The task went from `a` to `b` and on to `c` while the wheels were away, and the two that gave it are gone."""
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a", devices={"wheels": REMOTE}, tasks={"Circle": Circle})
    b = fleet.start("b", devices={"wheels": REMOTE})
    fleet.start("c", devices={"wheels": REMOTE})
    fleet.connect()
    fleet.run_for(0.5)
    fleet.network.partition(["far"])
    fleet.run_for(5.0)
    assert a.ask(Migrate("Circle", to="b")).ok and b.ask(Migrate("Circle", to="c")).ok
    fleet.crash("a")
    fleet.crash("b")
    fleet.network.heal()
    assert fleet.run_until(lambda: {"c"} <= set(far.agent.mesh.neighbours()))
    fleet.run_for(2.0)
    return far


def test_where_all_that_had_a_task_are_gone_a_person_sets_the_fence(fleet):
    far = lost(fleet)
    assert not drives(fleet)
    reason = far.events("command_refused", by="c/device/wheels")[-1]["reason"]
    assert reason.startswith(
        "c is not known to have been given a/Circle, and a, which had it, cannot be asked; `pancakes"
    )

    tried = far.ask(SetFence("wheels", "a/Circle", dry_run=True))
    told = {"actuator": "far/device/wheels", "task_id": "a/Circle", "owner": "c", "before": "0@a", "now": "2@c"}
    assert tried.ok and tried.result == told
    assert marks(far) == {"a/Circle": (0, "a")} and not drives(fleet)

    done = far.ask(SetFence("wheels", "a/Circle"))
    assert done.ok and done.result == told
    assert drives(fleet) and marks(far) == {"a/Circle": (2, "c")}
    (account,) = far.ask(Migrations()).result
    assert (account["outcome"], account["winner"], account["task_id"]) == ("fenced", "c", "a/Circle")
    assert account["reason"] == "the fence of far/device/wheels was at 0@a, and is at 2@c now"
    assert account["duration_s"] == 0.0
    assert far.events("fence_set", task="wheels")[-1]["owner"] == "c"


def test_a_fence_that_was_set_too_high_is_set_back_and_the_wheels_hold_meanwhile(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    fleet.start("b")
    fleet.connect()
    fleet.run_for(0.5)
    wrong = Fence("a/Circle", (9, "z"))
    a.kernel.stream.publish(Packet("ctrl", "motors", "a/client/Circle", "", 0.0, 1, Twist(0.0, 0.0), fence=wrong))
    fleet.run_for(0.5)
    assert not drives(fleet, "a") and marks(a) == {"a/Circle": (9, "a")}
    assert a.ask(SetFence("wheels", "a/Circle")).ok
    assert a.events("safe_hold", device="wheels")[-1]["reason"] in ("its fence is set", "no fresh command")
    assert drives(fleet, "a") and marks(a) == {"a/Circle": (0, "a")}
    fleet.crash("a")
    a = fleet.restart("a")
    assert drives(fleet, "a") and marks(a) == {"a/Circle": (0, "a")}


def test_a_fence_is_not_set_where_no_agent_has_the_task_or_one_does_not_answer(fleet):
    far = lost(fleet)
    assert "no agent that is connected has b/Other" in far.ask(SetFence("wheels", "b/Other")).reason
    fleet.agents["c"].kernel.stream.unsubscribe("c/kernel/Registrar")
    refused = far.ask(SetFence("wheels", "a/Circle"))
    assert refused.reason == "c did not say whether a/Circle is there: ask again, or end it first"
    assert marks(far) == {"a/Circle": (0, "a")}


def test_what_another_than_the_asked_agent_says_of_a_task_raises_no_fence(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    for name in "ayz":
        fleet.start(name)
    fleet.connect()
    fleet.network.set_quality("far", "a", Quality(latency_s=0.3))
    forge(fleet, "z", (5, "z"), for_s=0.05)
    says(fleet, "y", "z", 5)
    fleet.run_for(2.0)
    assert marks(far) == {} and len(far.events("command_refused", by="z/device/wheels")) == 1


def test_what_an_agent_says_that_was_not_asked_for_it_sets_no_fence(fleet):
    """It came only after the others were asked."""
    far = lost(fleet)
    questions: list[Packet] = []
    answers: list[Packet] = []
    far.kernel.stream.tap_outgoing(lambda packet: questions.append(packet) if packet.type == "task.who_has" else None)
    far.kernel.stream.tap("network", answers.append, ("task.known",))
    fleet.network.set_quality("far", "c", Quality(latency_s=0.4))
    asked = far.publish("sysctrl", SetFence("wheels", "a/Circle", dry_run=True))
    assert fleet.run_until(lambda: questions)
    z = fleet.start("z")
    assert fleet.run_until(lambda: "far" in z.agent.mesh.neighbours(), 0.5)
    says(fleet, "z", "z", 9)
    assert far.reply_to(asked).result["owner"] == "c"
    assert [packet.destination for packet in questions] == ["c/kernel/Registrar"]
    assert [packet.source.split("/")[0] for packet in answers] == ["z", "c"]


def test_a_command_that_waits_for_the_disk_is_forgotten_where_the_fence_is_set_meanwhile(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    fleet.run_for(0.5)
    fleet.faults.slow_disk("a", 0.1)
    later = Fence("a/Circle", (9, "z"))
    a.kernel.stream.publish(Packet("ctrl", "motors", "a/client/Circle", "", 0.0, 1, Twist(9.0, 0.0), fence=later))
    assert a.ask(SetFence("wheels", "a/Circle")).result["before"] == "9@z"
    assert ("a", 9.0) not in Wheels.told
    assert drives(fleet, "a") and marks(a) == {"a/Circle": (0, "a")}


def test_one_that_does_not_hold_an_actuator_raises_no_fence_of_it(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    fleet.start("z")
    fleet.connect()
    fleet.run_for(0.5)
    forge(fleet, "z", (0, "z"), task_id="z/Any", to="a/device/wheels")
    assert a.events("command_refused", by="z/device/wheels")[-1]["reason"] == "it is held by a/client/Circle"
    assert drives(fleet, "a") and marks(a) == {"a/Circle": (0, "a")}


def test_only_an_actuator_has_a_fence(fleet):
    a = fleet.start("a", devices={"wheels": Wheels, "load": {"type": "host.load"}}, tasks={"Circle": Circle})
    assert a.ask(SetFence("load", "a/Circle")).reason == "a/device/load is no actuator: it has no fence"
    assert a.ask(SetFence("Circle", "a/Circle")).reason == "a/client/Circle is no actuator: it has no fence"
    assert a.ask(SetFence("device", "a/Circle")).reason == "a/device is a service: name one of its tasks"


def test_an_answer_that_comes_late_lowers_no_fence(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a", devices={"wheels": REMOTE}, tasks={"Circle": Circle})
    fleet.start("c", devices={"wheels": REMOTE})
    fleet.connect()
    fleet.network.partition(["far"])
    fleet.run_for(5.0)
    assert a.ask(Migrate("Circle", to="c")).ok
    fleet.network.set_quality("far", "a", Quality(latency_s=0.3))
    asked: list[Packet] = []
    a.kernel.stream.tap("network", asked.append, ("task.who_has",))
    fleet.network.heal()
    assert fleet.run_until(lambda: asked, timeout_s=30.0)
    fences = far.component("device").slots["wheels"].spec.arguments["fences"].fences
    fences.write("wheels", "a/Circle", Mark(5, "x", "far"), lambda: None, pytest.fail)
    fleet.run_for(2.0)
    assert marks(far) == {"a/Circle": (5, "far")}
    assert "has passed, 5 has been seen" in far.events("command_refused", by="c/device/wheels")[-1]["reason"]


def test_one_that_claims_all_the_time_costs_one_question_a_second_and_one_line(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a")
    fleet.start("z")
    fleet.connect()
    asked: list[Packet] = []
    a.kernel.stream.tap("network", asked.append, ("task.who_has",))
    for number in range(200):
        forge(fleet, "z", (number + 5, "z"), for_s=0.01)
    assert 1 <= len(asked) <= 3
    assert len(far.events("command_refused", by="z/device/wheels")) == 1


def test_one_that_claims_all_the_time_keeps_no_other_from_being_heard(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a", devices={"wheels": REMOTE}, tasks={"Circle": Circle})
    fleet.start("c", devices={"wheels": REMOTE})
    fleet.start("z")
    fleet.connect()
    fleet.network.partition(["far"])
    fleet.run_for(5.0)
    assert a.ask(Migrate("Circle", to="c")).ok
    fleet.network.set_quality("far", "a", Quality(latency_s=0.2))
    fleet.network.heal()
    assert fleet.run_until(lambda: {"a", "z"} <= set(far.agent.mesh.neighbours()), timeout_s=30.0)
    for number in range(300):
        forge(fleet, "z", (number + 5, "z"), for_s=0.01)
    assert marks(far) == {"a/Circle": (1, "c")} and drives(fleet)


def test_an_actuator_holds_while_its_fence_is_set_and_goes_on_after_that(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    fleet.run_for(0.5)
    assert a.ask(SetFence("wheels", "a/Circle", dry_run=True)).ok
    assert a.events("safe_hold") == []
    assert a.ask(SetFence("wheels", "a/Circle")).ok
    assert [event["reason"] for event in a.events("safe_hold")] == ["its fence is set"]
    assert drives(fleet, "a")


def test_an_agent_that_does_not_say_to_whom_it_gave_a_task_is_named(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a")
    fleet.start("z")
    fleet.connect()
    a.kernel.stream.unsubscribe("a/kernel/Registrar")
    for _ in range(6):
        forge(fleet, "z", (5, "z"))
    (refused,) = far.events("command_refused", by="z/device/wheels")
    assert refused["reason"].startswith("a does not say where it gave a/Circle; `pancakes task recover`")


def test_an_agent_whose_claim_was_refused_makes_another_after_a_second(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    fleet.start("z")
    fleet.connect()
    forge(fleet, "z", (5, "z"), for_s=0.9)
    (first,) = far.events("command_refused")
    forge(fleet, "z", (5, "z"), task_id="a/Other", for_s=0.3)
    assert far.events("command_refused") == [first], "it is not looked at"
    forge(fleet, "z", (5, "z"), task_id="a/Other", for_s=0.3)
    assert "a/Other" in far.events("command_refused")[-1]["reason"]


def test_a_claim_takes_the_place_of_one_of_the_same_agent_that_another_is_asked_about(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    fleet.start("a")
    fleet.start("z")
    fleet.connect()
    forge(fleet, "z", (5, "z"), for_s=0.0)
    forge(fleet, "z", (0, "z"), task_id="z/Any")
    assert ("far", 9.0) in Wheels.told and marks(far) == {"z/Any": (0, "z")}
    assert far.events("command_refused") == []


def test_agents_that_name_each_other_as_the_owner_are_asked_eight_times_in_all(fleet):
    far = fleet.start("far", devices={"wheels": Wheels})
    for name in "abz":
        fleet.start(name).kernel.stream.unsubscribe(f"{name}/kernel/Registrar")
    fleet.connect()
    questions: list[Packet] = []
    far.kernel.stream.tap_outgoing(lambda packet: questions.append(packet) if packet.type == "task.who_has" else None)
    forge(fleet, "z", (5, "z"), for_s=0.05)
    asked: list[str] = []
    while len(asked) < min(len(questions), 20):
        asked.append(questions[len(asked)].destination.partition("/")[0])
        other = "b" if asked[-1] == "a" else "a"
        says(fleet, asked[-1], other, 5)
        fleet.run_for(0.05)
    assert asked == ["a", "b"] * 4
    (refused,) = far.events("command_refused", by="z/device/wheels")
    assert refused["reason"].startswith("b gave a/Circle to a, and not to z; ")
    assert marks(far) == {}


@pytest.mark.parametrize("how", ["asked for a promise", "made a member", "offered it, and took it back"])
@pytest.mark.parametrize("moved", [False, True], ids=["of a task that it never had", "of a task that it gave away"])
def test_agent_vouches_for_no_stranger_that_has_spoken_to_it(fleet, how, moved):
    """Z tells the agent of the wheels, and one that had the task, what it likes."""
    far = fleet.start("far", devices={"wheels": Wheels})
    a = fleet.start("a", devices={"wheels": REMOTE}, tasks={"Circle": {"type": Circle, "start": moved}})
    b = fleet.start("b", devices={"wheels": REMOTE})
    fleet.start("z", devices={"wheels": REMOTE})
    fleet.connect()
    fleet.run_for(0.5)
    if moved:
        for source, to in ((a, "b"), (b, "a")):
            assert source.ask(Migrate("Circle", to=to)).ok
            fleet.run_for(1.0)
        assert a.ask(Stop("Circle")).ok
        fleet.run_for(1.0)
    at = marks(far)
    for name in ("far", "b"):
        lie(fleet, how, name)
    fleet.run_for(1.0)
    forge(fleet, "z", (9, "z"))
    assert marks(far) == at
    fleet.run_for(1.0)
    assert a.ask(Start("Circle")).ok
    assert drives(fleet)


def lie(fleet, how, to):
    z, other = identity(fleet, "z"), identity(fleet, to)
    epoch, state = Epoch(9, z), Snapshot(CIRCLE, "test.Circle", "", "client", requires=("motors",)).encode()
    if how == "asked for a promise":
        say(fleet, Prepare(CIRCLE, "test.Circle", epoch, (NO_EPOCH, NO_WRITE), ((other,),)), to)
        return
    is_offer = how.startswith("offered")
    members = ((z,),) if is_offer else ((z, other),)
    write = Register(epoch, 1, members, heir=other if is_offer else Identity(""))
    say(fleet, Accept(CIRCLE, "test.Circle", "client", write, to=write.heir, state=state), to)
    if is_offer:
        later = Register(epoch, 2, members)
        say(fleet, Known(z, (), (Fact(CIRCLE, later),)), to)


def say(fleet, body, to):
    if hasattr(body, "journal"):
        body = addressed(body, identity(fleet, to).journal)
    fleet.agents["z"].publish("network", body, to=f"{to}/{REGISTRAR}")
    fleet.run_for(0.3)
