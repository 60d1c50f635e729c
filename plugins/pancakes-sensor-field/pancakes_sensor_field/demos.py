"""The demo of this distribution, as the launcher finds it by entry point (`pancakes.demos`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pancakes.tools.demo import Demo, Run
from pancakes_sensor_field.verdict import judge_sensor_field

AGENTS: Final = ("field", "gateway", "north", "east", "south", "west")
SIMULATED_LINES: Final = {"shed": "tcp://127.0.0.1:7522", "gate": "tcp://127.0.0.1:7523"}


def arrange(out: Path, live: bool) -> Mapping[str, Sequence[str]]:
    """Return where the tiny nodes are: on a line of only this run, or on simulated lines in virtual time."""
    if live:
        port = out / "state" / "shed.tty"
        return {
            "field": [f'task.TinyNodes.settings.nodes.shed.line="pty:{port}"'],
            "gateway": [f'device.shed_line.settings.port="{port}"'],
        }
    field, gateway = ['task.TinyNodes.type="sensor_field.SimulatedTinyNodes"'], []
    for name, address in SIMULATED_LINES.items():
        number = {"shed": 7, "gate": 9}[name]
        field.append(f'task.TinyNodes.settings.nodes.{name}.line="{address}"')
        gateway.append(f'device.{name}_line.driver="sensor_field.tcp"')
        gateway.append(f'device.{name}_line.settings={{address="{address}", nodes={{{name}={number}}}}}')
    return {"field": field, "gateway": gateway}


def _draw(run: Run, summary: Mapping[str, Any]) -> None:
    from pancakes_sensor_field.figure import draw_sensor_field

    draw_sensor_field(run, summary)


SENSOR_FIELD: Final = Demo(
    name="sensor-field",
    title="a field of sensor nodes, two of them too small for an agent, and an alarm that migrates",
    agents=AGENTS,
    configs=Path(__file__).parent / "configs" / "sensor-field",
    duration_s=240.0,
    judge=judge_sensor_field,
    draw=_draw,
    arrange=arrange,
    records={"Trajectory": "trajectory.csv", "FieldRecord": "field.csv"},
)
