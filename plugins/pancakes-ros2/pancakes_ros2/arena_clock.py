"""The mission time of a simulation in another process of the same machine."""

from __future__ import annotations

import msgspec


class Beginning(msgspec.Struct, frozen=True):
    """When a mission's time was what, by the monotonic clock that the processes of a machine share.

    Attributes:
        mission_s: mission time.
        host_s: the machine's time then.
        speed: mission seconds for each second of the machine.
    """

    mission_s: float
    host_s: float
    speed: float

    def mission_at(self, host_s: float) -> float:
        """Returns the mission time at a time of the machine."""
        return max(0.0, self.mission_s + self.speed * (host_s - self.host_s))
