"""A stamp of another agent on one's own clock, with clocks that are ahead and run at other rates, in virtual time."""

from __future__ import annotations

import pytest
from clocks.pulses import PulseReader, PulseTeller, PulseTold
from seeded import for_each

from pancakes.mesh.memory_network import Quality
from pancakes.packet import Packet
from pancakes.testing import Fleet

LATENCY_S = 0.002
JITTER_S = 0.001


CLOCKS = ((1.0, 0.0, 1.0), (1.0003, 5000.0, 1.0), (0.97, 3.0, 2.0))
"""How fast the clock of the agent that tells runs, how far it is ahead, and how fast its mission goes."""


def check_stamp(case):
    seed, (rate, ahead_s, speed) = case
    with Fleet(seed, Quality(LATENCY_S, JITTER_S)) as fleet:
        fleet.start("a", tasks={"Teller": PulseTeller}, clock_rate=rate, clock_ahead_s=ahead_s, speed=speed)
        fleet.run_for(7.0)
        b = fleet.start("b", tasks={"Reader": PulseReader}, clock_rate=0.9999)
        began_s = b.kernel.mission.host_time(0.0) / 0.9999
        fleet.connect()
        fleet.run_for(60.0)
        heard = [it for it in b.task("Reader").heard if it[2].stamp_s > 0]
        assert len(heard) > 500 * speed
        half_s = (b.agent.mesh.rtt_s("a") or 0.0) / 2
        for now_s, true_s, packet, local, age_s in heard:
            if local is None:
                assert true_s < began_s + 0.4, "the clocks are known once a ping came back"
                continue
            error_s = abs(local.time_s - (packet.body.true_s - began_s) * 0.9999)
            assert error_s <= local.bound_s + 1e-9
            if true_s > began_s + 5.0:
                assert error_s < half_s + 0.0002
            assert age_s == max(0.0, now_s - local.time_s)
            assert abs(age_s - (true_s - packet.body.true_s)) <= local.bound_s + 1e-4


def test_local_time_error_below_half_a_round_trip():
    """test_local_time_full.py has more seeds."""
    for_each([(0, clock) for clock in CLOCKS], check_stamp)


def test_a_packet_of_ones_own_agent_has_its_stamp():
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"Reader": PulseReader})
        fleet.run_for(3.0)
        a.probe.publish("network", PulseTold(3.0))
        fleet.run_for(0.5)
        ((_, _, packet, local, age_s),) = a.task("Reader").heard
        assert (local.time_s, local.bound_s, age_s) == (packet.stamp_s, 0.0, 0.0)


def of(agent, stamp):
    return Packet("network", "test.pulse", f"{agent}/client/Teller", "*", stamp, 1, PulseTold(0.0))


def test_a_packet_whose_time_cannot_be_known_has_none():
    with Fleet() as fleet:
        fleet.start("a", tasks={"Teller": PulseTeller})
        fleet.start("held", hold=True)
        b = fleet.start("b", tasks={"Reader": PulseReader})
        fleet.connect()
        fleet.run_for(2.0)
        reader = b.task("Reader")
        assert reader.local_time(of("a", 1.0)) is not None
        assert reader.local_time(of("a", 0.0)) is None  # its mission was held then
        assert reader.local_time(of("stranger", 1.0)) is None
        assert reader.local_time(of("held", 1.0)) is None
        assert of("a", 1.0).age_s is None  # nobody reads it: this is no turn


def test_a_packet_that_came_along_with_its_task_gets_a_stamp_of_the_agent_that_the_task_is_on_now():
    with Fleet() as fleet:
        fleet.start("a", clock_ahead_s=30.0)
        fleet.run_for(10.0)
        b = fleet.start("b")
        fleet.connect()
        fleet.run_for(1.0)
        a_s, b_s = fleet.agents["a"].kernel.now(), b.kernel.now()
        assert a_s - b_s > 9.0 and b.kernel.restamped("a", a_s) == pytest.approx(b_s, abs=1e-6)
        assert b.kernel.restamped("a", 1.0) == 0.0  # before the mission began here
        assert b.kernel.restamped("stranger", 5.0) == 0.0
        assert b.kernel.restamped("b", 5.0) == 5.0


def test_what_is_known_of_a_clock_outlasts_its_link_and_gets_worse():
    with Fleet() as fleet:
        fleet.start("a", tasks={"Teller": PulseTeller})
        b = fleet.start("b", tasks={"Reader": PulseReader})
        fleet.connect()
        fleet.run_for(20.0)
        reader = b.task("Reader")
        fleet.network.partition(["a"], ["b"])
        fleet.run_for(60.0)
        assert b.agent.mesh.neighbours() == []
        soon, late = (reader.local_time(of("a", stamp_s)) for stamp_s in (20.0, 80.0))
        assert (
            soon.time_s == pytest.approx(20.0 - b.kernel.mission.host_time(0.0), abs=1e-6)
            and soon.bound_s < late.bound_s < 0.01
        )


def test_a_peer_that_was_started_again_is_measured_anew_and_its_old_stamps_are_not_believed():
    with Fleet() as fleet:
        fleet.start("a", tasks={"Teller": PulseTeller})
        b = fleet.start("b", tasks={"Reader": PulseReader})
        fleet.connect()
        fleet.run_for(20.0)
        fleet.crash("a")
        fleet.run_for(5.0)
        fleet.restart("a")
        fleet.connect()
        fleet.run_for(1.0)
        found = b.agent.mesh.clocks.clock_of("a")
        began_s = fleet.agents["a"].kernel.mission.host_time(0.0)
        local = b.task("Reader").local_time(of("a", 0.5))
        assert local.time_s == pytest.approx(began_s + 0.5 - b.kernel.mission.host_time(0.0), abs=1e-6)
        assert found is not None and found.timebase.began_s == pytest.approx(began_s, abs=0.001)


def test_a_held_mission_is_told_once_it_begins():
    with Fleet() as fleet:
        a = fleet.start("a", hold=True)
        b = fleet.start("b", tasks={"Reader": PulseReader})
        fleet.connect()
        fleet.run_for(1.0)
        assert b.task("Reader").local_time(of("a", 1.0)) is None
        a.kernel.begin(2.0)
        fleet.run_for(0.1)
        local = b.task("Reader").local_time(of("a", 1.0))
        assert local.time_s == pytest.approx(b.kernel.now() - 0.1 + 2.0 + 1.0, abs=1e-6)


def test_the_links_of_an_agent_say_how_clocks_stand():
    with Fleet() as fleet:
        a = fleet.start("a", clock_rate=1.02, clock_ahead_s=30.0)
        b = fleet.start("b")
        fleet.connect()
        fleet.run_for(60.0)
        (row,) = b.agent.mesh.links()
        clock = row["clock"]
        assert clock["drift"] == pytest.approx(0.02, abs=1e-4)
        assert clock["offset_s"] == pytest.approx(30.0 + 0.02 * fleet.now(), abs=0.002)
        assert clock["mission_ahead_s"] == pytest.approx(a.kernel.mission.now() - b.kernel.mission.now(), abs=0.002)
        assert clock["day_ahead_s"] is None  # in virtual time there is no day


def test_an_idle_link_carries_about_as_much_as_without_clocks():
    """Of the two figures one is that of an earlier version: 2.1 pings a second, and as many answers."""
    with Fleet() as fleet:
        silent = {"network": {"settings": {"discovery_hz": 0.0}}}
        a = fleet.start("a", services=silent)
        fleet.start("b", services=silent)
        fleet.connect()
        fleet.run_for(30.0)
        before = a.agent.mesh.links()[0]["bytes_out"] + a.agent.mesh.links()[0]["bytes_in"]
        fleet.run_for(100.0)
        after = a.agent.mesh.links()[0]["bytes_out"] + a.agent.mesh.links()[0]["bytes_in"]
        assert (after - before) / 100.0 < 60.0
