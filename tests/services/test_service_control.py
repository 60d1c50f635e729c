"""Services: found by their plug-in, stood by, and stopped and started by packets; the agent that they make up."""

import threading
from dataclasses import dataclass

import pytest
from services.counting import Count

from pancakes.control import Begin, Configure, Describe, Follow, Migrate, Reschedule, Restart, Start, Stop, Unfollow
from pancakes.devices import Load, Pose
from pancakes.errors import PancakesError
from pancakes.events import LogLine
from pancakes.kernel.handlers import on
from pancakes.packet import SYSCTRL
from pancakes.service import Service
from pancakes.task import Task, TaskSpec
from pancakes.testing import Fleet, Probe, assert_published, no_thread_left, threaded_agent


def said(reply):
    """What a reply says, apart from its number."""
    return reply.ok, reply.reason, reply.result


class Mapper(Service):
    """A user's own service: it has settings, a channel and a task of its own, and a weakness."""

    @dataclass
    class Settings:
        cells: int = 10
        fail_at_start: bool = False

    def own_tasks(self):
        return [TaskSpec("Cells", Count, settings={})]

    def on_start(self):
        if self.settings.fail_at_start:
            raise RuntimeError("no map")
        self.open_channel("map")

    @on("system", Pose)
    def pose(self, packet):
        if packet.body.x_m < 0:
            raise RuntimeError("off the map")


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.mapper": Mapper}) as made:
        yield made


def with_mapper(fleet, **settings):
    mapper = {"type": "test.mapper", "settings": settings, "restart": {"at_most": 2, "within_s": 5}}
    return fleet.start("a", tasks={"Count": {"type": Count, "service": "mapper"}}, services={"mapper": mapper})


def states(agent):
    return {service["service"]: service["state"] for service in agent.ask(Describe()).result["services"]}


def test_an_agent_has_the_four_services_of_the_paper_and_the_users_own(fleet):
    agent = with_mapper(fleet, cells=3)
    assert states(agent) == dict.fromkeys(["log", "device", "network", "client", "mapper"], "running")
    assert agent.component("mapper").facade.settings.cells == 3
    assert agent.running("mapper") == ["Cells", "Count"]
    assert "map" in agent.kernel.stream.channels()


def test_describe_tells_what_an_agent_is_and_runs(fleet):
    agent = with_mapper(fleet)
    told = agent.ask(Describe()).result
    assert (told["agent"], told["role"], told["ready"], told["held"]) == ("a", "agent", True, False)
    tasks = {task["task"]: task for task in told["tasks"]}
    assert tasks["Count"]["service"] == "mapper" and tasks["Count"]["rate_hz"] == 10.0
    assert [task["task"] for task in agent.ask(Describe("mapper")).result] == ["Cells", "Count"]
    assert agent.ask(Describe("mapper/Count")).result["state"] == "running"


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("Cuont", "a has no task or service 'Cuont', did you mean 'Count'?"),
        ("mpaper", "a has no task or service 'mpaper', did you mean 'mapper'?"),
        ("xyz", "a has no task or service 'xyz'"),
        ("mapper/Xyz", "a/mapper has no task 'Xyz', only Cells, Count"),
        ("maps/Count", "a has no service 'maps', only log, device, network, client, mapper"),
        ("a/b/c/d", "'a/b/c/d' is no target: it must read task, service/task or service"),
        ("", "'' is no target: it must read task, service/task or service"),
    ],
)
def test_a_target_that_is_none_gets_a_sentence(fleet, target, reason):
    assert said(with_mapper(fleet).ask(Stop(target))) == (False, reason, None)


def test_a_task_may_be_named_by_its_whole_address(fleet):
    agent = with_mapper(fleet)
    assert agent.ask(Stop("a/mapper/Count")).ok
    assert agent.ask(Start("mapper/Count")).ok


def test_a_name_that_two_services_have_must_be_said_in_full(fleet):
    agent = fleet.start("a", tasks={"Cells": Count}, services={"mapper": {"type": "test.mapper"}})
    assert said(agent.ask(Stop("Cells"))) == (False, "a has 'Cells' in client and in mapper: say which", None)
    assert agent.ask(Stop("client/Cells")).ok
    assert agent.running("mapper") == ["Cells"]


@pytest.mark.parametrize("body", [Reschedule("mapper", 1.0), Configure("mapper", {}), Migrate("mapper")])
def test_what_is_for_tasks_is_refused_for_a_service(fleet, body):
    assert said(with_mapper(fleet).ask(body)) == (False, "a/mapper is a service: name one of its tasks", None)


def test_what_a_service_of_its_own_looks_after_cannot_move(fleet):
    reason = "a/mapper/Count cannot move: what a/mapper looks after stays with its agent"
    assert said(with_mapper(fleet).ask(Migrate("mapper/Count"))) == (False, reason, None)


def test_a_service_is_stopped_with_its_tasks_last_first_and_started_with_them(fleet):
    agent = with_mapper(fleet)
    fleet.run_for(1.0)
    agent.probe.forget()
    assert said(agent.ask(Stop("mapper"))) == (True, "", None)
    assert [event["task"] for event in agent.events("task_stopped")] == ["Count", "Cells"]
    assert states(agent)["mapper"] == "stopped"
    assert said(agent.ask(Stop("Count"))) == (False, "a/mapper is stopped, and Count with it", None)
    assert said(agent.ask(Stop("mapper/Count"))) == (False, "a/mapper is stopped", None)
    assert said(agent.ask(Stop("mapper"))) == (False, "a/mapper is stopped, not running", None)
    assert said(agent.ask(Start("mapper"))) == (True, "", None)
    assert agent.running("mapper") == ["Cells", "Count"]
    assert said(agent.ask(Start("mapper"))) == (False, "a/mapper is running already", None)


def test_a_service_is_restarted(fleet):
    agent = with_mapper(fleet)
    first = agent.component("mapper")
    assert agent.ask(Restart("mapper")).ok
    assert agent.component("mapper") is not first
    assert agent.running("mapper") == ["Cells", "Count"]


def test_two_restarts_at_once_are_both_answered(fleet):
    agent = with_mapper(fleet)
    asked = [agent.publish(SYSCTRL, Restart("mapper")) for _ in range(3)]
    assert all(agent.reply_to(packet).reason is not None for packet in asked)
    assert states(agent)["mapper"] == "running"


@pytest.mark.parametrize("service", ["mapper", "log", "network"])
def test_a_service_may_be_stopped_for_a_time_and_wakes_by_itself(fleet, service):
    agent = with_mapper(fleet)
    assert agent.ask(Stop(service, for_s=3.0)).ok
    fleet.run_for(2.9)
    assert states(agent)[service] == "stopped"
    fleet.run_for(0.2)
    assert states(agent)[service] == "running"
    assert agent.events("asked", what="wake", service=service)


@pytest.mark.parametrize("ends", [Stop("client"), Restart("client")])
@pytest.mark.parametrize("asked", [Reschedule("Count", 2.0), Configure("Count", {})])
def test_service_does_what_was_asked_before_its_end(fleet, asked, ends):
    """A command that comes just before the end of a service still finds its tasks running."""
    agent = fleet.start("a", tasks={"Count": {"type": Count}})
    first, second = agent.publish(SYSCTRL, asked), agent.publish(SYSCTRL, ends)
    assert agent.reply_to(first).ok and agent.reply_to(second).ok


def test_a_service_wakes_also_where_to_stop_took_longer_than_it_was_to_sleep(fleet):
    """Its tasks wait for a slow disk, say."""
    agent = with_mapper(fleet)
    service = agent.component("mapper")
    close = service.close
    service.close = lambda then: service.after(2.0, lambda: close(then))
    stopped = agent.publish(SYSCTRL, Stop("mapper", for_s=0.1))
    fleet.run_for(1.0)
    assert states(agent)["mapper"] == "stopping"
    assert agent.reply_to(stopped).ok
    fleet.run_for(0.1)
    assert states(agent)["mapper"] == "running"
    assert agent.events("asked", what="wake", service="mapper")


@pytest.mark.parametrize("for_s", [0.0, -1.0, float("nan"), float("inf")])
def test_no_time_is_no_time(fleet, for_s):
    agent = with_mapper(fleet)
    refused = agent.ask(Stop("mapper", for_s=for_s))
    assert said(refused) == (False, f"a/mapper cannot be stopped for {for_s} s", None)
    assert states(agent)["mapper"] == "running"


def test_who_starts_a_sleeping_service_earlier_is_not_disturbed_by_its_waking(fleet):
    agent = with_mapper(fleet)
    agent.ask(Stop("mapper", for_s=3.0))
    assert agent.ask(Start("mapper")).ok
    first = agent.component("mapper")
    fleet.run_for(5.0)
    assert agent.component("mapper") is first


def test_the_waking_of_a_former_sleep_does_not_end_a_later_stop(fleet):
    """Stopped for 3 s, started, then stopped for good: the first sleep's alarm must not ring."""
    agent = with_mapper(fleet)
    agent.ask(Stop("mapper", for_s=3.0))
    agent.ask(Start("mapper"))
    agent.ask(Stop("mapper"))
    fleet.run_for(9.0)
    assert states(agent)["mapper"] == "stopped"


# Failing -------------------------------------------------------------------------------------------------------


def test_a_service_that_fails_begins_anew_with_its_tasks(fleet):
    agent = with_mapper(fleet)
    fleet.run_for(1.0)
    old = agent.task("Count", "mapper")
    agent.publish("system", Pose(-1.0, 0.0, 0.0))
    fleet.run_for(1.0)
    (failed,) = agent.events("service_failed")
    assert failed["service"] == "mapper" and failed["then"] == "restart" and "off the map" in failed["error"]
    assert agent.running("mapper") == ["Cells", "Count"]
    assert agent.task("Count", "mapper") is not old
    assert not old.actor_ref.is_alive()


def test_a_service_that_fails_too_often_is_given_up_and_may_be_started_again(fleet):
    agent = with_mapper(fleet)
    for _ in range(3):
        agent.publish("system", Pose(-1.0, 0.0, 0.0))
        fleet.run_for(0.2)
    assert [event["then"] for event in agent.events("service_failed")] == ["restart", "restart", "give up"]
    assert states(agent)["mapper"] == "failed"
    assert agent.running("mapper") == []
    assert any("a/mapper is given up" in line for line in agent.lines("error"))
    assert agent.ask(Start("mapper")).ok
    assert agent.running("mapper") == ["Cells", "Count"]


def test_a_service_that_cannot_start_does_not_keep_the_agent_from_getting_ready(fleet):
    agent = with_mapper(fleet, fail_at_start=True)
    assert states(agent)["mapper"] == "restarting"
    assert states(agent)["client"] == "running"
    fleet.run_for(1.0)
    assert states(agent)["mapper"] == "failed"
    refused = agent.ask(Start("mapper"))
    assert not refused.ok and "no map" in refused.reason


def test_bad_settings_of_a_service_are_told_and_the_rest_runs(fleet):
    agent = with_mapper(fleet, cels=3)
    assert states(agent)["mapper"] == "failed"
    assert any("cels: unknown key, did you mean 'cells'?" in line for line in agent.lines("error"))


def test_a_service_whose_plug_in_is_missing_is_named_and_the_rest_runs(fleet):
    agent = fleet.start("a", services={"mapper": {"type": "test.maper"}})
    assert "mapper" not in states(agent)
    assert any("the service mapper does not run" in line and "'test.mapper'" in line for line in agent.lines("error"))


# Following, beginning ------------------------------------------------------------------------------------------


def test_another_agent_follows_a_channel_until_it_has_had_enough(fleet):
    fleet.start("b")
    agent = fleet.start("a")
    fleet.connect()
    assert agent.ask(Follow("system", ("load",)), to="b").ok
    other = fleet.agents["b"]
    other.publish("system", Load(0.5))
    other.publish("system", Pose(0.0, 0.0, 0.0))
    fleet.run_for(0.1)
    assert_published(agent, Load, channel="system", source="b/test/Probe", times=1)
    assert agent.probe.packets(Pose) == []
    assert agent.ask(Unfollow("system"), to="b").ok
    other.publish("system", Load(0.6))
    fleet.run_for(0.1)
    assert_published(agent, Load, times=1)


def test_a_follower_may_ask_for_no_more_than_it_can_show(fleet):
    fleet.start("b")
    agent = fleet.start("a")
    fleet.connect()
    assert agent.ask(Follow("system", most_hz=2.0), to="b").ok
    for number in range(20):
        fleet.agents["b"].publish("system", Load(number / 20))
        fleet.agents["b"].publish("system", Pose(0.0, 0.0, 0.0))
        fleet.run_for(0.1)
    fleet.run_for(0.1)
    assert_published(agent, Load, channel="system", source="b/test/Probe", times=5)
    assert_published(agent, Pose, channel="system", source="b/test/Probe", times=5)
    assert [packet.body.cpu for packet in agent.probe.packets(Load)] == [0.0, 0.25, 0.5, 0.75, 0.95], "the newest ones"
    assert "most_hz must be 0 (all), or 0.001 or more" in agent.ask(Follow("system", most_hz=-1.0), to="b").reason


def test_following_what_is_not_there_or_is_here_is_refused(fleet):
    fleet.start("b")
    agent = fleet.start("a")
    fleet.connect()
    assert "b has no channel 'map'" in agent.ask(Follow("map"), to="b").reason
    assert "it can subscribe to 'system' itself" in agent.ask(Follow("system")).reason


def noting(done, what, function):
    """Returns a function that notes its call, and does the same."""

    def call(*args, **others):
        done.append(what)
        return function(*args, **others)

    return call


def test_an_agent_describes_itself_in_several_turns(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    root, stream, mesh = agent.component("kernel"), agent.kernel.stream, agent.agent.mesh
    done: list[str] = []
    stream.channels = noting(done, "tasks", stream.channels)
    mesh.neighbours = noting(done, "identity", mesh.neighbours)
    root.reply = noting(done, "reply", root.reply)
    root.after_turn = lambda: done.append("end")
    described = agent.ask(Describe()).result
    assert done == ["tasks", "end", "identity", "end", "reply", "end"]
    root.after_turn = None
    assert described == {**root.describe(), "mission_s": described["mission_s"]}


def test_an_agent_of_which_something_cannot_be_told_says_so_and_goes_on(fleet):
    agent = fleet.start("a")
    mesh = agent.agent.mesh

    def fails():
        raise KeyError("rss")

    neighbours, mesh.neighbours = mesh.neighbours, fails
    assert "what a/test/Probe asked for failed: KeyError: 'rss'" in agent.ask(Describe()).reason
    mesh.neighbours = neighbours
    assert agent.ask(Describe()).result["agent"] == "a"


def test_control_from_another_agent_is_answered_there(fleet):
    fleet.start("b", tasks={"Count": Count})
    agent = fleet.start("a")
    fleet.connect()
    assert agent.ask(Reschedule("Count", 2.0), to="b").result["rate_hz"] == 2.0
    assert agent.ask(Stop("network"), to="b").reason.endswith(
        "only for a time (for_s): no packet from elsewhere could start it again"
    )
    reason = agent.ask(Stop("network/NetworkClient"), to="b").reason
    assert (
        reason
        == "b/network/NetworkClient cannot be stopped from elsewhere: no packet from elsewhere could start it again"
    )
    assert agent.ask(Stop("network", for_s=2.0), to="b").ok
    fleet.run_for(1.0)
    assert agent.agent.mesh.connected() == {}
    fleet.connect()


def test_the_mesh_is_told_for_how_long_the_network_sleeps(fleet, monkeypatch):
    agent = fleet.start("a")
    slept: list[float | None] = []
    monkeypatch.setattr(agent.agent.mesh, "sleep", slept.append)
    assert agent.ask(Stop("network", for_s=2.0)).ok
    fleet.run_for(3.0)
    assert agent.ask(Stop("network")).ok
    assert slept == [2.0, None]


@pytest.mark.parametrize("command", [Stop("network", for_s=2.0), Restart("network")])
def test_the_answer_has_left_before_anybody_can_close_the_way_out(fleet, monkeypatch, command):
    """The network service may have its turn, in another thread, before the root's has ended."""
    agent, _ = fleet.start("a"), fleet.start("b")
    fleet.connect()
    network = agent.component("network")
    close, left = network.close, []

    def sent():
        return agent.agent.mesh.describe()["peers"][0]["packets_out"]

    def close_and_look(*arguments):
        left.append(sent())
        close(*arguments)

    monkeypatch.setattr(network, "close", close_and_look)
    asked = fleet.agents["b"].publish(SYSCTRL, command, to="a")
    before = sent()
    assert fleet.agents["b"].reply_to(asked).ok
    assert left == [before + 1]


def test_the_network_does_not_sleep_while_a_task_needs_what_comes_from_elsewhere(fleet):
    class Follower(Task):
        requires = ("pose",)

    agent = fleet.start("a", tasks={"Follower": Follower}, devices={"pose": "network.pose"})
    refused = agent.ask(Stop("network", for_s=2.0))
    assert said(refused) == (False, "a/network must not sleep while a/client/Follower needs pose from elsewhere", None)


def test_a_held_mission_begins_by_a_packet(fleet):
    agent = fleet.start("a", tasks={"Count": Count}, hold=True)
    fleet.run_for(5.0)
    assert agent.task("Count").state.n == 0
    for in_s in (float("nan"), float("inf"), -1.0):
        assert not agent.ask(Begin(in_s)).ok
    assert agent.ask(Begin(1.0)).ok
    fleet.run_for(2.05)
    assert agent.task("Count").state.n == 10


def test_a_task_is_named_with_its_agent_and_its_service_or_without(fleet):
    agent = fleet.start("robot", tasks={"Count": Count})
    for name in ("Count", "client/Count", "robot/Count", "robot/client/Count"):
        assert agent.ask(Describe(name)).result["task"] == "Count", name


def test_the_network_of_an_agent_is_stopped_from_elsewhere_for_a_time_alone(fleet):
    a = fleet.start("a", services={"".join(("net", "work")): {}})
    b = fleet.start("b")
    fleet.connect()
    reason = b.ask(Stop("network"), to="a").reason
    assert reason.startswith(
        "a/network can be stopped from elsewhere only for a time (for_s): no packet from elsewhere"
    )
    assert states(a)["network"] == "running"


def test_who_starts_a_service_of_which_a_task_is_stuck_hears_that_and_it_starts_once_that_has_ended(fleet):
    agent = with_mapper(fleet)
    assert agent.ask(Stop("mapper")).ok
    old, older = (agent.kernel.spawn(Probe, f"a/mapper/{name}") for name in ("Old", "Older"))
    asked_s = fleet.now()
    reply = agent.ask(Start("mapper"))
    assert reply.reason == "a/mapper waits for the end of a/mapper/Old, which is stuck"
    assert 2.0 < fleet.now() - asked_s < 2.1
    assert states(agent)["mapper"] == "starting"
    old.stop()
    fleet.run_for(1.0)
    assert states(agent)["mapper"] == "starting"
    older.stop()
    agent.wait_until(lambda: states(agent)["mapper"] == "running")


# On threads ----------------------------------------------------------------------------------------------------


def test_the_same_on_threads_and_no_thread_is_left():
    mapper = {"type": Mapper, "restart": {"at_most": 2}}
    with no_thread_left(), threaded_agent(tasks={"Count": Count}, services={"mapper": mapper}, speed=20.0) as agent:
        assert agent.ask(Restart("mapper")).ok
        assert agent.ask(Stop("mapper", for_s=1.0)).ok
        agent.wait_for_event("asked", what="wake")
        agent.wait_until(lambda: agent.component("mapper") is not None and agent.running("mapper") == ["Cells"])
        agent.probe.forget()
        agent.publish("system", Pose(-1.0, 0.0, 0.0))
        agent.wait_for_event("service_failed", service="mapper")
        agent.wait_for_event("service_started", service="mapper")


def test_a_stuck_task_does_not_keep_its_agent_from_stopping():
    reached, gate = threading.Event(), threading.Event()

    class Stuck(Task):
        blocking = True

        @on("system", Load)
        def load(self, packet):
            reached.set()
            assert gate.wait(30.0)

    with no_thread_left():
        with threaded_agent(tasks={"Stuck": Stuck, "Count": Count}) as agent:
            agent.publish("system", Load(1.0))
            assert reached.wait(10.0)
            refused = agent.ask(Stop("Stuck"))
            assert not refused.ok and "a/client/Stuck is stuck" in refused.reason
            assert agent.ask(Start("Stuck")).reason == "a/client/Stuck is stuck already"
            assert agent.ask(Configure("Stuck", {})).reason == "a/client/Stuck is stuck, not running"
            with pytest.raises(PancakesError, match="may publish nothing more"):
                agent.task("Stuck").publish("system", Load(2.0))
            assert agent.ask(Stop("Count")).ok
            agent.wait_for(LogLine, lambda line: "is stuck" in line.text)
        gate.set()


def test_a_task_is_not_stopped_for_a_time(fleet):
    agent = with_mapper(fleet)
    assert agent.ask(Stop("Count", for_s=1.0)).reason.endswith("is a task: only a service can be stopped for a time")
    assert agent.running("mapper") == ["Cells", "Count"]
