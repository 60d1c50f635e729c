"""What type checkers find in a task. If mypy or pyright misses an error below, `scripts/check` fails: then the
`type: ignore` is not needed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from pancakes import SYSTEM, Answer, Packet, Pending, Request, Task, Tick, answers, every, on, packet_type
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


class Count(Task[None, WatchState]):
    """Has no settings."""

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        self.state.readings += 1


class Place(Struct, frozen=True):
    x_m: float


@packet_type("test_types.where")
class Where(Request[Place], frozen=True):
    name: str


@packet_type("test_types.drive")
class Drive(Request[str, float], frozen=True):
    metres: float


class Guide(Task):
    """Answers."""

    @answers(Where)
    def where(self, request: Where) -> Place:
        return Place(float(len(request.name)))

    @answers(Drive)
    async def drive(self, request: Drive, pending: Pending[str, float]) -> str:
        pending.feedback(request.metres)
        return "there"


class Tourist(Task):
    """Asks."""

    @every(hz=1)
    async def tick(self, tick: Tick) -> None:
        place = await self.ask("a/client/Guide", Where("cup"))
        self.log.info(f"{place.x_m}")
        asked = self.ask("a/client/Guide", Drive(1.0), then=self.driven, feedback=self.on_the_way)
        self.log.info(f"{asked.seq}")

    def driven(self, answer: Answer[str]) -> None:
        self.log.info(answer.result().upper())

    def on_the_way(self, metres: float) -> None: ...


class Later(Task):
    """Answers in its own time."""

    @answers(Drive)
    def drive(self, request: Drive, pending: Pending[str, float]) -> None:
        pending.answer(f"{request.metres} m")


if TYPE_CHECKING:

    class WrongAnswers(Task):
        """Has errors, each of which is found."""

        @answers(Where)  # type: ignore[arg-type]
        def other_answer(self, request: Where) -> str:
            return request.name

        @answers(Where)  # type: ignore[arg-type]
        def other_request(self, request: Drive) -> Place:
            return Place(request.metres)

        @answers(Where)  # type: ignore[arg-type]
        async def other_awaited(self, request: Where) -> str:
            return request.name

        @answers(Drive)  # type: ignore[arg-type]
        def other_pending(self, request: Drive, pending: Pending[int, int]) -> None: ...

        @answers(Load)  # type: ignore[arg-type]
        def no_request(self, request: Load) -> None: ...

        @answers(Drive)
        def other_values(self, request: Drive, pending: Pending[str, float]) -> None:
            pending.answer(1)  # type: ignore[arg-type]
            pending.feedback("far")  # type: ignore[arg-type]

        @every(hz=1)
        async def wrong(self, tick: Tick) -> None:
            place = await self.ask("a/client/Guide", Where("cup"))
            self.log.info(f"{place.y_m}")  # type: ignore[attr-defined]
            await self.ask("a/client/Guide", Load(1.0))  # type: ignore[call-overload]
            self.ask("a/client/Guide", Drive(1.0), then=self.took_place)  # type: ignore[arg-type]
            self.ask("a/client/Guide", Drive(1.0), then=self.took_text, feedback=self.took_text)  # type: ignore[arg-type]

        def took_place(self, answer: Answer[Place]) -> None: ...

        def took_text(self, answer: Answer[str]) -> None: ...

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


def test_task_that_type_checkers_accept_runs(virtual_agent: Any) -> None:
    assert plan_of(Watch).awaits
    agent = virtual_agent(tasks={"Watch": Watch})
    agent.publish(SYSTEM, Load(0.9))
    agent.wait_until(lambda: agent.task("Watch").state.readings == 1)


def test_tasks_that_ask_and_that_type_checkers_accept_run(virtual_agent: Any) -> None:
    agent = virtual_agent(tasks={"Guide": Guide, "Tourist": Tourist, "Later": Later})
    agent.wait_until(lambda: {"3.0", "THERE"} <= set(agent.lines("info")))
    assert plan_of(Guide).answers == {"test_types.where": "where", "test_types.drive": "drive"}


def test_task_with_a_state_and_no_settings_runs(virtual_agent: Any) -> None:
    agent = virtual_agent(tasks={"Count": Count})
    agent.wait_until(lambda: agent.task("Count").state.readings == 2)
