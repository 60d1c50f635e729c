"""The helpers that ship with the library are tested like the rest of it."""

import math
import threading
from dataclasses import dataclass
from functools import partial

import pytest

from pancakes.control import Migrate, Start, Stop
from pancakes.devices import Load
from pancakes.events import LogLine
from pancakes.migration import Cost
from pancakes.task import Task, every
from pancakes.testing import Fleet, Probe, assert_published, config_of, no_thread_left, threaded_agent
from pancakes.util.clock import SkewedClock, VirtualClock


class Blink(Task):
    @every(hz=2)
    def blink(self, tick):
        self.publish("system", Load(tick.time_s))


def test_the_example_of_the_module():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Blink": Blink})
        fleet.run_for(10.0)
        assert len(agent.probe.packets(Load)) == 20
        assert agent.ask(Stop("Blink")).ok


def test_the_same_on_threads():
    with no_thread_left(), threaded_agent(tasks={"Blink": Blink}, speed=100.0) as agent:
        first = agent.wait_for(Load, lambda load: load.cpu >= 5.0)
        assert first.body.cpu >= 5.0
        assert agent.ask(Stop("Blink")).ok


def test_assert_published_tells_what_there_was_instead():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Blink": Blink})
        fleet.run_for(1.0)
        assert assert_published(agent, Load, channel="system").body == Load(1.0)
        assert assert_published(agent.probe, Load, lambda load: load.cpu < 1.0, times=1).body == Load(0.5)
        with pytest.raises(AssertionError, match=r"2 packets of the type 'load' fit, 3 wanted(.|\n)*cpu: 0\.5"):
            assert_published(agent, Load, times=3)
        with pytest.raises(AssertionError, match="0 packets of the type 'line' fit, at least one wanted"):
            assert_published(agent, LogLine, lambda line: line.text == "never said")
        assert_published(agent, Load, source="a/client/Nobody", times=0)


def test_what_does_not_come_fails_with_the_end_of_the_log():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Blink": Blink})
        with pytest.raises(AssertionError, match=r"a: a packet of the type 'line' did not come(.|\n)*ready"):
            agent.wait_for(LogLine, lambda line: line.text == "never said", timeout_s=2.0)
        with pytest.raises(AssertionError, match=r"Blonk does not run on a, only \['Blink'\]"):
            agent.task("Blonk")


def test_a_probe_may_listen_to_some_channels_only_and_forgets_on_demand():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Blink": Blink})
        probe = agent.kernel.spawn(Probe, "a/test/Other", channels=("ctrl",))
        assert isinstance(probe, Probe)
        fleet.run_for(1.0)
        assert probe.packets() == []
        agent.probe.forget()
        fleet.run_for(1.0)
        assert [packet.body.cpu for packet in agent.probe.packets(Load)] == [1.5, 2.0]


def test_a_configuration_is_made_of_text_and_of_classes():
    config = config_of(
        "a",
        '[task.One]\ntype = "x.One"\n',
        tasks={"Two": Blink, "Three": {"type": Blink, "rate_hz": 5.0, "start": False}},
        devices={"motors": "null.motors"},
        speed=4.0,
        fleet="test",
    )
    assert list(config.tasks) == ["One", "Two", "Three"]
    assert (config.tasks["Two"].type, config.tasks["Three"].rate_hz) == ("test.Blink", 5.0)
    assert config.devices["motors"].driver == "null.motors"
    assert (config.clock.speed, config.agent.fleet, config.agent.seed) == (4.0, "test", 1)
    assert config.services["log"].settings == {"console": False}


def test_threads_that_are_left_are_named():
    gate = threading.Event()
    thread = threading.Thread(target=gate.wait, name="forgotten")
    with pytest.raises(AssertionError, match="threads are left: forgotten"), no_thread_left(timeout_s=0.05):
        thread.start()
    gate.set()
    thread.join()


def test_agents_of_a_test_find_each_other():
    with Fleet() as fleet:
        for name in ("a", "b", "c"):
            fleet.start(name)
        fleet.connect()
        assert list(fleet.agents["b"].agent.mesh.connected()) == ["a", "c"]


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1


@pytest.mark.parametrize("calm", [False, True], ids=["its end", "calm"])
def test_a_full_disk_keeps_nothing_until_that_ends(calm):
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Count": Count})
        fleet.run_for(2.0)
        end = fleet.faults.fill_disk("a")
        disk = dict(fleet.disk("a"))
        fleet.run_for(10.0)
        assert fleet.disk("a") == disk
        assert [line for line in agent.lines("error") if "no space left on device" in line]
        if calm:
            fleet.faults.calm()
        else:
            end()
        fleet.run_for(10.0)
        assert fleet.disk("a") != disk


def test_a_slow_disk_takes_its_time_until_all_is_calm():
    def answer_s(agent, body):
        asked_s = fleet.now()
        assert agent.ask(body).ok
        return fleet.now() - asked_s

    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Count": {"type": Count, "start": False}})
        fleet.faults.slow_disk("a", 0.5)
        assert answer_s(agent, Start("Count")) >= 0.5
        fleet.faults.calm()
        assert answer_s(agent, Stop("Count")) < 0.5


class Costly(Cost):
    """Is tried in a fleet without being installed."""

    name = "costly"

    def terms(self, asked):
        return {"costly": 7.0}


def test_a_fleet_may_be_given_cost_functions():
    with Fleet(classes={"costly": Costly}) as fleet:
        agent = fleet.start("a", tasks={"Count": Count})
        fleet.start("b")
        fleet.connect()
        assert agent.ask(Migrate("Count", cost={"costly": 1.0})).ok
        assert agent.events("migration_asked")[0]["cost"] == "1 costly"


@pytest.mark.parametrize("rate", [0.9, 0.99, 1.01, 1.1])
def test_an_agent_may_have_a_clock_that_is_too_fast_or_too_slow_now_and_after_a_restart(rate):
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Blink": Blink}, clock_rate=rate)
        fleet.start("b")
        fleet.connect()
        for _ in range(2):
            before_s, began_s = len(agent.probe.packets(Load)), fleet.now()
            rang: list[float] = []
            agent.kernel.timer.after_host(10.0, partial(note_time, fleet, rang))
            fleet.run_for(100.0)
            assert rang == [pytest.approx(began_s + 10.0 / rate)]
            assert len(agent.probe.packets(Load)) - before_s == pytest.approx(200 * rate, abs=1)
            fleet.crash("a")
            agent = fleet.restart("a")


def note_time(fleet, rang):
    rang.append(fleet.now())


def test_a_clock_of_its_own_says_when_it_will_have_reached_a_time_never_too_early():
    true = VirtualClock()
    for rate in (0.9, 0.99, 1.0, 1.01, 1.1, 1 / 3):
        clock = SkewedClock(true, rate)
        for time_s in (0.1, 0.3, 1.7, 1e3 / 7, 1e6 / 3):
            found_s = clock.true_s(time_s)
            assert found_s * rate >= time_s > math.nextafter(found_s, 0.0) * rate * (1 - 1e-15)
    with pytest.raises(ValueError, match="a clock cannot run at 0 times the true rate"):
        SkewedClock(true, 0)
