"""What tests of tasks, services and drivers need: agents made in code, virtual time, faults, and a probe that listens.

    from pancakes.testing import assert_published

    class Blink(Task):
        @every(hz=2)
        def blink(self, tick):
            self.publish("system", Load(0.5))

    def test_it_blinks_twice_a_second(virtual_agent):
        agent = virtual_agent(tasks={"Blink": Blink})
        assert_published(agent, Load, times=20, within_s=10.0)
        assert agent.ask(Stop("Blink")).ok

pytest finds `pancakes.pytest_plugin` by entry point: its fixtures (docs/testing.md) are there wherever Pancakes is
installed. All that they use can be had without pytest too: `FleetInTest` runs any number of
agents in virtual time, on one thread; `threaded_agent` runs one as it runs on a robot. Both hand out an `AgentInTest`,
so a test may be written once for both. Nothing here sleeps, and no shipped module imports this one.
"""

from pancakes.mesh.net.memory import Quality
from pancakes.runtime.clock import VirtualClock
from pancakes.simulation.faults import Faults
from pancakes.simulation.made_in_code import config_of, registered
from pancakes.simulation.probe import Probe
from pancakes.testing.agent_in_test import AgentInTest, threaded_agent
from pancakes.testing.fleet_in_test import FleetInTest
from pancakes.testing.leaks import no_leak, no_thread_left
from pancakes.testing.published import assert_published

__all__ = [
    "AgentInTest",
    "Faults",
    "FleetInTest",
    "Probe",
    "Quality",
    "VirtualClock",
    "assert_published",
    "config_of",
    "no_leak",
    "no_thread_left",
    "registered",
    "threaded_agent",
]
