"""Explaining commands to actuators: any command of the last minutes, by its moment or step by step."""

from __future__ import annotations

from typing import Any

import pytest

from pancakes.devices import Twist
from pancakes.packet import Packet
from pancakes.recording.causal_chains import ActuatorCommand, Chain, ChainStep
from pancakes.tools.web.command_causes import FEW, CommandExplainer

S = 1_000_000_000


def command(t: float, number: int, took_ms: float = 6.0, type_: str = "motors", caused: bool = True) -> Any:
    """Return a command on the agent `a` that answers a pose of another agent, and when it was given."""
    begun_ns = round(t * S - took_ms * 1e6)
    sent = Packet("system", "pose", "world/client/Capture", "", t - 0.006, number, None)
    read = Packet("system", "pose", "a/device/pose", "", t - 0.002, number, None)
    given = Packet("ctrl", type_, "a/client/T", "", t, number, Twist(0.1, 0.2))
    steps = [
        ChainStep(sent, begun_ns, 0.003, 0.001),
        ChainStep(read, begun_ns + 4_000_000, 0.0, took_ms / 1e3 - 0.004),
        ChainStep(given, round(t * S), 0.0, 0.0),
    ]
    return t, ActuatorCommand(round(t * S), given, Chain(tuple(steps if caused else steps[-1:])))


@pytest.fixture
def explaining() -> CommandExplainer:
    """Ten commands, one a second from 11 s on; each takes 2 ms longer than the one before."""
    explaining = CommandExplainer()
    explaining.add(command(10.0 + number, number, 4.0 + 2.0 * number) for number in range(1, 11))
    return explaining


def found(explaining: CommandExplainer, **asked: Any) -> dict[str, Any]:
    explained = explaining.explain("a", **asked)
    assert explained is not None
    return explained


def test_newest_command_has_its_chain(explaining: CommandExplainer):
    newest = found(explaining)

    assert (newest["type"], newest["source"], newest["seq"]) == ("motors", "a/client/T", 10)
    assert (newest["t"], newest["mission_s"], newest["place"], newest["count"]) == (20.0, 20.0, 10, 10)
    assert [step["source"] for step in newest["steps"]] == ["world/client/Capture", "a/device/pose", "a/client/T"]
    assert [step["at_ms"] for step in newest["steps"]] == [0.0, 4.0, 24.0]
    assert [step["travel_ms"] for step in newest["steps"]] == [3.0, 0.0, 0.0]
    assert [step["handling_ms"] for step in newest["steps"]] == [1.0, 20.0, 0.0]
    assert newest["steps"][-1]["body"] == "v_mps 0.1, omega_radps 0.2"


def test_moment_selects_the_command_in_force(explaining: CommandExplainer):
    assert found(explaining, t=15.9)["seq"] == 5
    assert found(explaining, t=16.0)["seq"] == 6
    assert found(explaining, t=99.0)["seq"] == 10
    assert found(explaining, t=1.0)["seq"] == 1, "before all of them it is the first"


def test_step_selects_the_command_before_or_after(explaining: CommandExplainer):
    explaining.add([command(21.0, 11)])

    assert found(explaining, command=("a/client/T", 5), step=-1)["seq"] == 4
    assert found(explaining, command=("a/client/T", 5), step=1)["seq"] == 6
    assert found(explaining, command=("a/client/T", 1), step=-1)["seq"] == 1
    assert found(explaining, command=("a/client/T", 11), step=1)["seq"] == 11


def test_distribution_of_alike_commands(explaining: CommandExplainer):
    alike = found(explaining, t=11.0)["alike"]

    assert (alike["count"], alike["p50_ms"], alike["p90_ms"], alike["max_ms"]) == (10, 16.0, 24.0, 24.0)
    assert (alike["from_ms"], alike["to_ms"], sum(alike["bars"])) == (6.0, 24.0, 10)


def test_command_of_a_timer_has_no_distribution(explaining: CommandExplainer):
    explaining.add([command(30.0, 12, caused=False)])

    assert found(explaining)["alike"] is None
    assert len(found(explaining)["steps"]) == 1


def test_actuators_have_separate_commands(explaining: CommandExplainer):
    assert explaining.add([command(15.5, 1, type_="gripper")]) == {"a"}
    assert explaining.add([command(16.5, 2, type_="gripper")]) == set()

    assert explaining.actuators("a") == ["gripper", "motors"]
    assert found(explaining, t=15.9)["type"] == "gripper", "it was commanded last until then"
    assert found(explaining, t=15.9, type_="motors")["seq"] == 5
    assert found(explaining)["actuators"] == ["gripper", "motors"]


def test_commands_out_of_order_are_sorted(explaining: CommandExplainer):
    explaining.add([command(15.5, 77)])

    assert found(explaining, t=15.6)["seq"] == 77
    assert found(explaining, command=("a/client/T", 77), step=1)["seq"] == 6


def test_agent_without_commands_has_no_chain(explaining: CommandExplainer):
    assert explaining.explain("b") is None
    assert explaining.explain("a", "gripper") is None


def test_oldest_commands_are_dropped_at_the_limit():
    explaining = CommandExplainer(most=0)
    explaining.add(command(float(number), number) for number in range(1, 1001))

    assert FEW <= found(explaining)["count"] <= 1.25 * FEW
    assert found(explaining, t=1.0)["seq"] > 1
    assert found(explaining)["alike"]["count"] == 1000
