"""Tasks that ask, and tasks that answer: at once, later, after a while, or not as they should."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from msgspec import Struct

from pancakes import (
    Actuator,
    Answer,
    Asked,
    Pending,
    Request,
    RequestError,
    Task,
    Tick,
    answers,
    every,
    on,
    packet_type,
)
from pancakes.packet import task_address

FINDER = task_address("b/Finder")
DRIVER = task_address("b/Driver")


class Position(Struct, frozen=True):
    x_m: float


@packet_type("test.where")
class Where(Request[Position], frozen=True):
    name: str


@packet_type("test.slow_where")
class SlowWhere(Request[Position, float], frozen=True):
    """Is answered after a while, with feedback each second."""

    seconds: int


@packet_type("test.drive")
class Drive(Request[str, float], frozen=True):
    """Is answered later, by a tick, with feedback on each metre."""

    metres: int


@packet_type("test.go")
class Go(Struct, frozen=True):
    """Lets an asker ask."""

    request: str = "Where"
    to: str = FINDER
    value: Any = "cup"
    timeout_s: float = 5.0
    cancel_after_s: float = 0.0


@packet_type("test.give_me")
class GiveMe(Request[str, str], frozen=True):
    """Is answered by so many characters, or has feedback of so many."""

    answer: int = 0
    feedback: int = 0
    refusal: int = 0


KINDS: dict[str, Callable[[Any], Request[Any, Any]]] = {
    "Where": Where,
    "SlowWhere": SlowWhere,
    "Drive": Drive,
    "GiveMe": lambda value: GiveMe(**value),
}


@dataclass
class Heard:
    """What an asker has heard."""

    answers: list[str] = field(default_factory=list)
    feedback: list[float] = field(default_factory=list)
    asked: Asked | None = None


class Finder(Task):
    """Answers at once, or after a while."""

    @dataclass
    class State:
        asked: int = 0
        begun: int = 0
        ended: int = 0
        heard: list[str] = field(default_factory=list)

    @answers(Where)
    def where(self, request: Where) -> Position:
        self.state.asked += 1
        if request.name == "nothing":
            raise RequestError("there is none", "not_found")
        if request.name == "bug":
            raise ZeroDivisionError("by nought")
        return Position(1.5) if request.name != "odd" else 7  # type: ignore[return-value]

    @answers(SlowWhere)
    async def slowly(self, request: SlowWhere, pending: Pending[Position, float]) -> Position:
        self.state.begun += 1
        for second in range(request.seconds):
            await asyncio.sleep(1.0)
            pending.feedback(float(second + 1))
        self.state.ended += 1
        return Position(float(request.seconds))

    @answers(GiveMe)
    async def give(self, request: GiveMe, pending: Pending[str, str]) -> str:
        if request.refusal:
            raise RequestError("n" * request.refusal, "busy")
        if request.feedback:
            pending.feedback("f" * request.feedback)
        return "a" * request.answer

    @on("system", Go, addressed=True)
    def told(self, go: Go) -> None:
        self.state.heard.append(go.request)


class Driver(Task):
    """Works on one request at a time, in its ticks; what it works on is in its state."""

    @dataclass
    class State:
        drive: Pending[str, float] | None = None
        left_m: int = 0
        driven_m: int = 0
        cancelled: int = 0
        late: int = 0

    @answers(Drive)
    def drive(self, request: Drive, pending: Pending[str, float]) -> None:
        if self.state.drive is not None:
            raise RequestError("it drives already", "busy")
        self.state.drive, self.state.left_m = pending, request.metres

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        drive = self.state.drive
        if drive is None:
            return
        self.state.left_m -= 1
        self.state.driven_m += 1
        drive.feedback(float(self.state.driven_m))
        if self.state.left_m <= 0:
            drive.answer(f"there, on {self.agent}")
            self.state.late += drive.answer("a second time")
            self.state.drive = None

    def on_cancel(self, pending: Pending[str, float]) -> None:
        assert not pending.is_open and pending == self.state.drive
        self.state.cancelled += 1
        self.state.drive = None


class Asker(Task):
    """Asks, and has a method that takes the answer."""

    @dataclass
    class State(Heard):
        pass

    @on("system", Go, addressed=True)
    def go(self, go: Go) -> None:
        request = KINDS[go.request](go.value)
        try:
            self.state.asked = self.ask(go.to, request, then=self.answered, timeout_s=go.timeout_s, feedback=self.felt)
        except RequestError as error:
            if error.code != "invalid":
                raise
            self.state.answers.append(said(error))
        if go.cancel_after_s:
            self.after(go.cancel_after_s, self.state.asked.cancel)

    def answered(self, answer: Answer[Any]) -> None:
        self.state.answers.append(said(answer.error) if answer.error else str(answer.result()))

    def felt(self, feedback: float) -> None:
        self.state.feedback.append(feedback)


class Waiter(Task):
    """Asks, and awaits the answer."""

    @dataclass
    class State(Heard):
        pass

    @on("system", Go, addressed=True)
    async def go(self, go: Go) -> None:
        request = KINDS[go.request](go.value)
        try:
            async with asyncio.timeout(go.cancel_after_s or None):
                answer = await self.ask(go.to, request, timeout_s=go.timeout_s, feedback=self.state.feedback.append)
        except RequestError as error:
            self.state.answers.append(said(error))
        except TimeoutError:
            self.state.answers.append("given up")
        else:
            self.state.answers.append(str(answer))


class Both(Waiter):
    """Asks whom it hears from, and is asked by that."""

    @answers(SlowWhere)
    async def slowly(self, request: SlowWhere, pending: Pending[Position, float]) -> Position:
        for second in range(request.seconds):
            await asyncio.sleep(1.0)
            pending.feedback(float(second + 1))
        return Position(2.5)


class Stateless(Task):
    """Asks, and remembers nothing."""

    @on("system", Go, addressed=True)
    def go(self, go: Go) -> None:
        self.ask(go.to, Drive(go.value), then=self.answered, timeout_s=go.timeout_s)

    def answered(self, answer: Answer[str]) -> None:
        self.event("answered", text=answer.result())


class AsksAtStart(Asker):
    """Asks as it starts."""

    def on_start(self) -> None:
        self.ask(FINDER, Where("cup"), then=self.answered)


class Sleeper(Asker):
    """Awaits something else while the answer comes."""

    @on("system", Go, addressed=True)
    async def go(self, go: Go) -> None:  # type: ignore[override]
        super().go(go)
        await asyncio.sleep(8.0)


class Wheels(Actuator):
    """Goes nowhere."""

    type = "motors"

    def open(self) -> None:
        pass

    def write(self, command: Any, ttl_s: float, source: str) -> None:
        pass

    def safe_stop(self) -> None:
        pass


class Wheeled(Driver):
    """Has wheels."""

    requires = ("motors",)


class StatelessSleeper(Stateless):
    """Awaits something else while the answer comes, and remembers nothing."""

    @on("system", Go, addressed=True)
    async def go(self, go: Go) -> None:  # type: ignore[override]
        super().go(go)
        await asyncio.sleep(8.0)


class Deaf(Task):
    """Answers nothing."""


def said(error: RequestError) -> str:
    """Returns an error in a word and a sentence."""
    return f"{type(error).__name__} {error.code}: {error}"
