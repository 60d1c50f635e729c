"""The packet `world_state`: the true position, speed and battery of each body of the simulated world.

The task `sim.world` publishes it to the tasks of its own agent. Kept apart from the physics, which imports pymunk:
every agent that loads packet types imports this module.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

import msgspec

from pancakes.packet import packet_type

Name: TypeAlias = Annotated[str, msgspec.Meta(max_length=64)]
"""A name that a configuration may give a body. As it is short, no packet with it is searched for large values."""
Address: TypeAlias = Annotated[str, msgspec.Meta(max_length=256)]
Kind: TypeAlias = Literal["robot", "sensor", "mover"]


class Spent(msgspec.Struct, frozen=True):
    """What a battery has given since the world began, in joules.

    Attributes:
        idle_j: to the electronics.
        motion_j: to the wheels.
        sensing_j: for readings.
        listening_j: to a radio that listens.
        sending_j: for mission packets.
    """

    idle_j: float
    motion_j: float
    sensing_j: float
    listening_j: float
    sending_j: float


class BodyState(msgspec.Struct, frozen=True):
    """What one body does.

    Attributes:
        name: what it is called.
        kind: `robot`, `sensor` or `mover`.
        x_m: where it is.
        y_m: where it is.
        theta_rad: its heading, in (-pi, pi].
        v_mps: its speed along its heading.
        omega_radps: its turning rate.
        battery_v: true voltage of its battery; None if it has none.
        driven_by: the task whose command its wheels follow; empty in safe hold.
        spent: what its battery has given; None if it has none.
    """

    name: Name
    kind: Kind
    x_m: float
    y_m: float
    theta_rad: float
    v_mps: float
    omega_radps: float
    battery_v: float | None = None
    driven_by: Address = ""
    spent: Spent | None = None


@packet_type("world_state")
class WorldState(msgspec.Struct, frozen=True):
    """What all bodies do at one moment: robots first, then sensor nodes, then movers, as configured.

    Attributes:
        time_s: mission time of that moment.
        bodies: the bodies.
    """

    time_s: float
    bodies: tuple[BodyState, ...]
