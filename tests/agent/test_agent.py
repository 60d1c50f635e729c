"""An agent put together from its configuration: what runs, in which order, and how it ends."""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import pytest
from cli.processes import INSECURE

from pancakes.agent.agent import Agent
from pancakes.config import parse
from pancakes.config.state_dir import default_state_dir
from pancakes.control import Describe
from pancakes.devices import Load, Pose
from pancakes.errors import PancakesError
from pancakes.events import Event
from pancakes.mesh.event_loop import Loop
from pancakes.mesh.memory_network import Quality
from pancakes.mesh.tcp import TcpTransport
from pancakes.security.keys import Keys
from pancakes.service import Service
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, assert_published, config_of, no_thread_left, registered, threaded_agent


class Chatty(Task):
    """Say a random number ten times a second, to everybody."""

    @dataclass
    class Settings:
        factor: float = 1.0

    @every(hz=10)
    def chat(self, tick):
        self.publish("system", Load(self.settings.factor * self.random.random()))
        self.publish("system", Pose(tick.time_s, 0.0, 0.0), to="*")

    @on("system", Pose)
    def hear(self, packet):
        self.event("heard", x_m=packet.body.x_m, of=packet.source)


TOML = """
schema = 1
[agent]
name = "a"
listen = "tcp://a:7400"
seed = 7

[channel.map]

[device.pose]
driver = "static.pose"
rate_hz = 2
settings = { x_m = 1.0, y_m = 2.0 }

[service.log]
settings = { console = false }

[service.network]
settings = { insecure = true }

[task.Chatty]
type = "test.Chatty"
rate_hz = 5
settings = { factor = 100.0 }
"""


def test_an_agent_is_what_its_file_says():
    with Fleet(classes={"test.Chatty": Chatty}) as fleet:
        agent = fleet.start("a", TOML)
        assert agent.kernel.stream.channels()[-1] == "map"
        fleet.run_for(2.0)
        assert len(agent.probe.packets(Load)) == 10
        assert max(packet.body.cpu for packet in agent.probe.packets(Load)) > 1.0
        assert_published(agent, Pose, lambda pose: (pose.x_m, pose.y_m) == (1.0, 2.0), source="a/device/pose")


def test_services_start_in_order_log_first_and_stop_last():
    class Own(Service):
        pass

    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Chatty": Chatty}, services={"own": Own})
        order = ["log", "device", "network", "client", "own"]
        assert [event["service"] for event in agent.events("service_started")] == order
        assert agent.events()[-1]["kind"] == "ready"
        probe = agent.probe
        fleet.stop("a")
        stopped = [
            packet.body.fields["service"] for packet in probe.packets(Event, lambda e: e.kind == "service_stopped")
        ]
        assert stopped == order[::-1]


def run(order, **others):
    """All that is published on two agents in 5 s of virtual time."""
    with Fleet(order, Quality(0.01, 0.01)) as fleet:
        for name in ("a", "b"):
            fleet.start(name, tasks={"Chatty": Chatty}, **others)
        fleet.run_for(5.0)
        return [str(packet) for agent in fleet.agents.values() for packet in agent.probe.packets()]


def test_the_same_seed_gives_the_same_packets_in_the_same_order():
    first = run(1)
    assert len(first) > 200
    assert run(1) == first
    assert run(2) != first
    assert run(1, seed=5) != first


def test_what_is_wrong_with_one_plug_in_is_told_and_the_rest_runs():
    with Fleet() as fleet:
        text = '[task.Bad]\ntype = "test.Chaty"\n[device.bad]\ndriver = "nul.motors"\n'
        agent = fleet.start("a", text, tasks={"Chatty": Chatty})
        assert agent.running() == ["Chatty"]
        errors = agent.lines("error")
        assert any("the task Bad does not run" in line and "did you mean 'test.Chatty'?" in line for line in errors)
        assert any("the device bad does not run" in line and "did you mean 'null.motors'?" in line for line in errors)
        assert agent.agent.skipped == errors


def test_an_address_in_use_is_a_sentence_and_leaves_nothing_behind():
    with Fleet() as fleet:
        fleet.start("a")
        with pytest.raises(PancakesError, match="cannot listen at tcp://a:7400"):
            fleet.start("b", listen="tcp://a:7400")
        # Its journal is free again.
        fleet.start("b")
        fleet.connect()


def test_a_port_in_use_on_threads_leaves_no_thread(tmp_path):
    with no_thread_left(), threaded_agent("a", INSECURE, listen="tcp://127.0.0.1:0") as agent:
        address = agent.agent.mesh.listen[-1]
        config = config_of("b", INSECURE, listen=address, state_dir=str(tmp_path))
        with no_thread_left():
            second = Agent(config)
            with pytest.raises(PancakesError, match="address already in use"):
                second.start()


def test_the_settings_of_a_transport_reach_it(tmp_path):
    class Noted(TcpTransport):
        made_with: ClassVar[list[TcpTransport.Settings]] = []

        def __init__(self, loop: Loop, settings: TcpTransport.Settings, keys: Keys | None) -> None:
            self.made_with.append(settings)
            super().__init__(loop, settings, keys)

    text = "[service.network]\nsettings = { insecure = true, transports = { noted = { dial_s = 2.5 } } }\n"
    config = config_of("a", text, peers=["noted:///run/b"], state_dir=str(tmp_path))
    agent = Agent(config, registered({}, {("pancakes.transports", "noted"): Noted}))
    agent.start()
    agent.stop()
    assert Noted.made_with == [TcpTransport.Settings(dial_s=2.5, insecure=True)]


def test_of_two_agents_of_one_name_the_newcomer_says_so_and_runs_on_without_links():
    with Fleet(1) as fleet:
        fleet.start("b")
        fleet.start("a")
        fleet.connect()
        other = Fleet(9)
        other.dispatcher, other.network = fleet.dispatcher, fleet.network
        config = config_of("a", listen=("local://elsewhere", "tcp://elsewhere:7400"), peers=("tcp://b:7400",))
        newcomer = other.start_config(config, settle=False, probe=False).agent
        said: list[str] = []
        newcomer.kernel.stream.tap("log", lambda packet: said.append(str(packet.body)))
        fleet.run_for(15.0)
        assert any("the name a is already taken by another agent" in line for line in said)
        assert newcomer.fatal == "" and newcomer.mesh.neighbours() == []
        assert fleet.agents["a"].agent.fatal == "" and fleet.agents["a"].agent.mesh.neighbours() == ["b"]
        other.close()


def test_a_task_agent_and_a_client_differ_in_what_they_keep(tmp_path):
    with threaded_agent("a", state_dir=tmp_path / "a"):
        assert (tmp_path / "a").exists()
    with threaded_agent("w", state_dir=tmp_path / "w", role="environment"):
        assert not (tmp_path / "w").exists()


def test_where_an_agent_keeps_its_state_if_nobody_says(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_state_dir("default", "a") == tmp_path / "pancakes" / "default" / "a"


def test_a_second_stop_does_nothing_and_a_crash_is_for_virtual_time():
    with no_thread_left(), threaded_agent("a", tasks={"Chatty": Chatty}) as agent:
        with pytest.raises(RuntimeError, match="does not run in virtual time"):
            agent.agent.crash()
        agent.stop()
        agent.stop()


def test_an_agent_that_crashed_says_and_does_nothing_more():
    with Fleet(3) as fleet:
        agent = fleet.start("a", tasks={"Chatty": Chatty})
        other = fleet.start("b", tasks={"Chatty": Chatty})
        fleet.connect()
        fleet.run_for(1.0)
        heard = len(agent.probe.packets())
        fleet.crash("a")
        fleet.run_for(3.0)
        assert len(agent.probe.packets()) == heard
        other.wait_for_event("peer_down", peer="a")
        fleet.restart("a")
        fleet.connect()


def test_the_mission_of_an_agent_may_run_faster_than_its_host():
    with no_thread_left(), threaded_agent("a", tasks={"Chatty": Chatty}, speed=50.0) as agent:
        agent.wait_until(lambda: len(agent.probe.packets(Load)) >= 100)
        stamps = [packet.stamp_s for packet in agent.probe.packets(Load)]
        assert stamps[-1] - stamps[0] > 5.0
        assert agent.ask(Describe()).result["mission_s"] > 5.0


def test_the_same_tasks_talk_over_sockets_as_in_virtual_time():
    start = partial(threaded_agent, tasks={"Chatty": Chatty}, speed=10.0)
    with no_thread_left(), start("a", INSECURE, listen="tcp://127.0.0.1:0") as a:
        with start("b", INSECURE, peers=a.agent.mesh.listen[-1:]) as b:
            a.wait_for_event("heard", of="b/client/Chatty")
            b.wait_for_event("heard", of="a/client/Chatty")
            assert b.ask(Describe("Chatty"), to="a").result["agent"] == "a"


def test_plugins_registered_in_code_hide_none_that_are_installed():
    plugins = registered({"test.Chatty": Chatty})
    assert plugins.get("pancakes.tasks", "test.Chatty") is Chatty
    assert "null.motors" in plugins.names("pancakes.drivers")
    with pytest.raises(TypeError, match="int is no task, service, driver, filter or cost function"):
        registered({"test.int": int})


def test_a_configuration_without_a_seed_draws_one():
    config = parse(
        'schema = 1\n[agent]\nname = "a"\nrole = "client"\n[service.log]\nsettings = {console = false}\n', "x"
    )
    seeds = []
    for _ in range(2):
        fleet = Fleet(1)
        seeds.append(fleet.start_config(config, settle=False, probe=False).kernel.seed)
        fleet.close()
    assert seeds[0] != seeds[1]
