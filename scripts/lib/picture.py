"""Draw a mission of the encirclement as a moving picture (SVG with CSS): a task that migrates from robot to robot.

    python scripts/lib/picture.py MISSION FILE

MISSION is the folder that `pancakes demo encirclement --virtual` leaves. The same mission gives the same picture, to
the byte. The migration takes milliseconds, so the picture stands still for it and shows who was asked and what was
answered. Browsers and git forges play it; if a reader prefers no motion, it shows the moment after the migration.
"""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

TASK = "ScanTarget"
BEFORE_S, AFTER_S = 26.0, 41.0
"""How much of the mission is shown before and after the migration, in mission seconds."""
RUNS_S, STANDS_S, GOES_ON_S = 4.0, 4.2, 6.4
"""How long the picture shows what comes before the migration, the migration, and what comes after it."""
LOOP_S = RUNS_S + STANDS_S + GOES_ON_S
STILL_S = RUNS_S + STANDS_S + 1.5
"""The moment that is shown if no motion is wanted."""
STEP_S = 0.1
WIDTH, HEIGHT = 820, 400
SCALE = 132.0
"""Pixels for each metre of the arena."""
ARENA_X, ARENA_Y = 165.0, 186.0
"""Where the sensor node stands in the picture."""
RADIUS_M = 0.55
FULL_V, EMPTY_V = 8.4, 6.6
ROBOTS = ("agent1", "agent2")
CARD_X, CARD_WIDTH, CARD_HEIGHT = 430, 360, 92
CARD_Y = {"agent1": 22, "agent2": 126, "sensor": 230}

STYLE = """
svg { --paper: #fffdf8; --line: #d9cfbf; --ink: #2b2113; --soft: #6b5d48; --one: #b3450f; --two: #0b6e69;
  --chip: #ffe3b3; --bar: #e7dccb;
  font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif }
@media (prefers-color-scheme: dark) { svg { --paper: #211c15; --line: #4d4232; --ink: #f6ecdb; --soft: #c0b197;
  --one: #ff9a5c; --two: #52cbc3; --chip: #5a4216; --bar: #453a2b } }
.paper { fill: var(--paper); stroke: var(--line) } .card { fill: none; stroke: var(--line); stroke-width: 1.5 }
text { fill: var(--ink); font-size: 15px } .soft { fill: var(--soft); font-size: 13px } .name { font-weight: 600 }
.big { font-size: 19px } .agent1 { --own: var(--one) } .agent2 { --own: var(--two) }
.body { fill: var(--own); stroke: var(--paper); stroke-width: 1.5 } .nose { stroke: var(--paper); stroke-width: 3 }
.trail { fill: none; stroke: var(--own); stroke-width: 2.5; opacity: .55 } .level { fill: var(--own) }
.bar { fill: var(--bar) } .circle { fill: none; stroke: var(--line); stroke-dasharray: 4 5; stroke-width: 1.5 }
.post { fill: var(--soft) } .chip { fill: var(--chip); stroke: var(--soft) }
.mark { fill: none; stroke: var(--soft); stroke-dasharray: 3 4 }
g.moving, path.moving, rect.moving, text.moving { animation-duration: LOOPs; animation-iteration-count: infinite;
  animation-timing-function: linear }
text.moving, g.shown { animation-timing-function: step-end }
@media (prefers-reduced-motion: reduce) { .moving { animation: none !important } }
""".replace("LOOP", f"{LOOP_S:g}")


class Sample(NamedTuple):
    """Where a robot is.

    Attributes:
        time_s: mission time.
        x_m, y_m, theta_rad: its true pose.
        level: what is left of its battery, 0 to 1.
    """

    time_s: float
    x_m: float
    y_m: float
    theta_rad: float
    level: float


class Mission(NamedTuple):
    """What is drawn of a mission.

    Attributes:
        tracks: the samples of each robot.
        asked_s, moved_s: when the task's migration began, and when it ran elsewhere.
        refused: why the sensor node refused.
        cost: what agent 2 bid.
        revolutions: what the task brought with it.
    """

    tracks: dict[str, list[Sample]]
    asked_s: float
    moved_s: float
    refused: str
    cost: float
    revolutions: float


def read(folder: Path) -> Mission:
    """Read a mission."""
    tracks: dict[str, list[Sample]] = {name: [] for name in ROBOTS}
    with (folder / "trajectory.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["name"] in tracks:
                level = (float(row["battery_v"]) - EMPTY_V) / (FULL_V - EMPTY_V)
                track = tracks[row["name"]]
                heading = float(row["theta_rad"])
                if track:  # without a jump from pi to -pi, where the picture would turn the long way round
                    heading += math.tau * round((track[-1].theta_rad - heading) / math.tau)
                track.append(Sample(float(row["t_s"]), float(row["x_m"]), float(row["y_m"]), heading, level))
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]

    def event(kind: str) -> dict[str, Any]:
        return next(it for it in events if it["kind"] == kind and it["task"] == TASK)

    arrived = event("task_arrived")
    return Mission(
        tracks,
        event("migration_asked")["t_s"],
        arrived["t_s"],
        event("migration_refused")["reason"],
        event("migration_bid")["cost"],
        arrived["state"]["revolutions"],
    )


class Picture:
    """A moving picture of a mission."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._rules: list[str] = []
        self._count = 0

    def draw(self) -> str:
        """Return the picture."""
        shapes = [*self._arena(), *self._cards(), *self._captions()]
        style = STYLE + "\n".join(self._rules)
        title = f"{TASK} migrates from agent1, whose battery runs low, to agent2, and agent1 drives home"
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">\n'
            f"<title>{title}</title>\n<style>{style}</style>\n"
            f'<rect class="paper" x=".5" y=".5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="10"/>\n'
            + "\n".join(shapes)
            + "\n</svg>\n"
        )

    def mission_time(self, shown_s: float) -> float:
        """Return which mission time a moment of the picture shows: it stands still during the migration."""
        moved_s = self._mission.moved_s
        if shown_s <= RUNS_S:
            return moved_s - BEFORE_S * (1 - shown_s / RUNS_S)
        return moved_s + AFTER_S * max(0.0, shown_s - RUNS_S - STANDS_S) / GOES_ON_S

    def _arena(self) -> Iterable[str]:
        yield f'<g transform="translate({ARENA_X:g} {ARENA_Y:g})">'
        yield f'<circle class="circle" r="{RADIUS_M * SCALE:.1f}"/>'
        yield '<path class="post" d="M-7 6 0-8 7 6Z"/><text class="soft" x="-20" y="22">sensor</text>'
        for name in ROBOTS:
            home = self._mission.tracks[name][0]
            corner = f'x="{home.x_m * SCALE - 13:.1f}" y="{-home.y_m * SCALE - 13:.1f}"'
            yield f'<rect class="mark" {corner} width="26" height="26" rx="5"/>'
        for name in ROBOTS:
            yield from self._robot(name)
        yield "</g>"

    def _robot(self, name: str) -> Iterable[str]:
        whole = [self._at(name, shown_s) for shown_s in moments()]
        points = [f"{it.x_m * SCALE:.1f} {-it.y_m * SCALE:.1f}" for it in whole]
        way = [0.0]
        for one, other in zip(whole, whole[1:], strict=False):
            way.append(way[-1] + SCALE * ((other.x_m - one.x_m) ** 2 + (other.y_m - one.y_m) ** 2) ** 0.5)

        def left(shown_s: float) -> str:
            return f"stroke-dashoffset:{way[-1] - way[index(shown_s)]:.1f}"

        yield f'<g class="{name}">'
        line = f'd="M{"L".join(points)}" stroke-dasharray="{way[-1]:.1f}"'
        yield f'<path class="trail moving" {self._moves(left)} {line}/>'
        yield f'<g class="moving" {self._moves(lambda shown_s: transform(self._at(name, shown_s)))}>'
        yield '<circle class="body" r="11"/><path class="nose" d="M3 0H10"/></g></g>'

    def _cards(self) -> Iterable[str]:
        moved_s = RUNS_S + 0.75 * STANDS_S
        for name in (*ROBOTS, "sensor"):
            y = CARD_Y[name]
            yield f'<g class="{name}" transform="translate({CARD_X} {y})">'
            yield f'<rect class="card" width="{CARD_WIDTH}" height="{CARD_HEIGHT}" rx="8"/>'
            yield f'<text class="name" x="14" y="27">{name}</text>'
            if name == "sensor":
                yield '<text class="soft" x="14" y="50">no motors</text>'
            else:
                full = 110
                level = self._moves(partial(self._level, name))
                yield f'<text class="soft" x="{CARD_WIDTH - 178}" y="26">battery</text>'
                yield f'<rect class="bar" x="{CARD_WIDTH - 124}" y="15" width="{full}" height="12" rx="3"/>'
                yield (
                    f'<g transform="translate({CARD_WIDTH - 124} 15)"><rect class="level moving" {level} '
                    f'width="{full}" height="12" rx="3"/></g>'
                )
            yield "</g>"
        yield self._shown(*said(CARD_X + 170, CARD_Y["agent2"] + 70, f"bid: cost {self._mission.cost:g}"), 0.25, 0.8)
        yield self._shown(*said(CARD_X + 14, CARD_Y["sensor"] + 74, f"refused: {self._mission.refused}"), 0.25, 0.8)
        yield self._shown(*chip(CARD_X + 14, CARD_Y["agent1"] + 48, "GoHome"), 0.95, None)
        begin, end = CARD_Y["agent1"] + 48, CARD_Y["agent2"] + 48

        def place(shown_s: float) -> str:
            done = min(1.0, max(0.0, (shown_s - moved_s + 0.9) / 0.9))
            return f"transform:translate({CARD_X + 14}px,{begin + (end - begin) * done * done * (3 - 2 * done):.1f}px)"

        yield f'<g class="moving" {self._moves(place)}>{chip(0, 0, TASK)[0]}</g>'

    def _level(self, name: str, shown_s: float) -> str:
        return f"transform:scaleX({self._at(name, shown_s).level:.3f})"

    def _captions(self) -> Iterable[str]:
        mission = self._mission
        low = next(it.level for it in mission.tracks["agent1"] if it.time_s >= mission.asked_s)
        took_ms = 1000 * (mission.moved_s - mission.asked_s)
        turns = f"{mission.revolutions:.1f} turns"
        lines = (
            (0.0, RUNS_S, f"agent1 runs {TASK}: it circles the sensor node."),
            (
                RUNS_S,
                RUNS_S + 0.25 * STANDS_S,
                f"Its battery is down to {100 * low:.0f} %: it asks who would take {TASK}.",
            ),
            (RUNS_S + 0.25 * STANDS_S, RUNS_S + 0.54 * STANDS_S, "One agent bids. One has no motors, and refuses."),
            (
                RUNS_S + 0.54 * STANDS_S,
                RUNS_S + STANDS_S,
                f"The task moves with its state, {turns}, in {took_ms:.0f} ms of mission time.",
            ),
            (RUNS_S + STANDS_S, LOOP_S, "agent2 goes on where agent1 left off. agent1 drives home."),
        )
        y = HEIGHT - 34
        for begin_s, end_s, text in lines:
            still = begin_s <= STILL_S < end_s
            yield self._between(f'class="big moving" x="30" y="{y}"', text, begin_s, end_s, still)
        clock = sorted({int(self.mission_time(shown_s)) for shown_s in moments()})
        yield f'<text class="soft" x="{WIDTH - 160}" y="{y}">mission time</text>'
        for second in clock[:: len(clock) // 30]:
            shown = [it for it in moments() if second <= self.mission_time(it) < second + len(clock) // 30]
            if shown:
                still = shown[0] <= STILL_S <= shown[-1] + STEP_S / 2
                yield self._between(
                    f'class="soft moving" x="{WIDTH - 72}" y="{y}"', f"{second} s", shown[0], shown[-1] + STEP_S, still
                )

    def _at(self, name: str, shown_s: float) -> Sample:
        time_s = self.mission_time(shown_s)
        return min(self._mission.tracks[name], key=lambda it: abs(it.time_s - time_s))

    def _moves(self, style_of: Callable[[float], str]) -> str:
        """Return the attributes of a shape whose style changes, and add its keyframes."""
        rules: list[tuple[float, str]] = []
        for shown_s in moments():
            style = style_of(shown_s)
            if len(rules) > 1 and rules[-1][1] == rules[-2][1] == style:
                rules[-1] = (shown_s, style)
            else:
                rules.append((shown_s, style))
        name = self._named("".join(f"{100 * at_s / LOOP_S:.2f}%{{{style}}}" for at_s, style in rules))
        return f'style="animation-name:{name};{style_of(STILL_S)}"'

    def _shown(self, shape: str, y: float, begin: float, end: float | None) -> str:
        """Return a shape that is shown in a part of the migration; without an end: up to the end of the picture."""
        end_s = LOOP_S if end is None else RUNS_S + end * STANDS_S
        begin_s = RUNS_S + begin * STANDS_S
        name = self._named(visible(begin_s, end_s))
        still = int(begin_s <= STILL_S < end_s)
        return f'<g class="moving shown" style="animation-name:{name};opacity:{still}">{shape}</g>'

    def _between(self, attributes: str, text: str, begin_s: float, end_s: float, still: bool) -> str:
        name = self._named(visible(begin_s, end_s))
        return f'<text {attributes} style="animation-name:{name};opacity:{int(still)}">{text}</text>'

    def _named(self, keyframes: str) -> str:
        name = f"k{self._count}"
        self._count += 1
        self._rules.append(f"@keyframes {name}{{{keyframes}}}")
        return name


def moments() -> list[float]:
    """Return the moments of the picture that have keyframes of their own."""
    return [index * STEP_S for index in range(round(LOOP_S / STEP_S) + 1)]


def index(shown_s: float) -> int:
    """Return the number of a moment."""
    return round(shown_s / STEP_S)


def transform(at: Sample) -> str:
    """Return the style of a robot's place."""
    degrees = -math.degrees(at.theta_rad)
    return f"transform:translate({at.x_m * SCALE:.1f}px,{-at.y_m * SCALE:.1f}px) rotate({degrees:.0f}deg)"


def visible(begin_s: float, end_s: float) -> str:
    """Return the keyframes of what is shown only for a while."""
    begin, end = 100 * begin_s / LOOP_S, 100 * end_s / LOOP_S
    before = "0%{opacity:0}" if begin > 0 else ""
    after = f"{end:.2f}%{{opacity:0}}100%{{opacity:0}}" if end < 100 else "100%{opacity:1}"
    return f"{before}{begin:.2f}%{{opacity:1}}{after}"


def said(x: float, y: float, text: str) -> tuple[str, float]:
    """Return a line of a card."""
    return f'<text class="soft" x="{x}" y="{y}">{text}</text>', y


def chip(x: float, y: float, text: str) -> tuple[str, float]:
    """Return a task as it stands on the card of its agent."""
    width = 24 + 8.8 * len(text)
    shape = f'<rect class="chip" width="{width:.0f}" height="30" rx="15"/>'
    shape += f'<text x="{width / 2:.0f}" y="20" text-anchor="middle">{text}</text>'
    return f'<g transform="translate({x} {y})">{shape}</g>', y


def main() -> None:
    """Draw the picture."""
    if len(sys.argv) != 3:
        sys.exit("usage: picture.py MISSION FILE")
    Path(sys.argv[2]).write_text(Picture(read(Path(sys.argv[1]))).draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
