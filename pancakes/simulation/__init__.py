"""Agents and their world in virtual time, as a library (docs/simulation.md).

    from pancakes.simulation import Simulation

    with Simulation.of_demo("encirclement") as simulation:
        simulation.reset(seed=7)
        simulation.step(60.0)
        print(simulation.body("agent1"), simulation.where("ScanTarget"))

Nothing here sleeps, and nothing takes the time of the machine.
"""

from typing import TYPE_CHECKING, Any

from pancakes.mesh.memory_network import Quality
from pancakes.simulation.agent_handle import AgentHandle, NotInTimeError, Probe, SimulationError
from pancakes.simulation.fleet import Faults, Fleet

if TYPE_CHECKING:
    from pancakes.simulation.simulation import Simulation

__all__ = ["AgentHandle", "Faults", "Fleet", "NotInTimeError", "Probe", "Quality", "Simulation", "SimulationError"]


def __getattr__(name: str) -> Any:
    """Import the simulated world, and pymunk with it, only for programs that use it: a fleet needs neither."""
    if name == "Simulation":
        from pancakes.simulation.simulation import Simulation

        return Simulation
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
