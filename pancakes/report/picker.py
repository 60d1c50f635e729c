"""The part of a report's page in which any command can be picked, to see what led to it."""

from __future__ import annotations

import json
from html import escape
from importlib import resources
from typing import Any, Final

from pancakes.report.picked import PickedCommand, PickedCommands
from pancakes.report.reactions import Reaction, Reactions

SLOWEST: Final = 5
"""So many of the slowest commands to each actuator are there for those who run no scripts, too."""

CSS: Final = """
#picker { border: 1px solid var(--line); border-radius: .4rem; padding: .8rem; margin: .8rem 0; }
#picker canvas { width: 100%; height: 12rem; display: block; cursor: crosshair; }
#picker .controls { display: flex; flex-wrap: wrap; gap: .5rem .8rem; align-items: center; margin: .4rem 0; }
#picker button, #picker select, #picker input { font: inherit; font-size: .87rem; color: inherit;
  background: var(--paper); border: 1px solid var(--line); border-radius: .3rem; padding: .25rem .6rem; }
#picker button { cursor: pointer; }
#picker input[type=range] { flex: 1 1 10rem; min-width: 8rem; padding: 0; }
#picker input[type=number] { width: 7rem; }
#picker :focus-visible { outline: 2px solid var(--step); outline-offset: 2px; }
#picker table { width: 100%; }
#picker td.bar { min-width: 8rem; white-space: nowrap; font-size: 0; vertical-align: middle; padding-right: 0; }
#picker td.bar i { display: inline-block; height: .7rem; vertical-align: middle; }
#picker .handling { background: var(--step); }
#picker .travel { background: repeating-linear-gradient(45deg, var(--step) 0 2px, transparent 2px 5px); }
#picker { --step: #0072b2; accent-color: var(--step); }
@media (prefers-color-scheme: dark) { #picker { --step: #56b4e9; } }
@media (max-width: 600px) { #picker th:first-child, #picker td:first-child { display: none; } }
@media print { #picker { display: none; } }
"""
"""How it looks; for the page's style."""


def picker_html(found: Reactions) -> str:
    """Returns the part of the page, with its data and its script. Without scripts the slowest commands are left."""
    picked = found.picked
    data = picked.plain()
    by_steps = {it.steps: it for it in found.reactions()}
    shapes = (tuple(data["names"][place] for place in kind) for kind in data["kinds"])
    data["distributions"] = [_distribution(by_steps.get(shape)) for shape in shapes]
    # Nothing in it may look like the end of the script.
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    script = resources.files("pancakes.report").joinpath("static/picker.js").read_text(encoding="utf-8")
    left = f" {picked.left_out:,} commands to further actuators are left out." if picked.left_out else ""
    return (
        "<h3>Any command</h3>"
        '<noscript><p class="note">To pick a command, let this page run its script; or ask'
        " <code>pancakes why FILE --at TIME</code>.</p></noscript>"
        '<div id="picker" hidden role="group" aria-label="Pick a command">'
        '<div class="controls"><label>actuator <select id="picker-actuator"></select></label>'
        '<label>mission time [s] <input id="picker-when" type="number" step="any" min="0"></label>'
        '<button id="picker-slowest" type="button" title="The slowest; again: the next slowest">slowest</button>'
        "</div>"
        '<canvas id="picker-plot" role="img" aria-label="Time from the first cause to each command, over mission time;'
        ' to pick one by keyboard use the slider below"></canvas>'
        '<div class="controls"><button id="picker-before" type="button" aria-label="Previous command">&lsaquo;</button>'
        '<input id="picker-slider" type="range" min="0" step="1" aria-label="Command">'
        '<button id="picker-after" type="button" aria-label="Next command">&rsaquo;</button></div>'
        '<p id="picker-said" role="status"></p>'
        '<div class="wide" tabindex="0"><table><thead><tr><th class="n">after</th><th>packet</th>'
        '<th class="n">on its way</th><th class="n">until the next</th><th></th></tr></thead>'
        '<tbody id="picker-chain"></tbody></table></div>'
        '<p id="picker-alike" class="faint"></p>'
        f'<p class="faint"><span id="picker-left-out"></span>{left}</p></div>'
        + _slowest(picked)
        + f'<script type="application/json" id="commands-data">{text}</script><script>{script}</script>'
    )


def _distribution(reaction: Reaction | None) -> dict[str, Any] | None:
    if reaction is None:
        return None
    shares = {f"p{round(100 * share)}": _ms(reaction.latency_s.quantile(share)) for share in (0.5, 0.9, 0.99)}
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
        parts.append(f"{escape(step.name)} #{step.seq}{took}")
    took = _ms(command.latency_s)
    return f'<tr><td class="n">{command.mission_s:.3f}</td><td class="n">{took}</td><td>{"".join(parts)}</td></tr>'


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
