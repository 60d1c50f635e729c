"""The task that is the simulated world (`sim.world`): it owns the arena, answers the hardware bus, tells the truth.

It runs in an agent of the role `environment`. While the mission waits at 0, so does the world.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from pancakes.bodies.sim.bus import Attach, Attached, Drive, Halt, Reading, Refused, Reply, Request, Sample
from pancakes.bodies.sim.bus_server import BusServer
from pancakes.bodies.sim.drive import Wheels
from pancakes.bodies.sim.physics import EARLY_S, STEP_S, Physics
from pancakes.bodies.sim.quantities import Positive
from pancakes.bodies.sim.settings import ContentSettings
from pancakes.bodies.sim.state import WorldState
from pancakes.errors import PancakesError
from pancakes.packet import SYSTEM
from pancakes.task import Task, Tick, every


class World(Task):
    """The simulated world.

    Publishes a `world_state` packet on `system` at exact multiples of its period in mission time, and the events
    `collision` and `out_of_bounds` on `log`.
    """

    @dataclass
    class Settings(ContentSettings):
        """The contents of the world, and its address. The contents are read once, when the task starts.

        Attributes:
            bus: address at which simulated devices reach it.
            state_hz: how often it publishes its state; a period must be a whole number of steps of 10 ms.
        """

        bus: str = "tcp://127.0.0.1:7499"
        state_hz: Positive = 20.0

        def __post_init__(self) -> None:
            ContentSettings.__post_init__(self)
            steps = 1.0 / (self.state_hz * STEP_S)
            if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
                raise ValueError(f"state_hz = {self.state_hz} gives a period that is no whole number of {STEP_S} s")

    settings: Settings
    _server: BusServer | None = None

    def on_start(self) -> None:
        self._simulation = Physics(self.settings, self.random)
        self._state_steps = round(1.0 / (self.settings.state_hz * STEP_S))
        self._next_state_step = 0
        self._advanced_s = -1.0
        self._server = BusServer(self.kernel.transport, self.call, self._serve, self.log)
        address = self._server.listen(self.settings.bus)
        self.log("info", f"the hardware bus listens at {address}")

    def on_stop(self) -> None:
        if self._server is not None:
            self._server.close()

    def on_failure(self, *error: Any) -> None:
        self.on_stop()

    def on_settings(self) -> None:
        self.log("warning", "a world that runs keeps its contents: its new settings count from its next start")

    def truth(self) -> WorldState:
        """Returns what all bodies do, as of the newest step. To be read between two turns, in virtual time."""
        return self._simulation.state()

    def initial_period_s(self, method: str, period_s: float) -> float:
        # Exactly when a state is due. A request in between lets the world go on to its moment.
        return super().initial_period_s(method, 1.0 / self.settings.state_hz)

    @every(hz=20)
    def advance(self, tick: Tick) -> None:
        """Goes on to the present."""
        self._advance()

    def _advance(self) -> None:
        now = self.kernel.now  # not `self.now`, which only calls it: each request asks
        now_s = now()
        if now_s == self._advanced_s:
            return  # several ask at one moment, in virtual time nearly always
        self._advanced_s = now_s
        while self._next_state_step * STEP_S <= now_s + EARLY_S:
            self._simulation.advance(self._next_state_step * STEP_S)
            self.publish(SYSTEM, self._simulation.state())
            self._next_state_step += self._state_steps
        self._simulation.advance(now_s)
        for happening in self._simulation.take_happenings():
            fields = asdict(happening)
            self.event(fields.pop("kind"), **{**fields, "names": list(happening.names)})

    def _serve(self, request: Request) -> Reply | None:
        """Answers a request of a simulated device, at the world's present."""
        self._advance()
        simulation = self._simulation
        try:
            if type(request) is Sample:  # before the others: most of all are
                if request.packets_sent is not None:
                    simulation.packets_sent(request.body, request.packets_sent)
                if request.listening is not None:
                    simulation.listens(request.body, request.listening)
                return Reading(request.device, request.type, simulation.sample(request.body, request.type))
            match request:
                case Drive():
                    wheels = Wheels(request.left_mps, request.right_mps)
                    simulation.drive(request.body, wheels, request.ttl_s, request.source)
                case Attach():
                    simulation.check(request.body, request.type, request.model)
                    return Attached(request.device)
                case Halt():
                    simulation.hold(request.body)
        except PancakesError as error:
            return Refused(request.device, str(error))
        return None
