"""Agents and their world in virtual time, as a library (docs/simulation.md).

    from pancakes.simulation import Simulation

    with Simulation.of_demo("encirclement") as simulation:
        simulation.reset(seed=7)
        simulation.step(60.0)
        print(simulation.body("agent1"), simulation.where("ScanTarget"))

Nothing here sleeps, and nothing takes the time of the machine.
"""

from pancakes.fleet import Faults
from pancakes.mesh.memory_network import Quality
from pancakes.simulation.agent_handle import AgentHandle, Probe, SimulationError
from pancakes.simulation.simulation import Simulation

__all__ = ["AgentHandle", "Faults", "Probe", "Quality", "Simulation", "SimulationError"]
