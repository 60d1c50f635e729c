"""The part of a report's page in which any command can be picked, to see what led to it."""

from __future__ import annotations

import json
from html import escape
from string import Template
from typing import Any, Final

from pancakes.tools.report.picked import PickedCommand, PickedCommands
from pancakes.tools.report.reactions import Reaction, Reactions
from pancakes.tools.report.static_text import static_text

SLOWEST: Final = 5
"""The number of the slowest commands to each actuator that are shown where scripts do not run, too."""


def picker_html(found: Reactions) -> str:
    """Returns the part of the page, with its data and its script. Without scripts the slowest commands are left."""
    picked = found.picked
    data = picked.plain()
    by_steps = {it.steps: it for it in found.reactions()}
    shapes = (tuple(data["names"][place] for place in kind) for kind in data["kinds"])
    data["distributions"] = [_distribution(by_steps.get(shape)) for shape in shapes]
    # Nothing in it may look like the end of the script.
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    left_out = f" {picked.left_out:,} commands to further actuators are left out." if picked.left_out else ""
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
