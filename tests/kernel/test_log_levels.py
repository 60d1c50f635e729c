"""Lines for people: the levels that there are, said as logging has it, and those that there are not."""

from typing import Any

import pytest
from kernel.virtual_rig import VirtualRig

from pancakes.devices.driver import Actuator, Sensor
from pancakes.errors import ClassError, PancakesError
from pancakes.events import LogLine
from pancakes.kernel.actor import ActorCore
from pancakes.service import Service
from pancakes.task import Task


def said(rig: VirtualRig) -> list[tuple[str, str]]:
    rig.settle()
    return [(packet.body.level, packet.body.text) for packet in rig.probe.packets(LogLine)]


def test_lines_are_said_as_logging_has_it() -> None:
    rig = VirtualRig()
    log = rig.source.log
    log.debug("d")
    log.info("100 %")
    log.warning("%s of %d", "one", 2)
    log.error("e")
    log("info", "by its level")
    assert said(rig) == [
        ("debug", "d"),
        ("info", "100 %"),
        ("warning", "one of 2"),
        ("error", "e"),
        ("info", "by its level"),
    ]


def test_a_line_that_is_none_is_said_all_the_same() -> None:
    """As with logging: the mistake costs the line its form, and not the task its life."""
    rig = VirtualRig()
    log: Any = rig.source.log
    log.error(ValueError("no echo"))
    log.info("battery at %d%", 40)
    log.info("%s and %s", "one")
    log("info", 5)
    assert [text for _, text in said(rig)] == ["no echo", "battery at %d% (40,)", "%s and %s ('one',)", "5"]


def test_the_log_may_be_given_to_others() -> None:
    class Opens(Task):
        def on_start(self) -> None:
            self.port = open_port(self.log, "/dev/ttyUSB0")
            self.both = {"log": self.log, "name": "left"}
            self.log(text="t", level="info")

        def reads(self) -> type:
            class Reader:
                def __init__(self) -> None:
                    self.log: dict[str, str] = {}

                def warn(self) -> None:
                    self.log.clear()

            return Reader

    def open_port(*given: object) -> object:
        return given

    assert issubclass(Opens, Task)


def test_an_exception_is_said_with_its_traceback() -> None:
    rig = VirtualRig()
    try:
        raise ValueError("no echo")
    except ValueError:
        rig.source.log.exception("it failed")
    rig.settle()
    (packet,) = rig.probe.packets(LogLine)
    assert (packet.body.level, packet.body.text) == ("error", "it failed")
    assert "ValueError: no echo" in packet.body.traceback


@pytest.mark.parametrize(
    ("level", "hint"),
    [
        ("warn", "did you mean 'warning'?"),
        ("critical", "did you mean 'error'?"),
        ("WARNING", "did you mean 'warning'?"),
        ("loud", "only debug, info, warning, error"),
    ],
)
def test_an_unknown_level_is_refused_with_the_nearest(level: str, hint: str) -> None:
    rig = VirtualRig()
    with pytest.raises(PancakesError) as raised:
        rig.source.log(level, "x")
    assert str(raised.value) == f"the log has no level {level!r}, {hint}"
    assert said(rig) == []


@pytest.mark.parametrize(("name", "meant"), [("warn", "warning"), ("critical", "error")])
def test_a_method_that_the_log_has_not_is_refused_with_the_nearest(name: str, meant: str) -> None:
    with pytest.raises(AttributeError, match=f"the log has no '{name}', did you mean '{meant}'"):
        getattr(VirtualRig().source.log, name)("x")


def in_task(base: type) -> None:
    class Robot(base):
        def on_start(self) -> None:
            if self.kernel is None:
                self.log("warn", "x")


def in_inner_function(base: type) -> None:
    class Robot(base):
        def on_start(self) -> None:
            self.after(1.0, lambda: self.log("critical", f"{self.name}"))


def by_method(base: type) -> None:
    class Robot(base):
        def on_start(self) -> None:
            self.log.warn("x")


def in_context(base: type) -> None:
    class Robot(base):
        def open(self) -> None:
            self.context.log("warn", "x")


def in_context_by_method(base: type) -> None:
    class Robot(base):
        def open(self) -> None:
            self.context.log.fatal("x")


@pytest.mark.parametrize("base", [Task, Service, ActorCore])
@pytest.mark.parametrize("define", [in_task, in_inner_function, by_method])
def test_a_class_that_says_an_unknown_level_is_refused(base: type, define: Any) -> None:
    with pytest.raises(ClassError, match=r"test_log_levels\.py:\d+: .*Robot\.on_start: the log has no level '"):
        define(base)


@pytest.mark.parametrize("base", [Sensor, Actuator])
@pytest.mark.parametrize("define", [in_context, in_context_by_method])
def test_a_driver_that_says_an_unknown_level_is_refused(base: type, define: Any) -> None:
    with pytest.raises(ClassError, match=r"Robot\.open: the log has no level '(warn|fatal)', did you mean"):
        define(base)


def test_what_else_is_called_log_is_left_alone() -> None:
    class Robot(Task):
        def on_start(self) -> None:
            import math

            self.log("info", f"{math.log(2)}")
            self.log.info("warn")
            self.log("info", "warn")
            level = "info" if self.state else "error"
            self.log(level, "critical")
            self.log("warning" if self.state else "error", "critical")

    assert issubclass(Robot, Task)
