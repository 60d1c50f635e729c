"""What type checkers find in a task. If mypy misses an error below, it fails: the `type: ignore` is unused then."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pancakes import SYSTEM, Packet, Task, Tick, every, on
from pancakes.devices import Load, Pose
from pancakes.kernel.handlers import plan_of


@dataclass
class WatchSettings:
    limit: float = 0.8


@dataclass
class WatchState:
    readings: int = 0


class Watch(Task[WatchSettings, WatchState]):
    """Is all right."""

    async def on_start(self) -> None:
        """May be awaited."""

    @on(SYSTEM, Load)
    def packets(self, packet: Packet[Load]) -> None:
        self.state.readings += packet.body.cpu > self.settings.limit

    @on(SYSTEM)
    def bodies(self, pose: Pose) -> None:
        self.publish(SYSTEM, Pose(pose.x_m, pose.y_m, 0.0))

    @on("ctrl")
    async def both(self, load: Load, packet: Packet[Load]) -> None:
        self.log.info(f"{packet.source}: {load.cpu}")

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        self.log.info(f"{tick.time_s}")


if TYPE_CHECKING:

    class Wrong(Task[WatchSettings]):
        """Has errors, each of which is found."""

        @on(SYSTEM, Load)  # type: ignore[arg-type]
        def other_packets(self, packet: Packet[Pose]) -> None: ...

        @on(SYSTEM, Load)  # type: ignore[arg-type]
        def other_bodies(self, pose: Pose) -> None: ...

        @on(Load)  # type: ignore[call-overload]
        def no_channel(self, load: Load) -> None: ...

        @on(SYSTEM, Load)
        def no_field(self, packet: Packet[Load]) -> None:
            self.log.info(f"{packet.body.cpus}")  # type: ignore[attr-defined]
            self.log.info(f"{self.settings.limits}")  # type: ignore[attr-defined]


def test_task_that_type_checkers_accept_runs(virtual_agent):
    assert plan_of(Watch).awaits
    agent = virtual_agent(tasks={"Watch": Watch})
    agent.publish(SYSTEM, Load(0.9))
    agent.wait_until(lambda: agent.task("Watch").state.readings == 1)
