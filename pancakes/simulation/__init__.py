"""Agents and their world in virtual time, as a library (docs/simulation.md).

    from pancakes.simulation import Simulation

    with Simulation.of_demo("encirclement") as simulation:
        simulation.reset(seed=7)
        simulation.step(60.0)
        print(simulation.body("agent1"), simulation.where("ScanTarget"))

Nothing here sleeps, and nothing takes the time of the machine.
"""

from pancakes.mesh.net.memory import Quality
from pancakes.simulation.agent_handle import AgentHandle, SimulationError
from pancakes.simulation.faults import Faults
from pancakes.simulation.probe import Probe
from pancakes.simulation.simulation import Simulation

__all__ = ["AgentHandle", "Faults", "Probe", "Quality", "Simulation", "SimulationError"]
