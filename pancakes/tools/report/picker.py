"""Make the picker of a report: a person picks any command and sees its chain, with its data and script in the page."""

from __future__ import annotations

import json
from html import escape
from importlib import resources
from string import Template
from typing import Any, Final

from pancakes.tools.report.command_latency import PickedCommand, PickedCommands, Reaction, Reactions


def static_text(name: str) -> str:
    """Return the text of a file in `static`."""
    return resources.files("pancakes.tools.report").joinpath("static", name).read_text(encoding="utf-8")


SLOWEST: Final = 5
"""How many of the slowest commands to each actuator are shown even without scripts."""


def picker_html(found: Reactions) -> str:
    """Return the picker with its data and its script, and tables of the slowest commands."""
    picked = found.picked
    data = picked.plain()
    by_steps = {it.steps: it for it in found.reactions()}
    shapes = (tuple(data["names"][place] for place in kind) for kind in data["kinds"])
    data["distributions"] = [_distribution(by_steps.get(shape)) for shape in shapes]
    # The data must not contain `</script>`.
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    left_out = f" {picked.left_out:,} commands to other actuators are left out." if picked.left_out else ""
    return (
        Template(static_text("picker.html")).substitute(left_out=left_out)
        + _slowest(picked)
        + f'<script type="application/json" id="commands-data">{text}</script>'
        + f"<script>{static_text('picker.js')}</script>"
    )


def _distribution(reaction: Reaction | None) -> dict[str, Any] | None:
    if reaction is None:
        return None
    shares = {name: _ms(value_s) for name, value_s in reaction.latency_s.quantiles().items()}
    return {"count": reaction.count, **shares, "max": _ms(reaction.latency_s.largest)}


def _slowest(picked: PickedCommands) -> str:
    html = ""
    for actuator in picked.actuators():
        rows = "".join(_row(command) for command in actuator.slowest()[:SLOWEST])
        if rows:
            html += (
                f"<details><summary>{escape(actuator.agent)} {escape(actuator.type)}: the slowest of {actuator.count:,}"
                ' commands</summary><div class="wide" tabindex="0"><table><tr><th class="n">mission time [s]</th>'
                f'<th class="n">took</th><th>step by step</th></tr>{rows}</table></div></details>'
            )
    return html


def _row(command: PickedCommand) -> str:
    parts = []
    for step, following in zip(command.steps, (*command.steps[1:], None), strict=True):
        took = f" → {_ms(step.travel_s + step.handling_s)} → " if following is not None else ""
        parts.append(f"{escape(step.name)} #{step.packet.number}{took}")
    took = _ms(command.latency_s)
    return f'<tr><td class="n">{command.mission_s:.3f}</td><td class="n">{took}</td><td>{"".join(parts)}</td></tr>'


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
