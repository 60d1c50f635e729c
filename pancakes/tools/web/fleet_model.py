"""Model a fleet for a page: packets and descriptions go in, named plain values come out. Pure.

The values of the board, by name (AGENT, TASK ... stand for names; all values are JSON):

| name | value |
|---|---|
| `fleet` | `{name, speed, held}` |
| `arena` | `[width_m, height_m]`, round the origin |
| `body/NAME` | `[x_m, y_m, theta_rad, driven_by]` |
| `shape/NAME` | `{kind, radius_m?, range_m?, laser_m?}`; kind: `robot`, `sensor`, `mover` |
| `ring/AGENT/TYPE` | `{bearings_rad, max_m}` of a range sensor |
| `rays/AGENT/TYPE` | `[range_m, ...]` |
| `motion/AGENT` | `[detected, bearing_rad, range_m]` |
| `battery/AGENT` | `[voltage_v, level]`; while it is charged `[voltage_v, level, true]` |
| `dock/AGENT` | `[x_m, y_m, state, robot]` of the dock of an agent, as its `dock_state` says |
| `agent/AGENT` | a mapping: the figures of its card |
| `service/AGENT/SERVICE` | `[state, reason]` |
| `task/AGENT/SERVICE/TASK` | a mapping, see `_task`; `guards`, see `_guards`: of a guarded task that AGENT owns |
| `circle/AGENT/TASK` | `[x_m, y_m, radius_m]`: a task with `centre_m` in its state or settings, and `radius_m` |
| `commands/AGENT` | the types of its actuators whose commands can be explained |
| `link/A/B` | the round trip in milliseconds, of two agents A < B; -1 while it is not known |
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, TypeGuard

from pancakes.devices import Battery, DockState, Infrared, LaserScan, Motion, Pose, Sonar
from pancakes.events import record_of
from pancakes.packet import LOG, Packet
from pancakes.sim.robot_models import UnknownRobotModelError, robot_model
from pancakes.sim.world_state import WorldState
from pancakes.tools.web.event_words import is_quiet, sentence_of
from pancakes.tools.web.series import SeriesStore
from pancakes.tools.web.timeline import Board
from pancakes.util.arrays import without_arrays

MOST: Final = 2000
"""The most events that are kept; beyond that the oldest are dropped."""
LONGEST: Final = 400
"""The longest sentence, in characters; the rest is cut."""
SHOWN: Final = (
    "task",
    "task_id",
    "source_agent",
    "cost",
    "winner",
    "outcome",
    "level",
    "by",
    "lines",
    "to",
)
"""The fields of an event that a page gets, besides its sentence."""


class EventLog:
    """Events and lines of the agents' logs, as a page shows them.

    Args:
        limit: see `MOST`.

    Attributes:
        count: how many there were; this is also the number of the newest.
    """

    def __init__(self, limit: int = MOST) -> None:
        self.count = 0
        self._limit = limit
        self._kept: OrderedDict[tuple[str, float, str, str], dict[str, Any]] = OrderedDict()

    def add(self, record: Mapping[str, Any], timeline_s: float) -> bool:
        """Take a record of a log.

        Args:
            record: see `pancakes.events.record_of`.
            timeline_s: its time on the timeline.

        Returns:
            Whether it is new: after an interrupted connection, a record may arrive twice.
        """
        text = sentence_of(record)
        if len(text) > LONGEST:
            text = text[: LONGEST - 1] + "…"
        key = (str(record["source"]), float(record["t_s"]), str(record["kind"]), text)
        if key in self._kept:
            return False
        self.count += 1
        shown = {name: record[name] for name in SHOWN if name in record}
        self._kept[key] = {
            "n": self.count,
            "t": round(timeline_s, 3),
            "m": round(float(record["t_s"]), 3),
            "agent": record["agent"],
            "kind": record["kind"],
            "text": text,
            "quiet": is_quiet(record),
            **shown,
        }
        if len(self._kept) > self._limit:
            self._kept.popitem(last=False)
        return True

    def since(self, number: int) -> list[dict[str, Any]]:
        """Return the events after a number that are still kept, oldest first."""
        found = []
        for it in reversed(self._kept.values()):
            if it["n"] <= number:
                break
            found.append(it)
        return found[::-1]


TRAIL: Final = 400
"""The most points of a trail."""
TRAIL_STEPS: Final = 200
"""The least distance between two points of a trail is the width of the arena divided by this, ..."""
TRAIL_STEP_M: Final = 0.02
"""... or this, in metres, if there is no arena."""
MOST_RAYS: Final = 60
"""The most rays of a laser scan that are drawn."""
RUNNING: Final = "running"
PAUSED: Final = "paused"
MOTORS: Final = "motors"
"""The type of the devices that a person can drive by hand."""
FIGURES: Final = ("processor_percent", "memory_mib", "late_ms")
"""The figures of an agent that have a series."""
BATTERY: Final = "battery_percent"
_ENDS: Final = {"task_stopped": "stopped", "task_failed": "failed", "task_given_up": "failed"}

Point = tuple[float, float]


class FleetModel:
    """The model of one fleet. Times `t` are seconds on the page's timeline.

    Attributes:
        board: the present, see the module's docstring.
        events: events and lines of the agents' logs.
        trails: the earlier positions of bodies, oldest first.
        series: the numbers that a page can plot.
    """

    def __init__(self, fleet: str = "") -> None:
        self.board = Board()
        self.events = EventLog()
        self.trails: dict[str, deque[Point]] = {}
        self.series = SeriesStore()
        self._fleet = fleet
        self._step_m = TRAIL_STEP_M
        self._anchor = (0.0, 0.0, 0.0)  # a moment of the timeline, the mission time then, and its speed
        self._leader = ""
        self._truth = False

    @property
    def has_clock(self) -> bool:
        """Whether mission time is known: an agent, or a world, has said what it is."""
        return bool(self._leader)

    def mission_s(self, t: float) -> float:
        """Return the mission time at a moment of the timeline, as far as is known."""
        at_s, mission_s, speed = self._anchor
        return max(0.0, mission_s + (t - at_s) * speed)

    # Packets and log records ------------------------------------------------------------------------------------

    def hear(self, agent: str, packet: Packet, t: float) -> None:
        """Take a packet that an agent published on `system` or `log`."""
        if packet.channel == LOG:
            self.tell(record_of(packet), t)
            return
        self.series.take(packet, t)
        body = packet.body
        match body:
            case WorldState():
                self._world(agent, body, t)
            case Pose() if not self._truth and packet.source.startswith(f"{agent}/device/"):
                self._body(agent, "robot", body.x_m, body.y_m, body.theta_rad, "")
            case Infrared() | Sonar():
                ring = {"bearings_rad": [round(it, 3) for it in body.bearings_rad], "max_m": round(body.max_range_m, 3)}
                self.board.set(f"ring/{agent}/{packet.type}", ring)
                self.board.set(f"rays/{agent}/{packet.type}", [round(it, 3) for it in body.ranges_m])
            case LaserScan():
                bearings_rad, ranges_m = drawn_rays(body)
                self.board.set(f"ring/{agent}/{packet.type}", {"bearings_rad": bearings_rad, "max_m": body.max_range_m})
                self.board.set(f"rays/{agent}/{packet.type}", ranges_m)
            case Motion():
                self.board.set(f"motion/{agent}", [body.detected, _rounded(body.bearing_rad), _rounded(body.range_m)])
            case Battery():
                charging = [True] if body.charging else []
                self.board.set(f"battery/{agent}", [round(body.voltage_v, 2), round(body.level, 3), *charging])
            case DockState() if packet.source.startswith(f"{agent}/"):
                place = [round(body.x_m, 3), round(body.y_m, 3)]
                self.board.set(f"dock/{agent}", [*place, body.state, body.robot])

    def tell(self, record: Mapping[str, Any], t: float) -> None:
        """Take a record of an agent's log that was written now."""
        if self.events.add(record, t):
            self._follow_task(record)

    def recall(self, records: Iterable[Mapping[str, Any]], t: float) -> None:
        """Take records of an agent's log that were written before `t`."""
        _, _, speed = self._anchor
        for record in records:
            before_s = (self.mission_s(t) - float(record["t_s"])) / speed if speed else 0.0
            self.events.add(record, t - max(0.0, before_s))

    def _world(self, agent: str, state: WorldState, t: float) -> None:
        self._truth = True
        self._leader = agent
        self._anchor = (t, state.time_s, self._anchor[2])
        for body in state.bodies:
            self._body(body.name, body.kind, body.x_m, body.y_m, body.theta_rad, body.driven_by)

    def _body(self, name: str, kind: str, x_m: float, y_m: float, theta_rad: float, driven_by: str) -> None:
        board = self.board
        board.set(f"body/{name}", [round(x_m, 4), round(y_m, 4), round(theta_rad, 3), driven_by])
        if board.get(f"shape/{name}") is None:
            board.set(f"shape/{name}", {"kind": kind})
        if kind == "sensor":
            return
        trail = self.trails.setdefault(name, deque(maxlen=TRAIL))
        point = (round(x_m, 3), round(y_m, 3))
        if not trail or math.dist(trail[-1], point) >= self._step_m:
            trail.append(point)

    def _follow_task(self, record: Mapping[str, Any]) -> None:
        """Show at once what an event says of a task; the next description completes it."""
        kind, task, source = record["kind"], record.get("task"), str(record["source"]).split("/")
        if not isinstance(task, str) or len(source) < 2:
            return
        agent, service = source[0], source[1]
        key = f"task/{agent}/{service}/{task}"
        known = self.board.get(key)
        if known is not None and "rest" in known:  # the former reason for not running is out of date
            known = {name: value for name, value in known.items() if name != "rest"}
        if kind in ("task_started", "task_resumed"):
            row = known or {"type": record.get("type", "")}
            self.board.set(key, {**row, "state": RUNNING})
        elif kind == "task_handed_over":
            self._forget_task(agent, service, task)
        elif kind in _ENDS and known is not None:
            self.board.set(key, {**known, "state": _ENDS[kind]})
            self.board.set(f"circle/{agent}/{task}", None)
        elif kind == "rate_changed" and known is not None and isinstance(record.get("rate_hz"), float | int):
            # The rate reached so far does not apply to the new rate.
            self.board.set(key, {**known, "rate_hz": _short(record["rate_hz"]), "achieved_hz": None})

    def _forget_task(self, agent: str, service: str, task: str) -> None:
        self.board.set(f"task/{agent}/{service}/{task}", None)
        self.board.set(f"circle/{agent}/{task}", None)

    def commanded(self, agent: str, types: Sequence[str]) -> None:
        """Show which actuators of an agent were commanded, so that the page can explain their commands."""
        self.board.set(f"commands/{agent}", list(types))

    # Answers of agents -------------------------------------------------------------------------------------------

    def describe(self, rows: Sequence[Mapping[str, Any]], described: Sequence[Mapping[str, Any]], t: float) -> None:
        """Take the descriptions of agents.

        Args:
            rows: the changes since the last descriptions (`pancakes.client.rates`).
            described: the results of `Describe` of the agents that answered.
            t: when they answered.
        """
        answers = {it["agent"]: it for it in described}
        for row in rows:
            self._agent(row, answers.get(row["agent"]), t)
        for description in described:
            self._links(description, t)
            self._clock(description, t)

    def detail(self, agent: str, description: Mapping[str, Any]) -> None:
        """Take the result of `Describe` of one task, with its state."""
        service, task = description["service"], description["task"]
        settings = without_arrays(description.get("settings") or {})
        # If the task does not run, `state` is a word such as `stopped`.
        state = without_arrays(description["state"]) if isinstance(description["state"], Mapping) else {}
        if "arena" in settings:
            self._arena(settings)
        key = f"task/{agent}/{service}/{task}"
        known = self.board.get(key)
        if known is None or known["state"] != RUNNING:
            return
        self.board.set(key, {**known, "requires": list(description.get("requires", ()))})
        centre, radius_m = state.get("centre_m") or settings.get("centre_m"), settings.get("radius_m")
        circle = None
        if _is_point(centre) and isinstance(radius_m, float | int):
            circle = [round(centre[0], 3), round(centre[1], 3), round(radius_m, 3)]
        self.board.set(f"circle/{agent}/{task}", circle)

    def running(self) -> list[tuple[str, str, str]]:
        """Return agent, service and name of each running task of a user or a world."""
        found = []
        for key in self.board.keys("task/"):
            _, agent, service, task = key.split("/", 3)
            row = self.board.get(key)
            if row is None or row["state"] != RUNNING or "device" in row:
                continue
            if service not in ("device", "network", "log"):
                found.append((agent, service, task))
        return found

    def _agent(self, row: Mapping[str, Any], answer: Mapping[str, Any] | None, t: float) -> None:
        agent = row["agent"]
        if answer is None:
            known = self.board.get(f"agent/{agent}") or {"agent": agent, "role": row["role"]}
            self.board.set(f"agent/{agent}", {**known, "state": row["state"]})
            for figure in FIGURES:
                self.series.add(f"{agent} {figure}", t, None)
            return
        processor = row["processor_share"]
        figures = (None if processor is None else 100.0 * processor, row["memory_mib"], _raw_ms(row["lateness_s"]))
        for figure, value in zip(FIGURES, figures, strict=True):
            self.series.add(f"{agent} {figure}", t, value)
        self.board.set(
            f"agent/{agent}",
            {
                "agent": agent,
                "role": row["role"],
                "state": row["state"],
                "processor": _short(row["processor_share"], 2),
                "memory_mib": _short(row["memory_mib"]),
                "late_ms": _ms(row["lateness_s"]),
                "missed": row["missed"],
                "dropped": row["dropped"],
                "links": row["links"],
                "insecure": answer["insecure"],
                "version": _version(answer["process"]),
                "dead_letters": answer["dead_letters"],
                "undelivered": answer["undelivered"],
                "devices": list(answer["devices"]),
                "listen": answer["listen"],
                **({"halt": _halt(halt)} if (halt := answer.get("halt")) else {}),
                **_reserve(answer.get("reserve")),
            },
        )
        level = answer["battery_level"]
        if level is not None:
            self.series.add(f"{agent} {BATTERY}", t, 100.0 * level)
        if level is not None and self.board.get(f"battery/{agent}") is None:
            self.board.set(f"battery/{agent}", [None, round(level, 3)])
        for service in answer["services"]:
            self.board.set(f"service/{agent}/{service['service']}", [service["state"], service["reason"]])
        present = {f"task/{agent}/{task['service']}/{task['task']}" for task in row["tasks"]}
        for key in self.board.keys(f"task/{agent}/"):
            if key not in present:
                _, _, service_name, name = key.split("/", 3)
                self._forget_task(agent, service_name, name)
        described = {(task["service"], task["task"]): task for task in answer["tasks"]}
        unplaced = {task_id.partition("/")[2]: why for task_id, why in answer.get("unplaced", {}).items()}
        for task in row["tasks"]:
            told = described.get((task["service"], task["task"]), {})
            self._task(agent, task, {**told, "unplaced": unplaced.get(task["task"], "")}, t)

    def _task(self, agent: str, task: Mapping[str, Any], described: Mapping[str, Any], t: float) -> None:
        if task["rate_hz"] is not None:
            address = f"{agent}/{task['service']}/{task['task']}"
            self.series.add(f"{address} rate_hz", t, task["achieved_hz"])
            self.series.add(f"{address} late_ms", t, _raw_ms(task["lateness_s"]))
        key = f"task/{agent}/{task['service']}/{task['task']}"
        known = self.board.get(key) or {}
        row = {
            "type": task["type"],
            "state": task["state"],
            "rate_hz": _short(task["rate_hz"]),
            "achieved_hz": _short(task["achieved_hz"]),
            "late_ms": _ms(task["lateness_s"]),
            "missed": task["missed"],
            "dropped": task["dropped"],
            "restarts": task["restarts"],
        }
        for name in ("reason", "rest"):
            acts = task["state"] == RUNNING and described.get("rest") != PAUSED
            if described.get(name) and (not acts or described.get("guarding")):
                row[name] = described[name]
        if described.get("device") and described.get("rest"):
            row["rest"] = described["rest"]
        if described.get("device") == MOTORS:
            row["driven_by"] = described.get("driven_by", "")
        if unplaced := described.get("unplaced"):
            row["unplaced"] = unplaced
        if filters := described.get("filters"):
            row["filters"] = [{key: it[key] for key in ("filter", "doing", "why")} for it in filters]
        if guarding := described.get("guarding"):
            row["guards"] = _guards(guarding)
        if "requires" in known:
            row["requires"] = known["requires"]
        self.board.set(key, row)
        if task["state"] != RUNNING:
            self.board.set(f"circle/{agent}/{task['task']}", None)

    def _links(self, description: Mapping[str, Any], t: float) -> None:
        agent = description["agent"]
        present = set()
        for peer in description["mesh"]["peers"]:
            if peer["role"] == "client":
                continue
            one, other = sorted((agent, peer["name"]))
            key = f"link/{one}/{other}"
            present.add(key)
            # Both ends measure it; the one with the lower name counts, so that the value does not alternate.
            if agent == one or self.board.get(key) is None:
                self.board.set(key, _short(1000.0 * peer["rtt_s"], 2) if peer["rtt_s"] is not None else -1)
                self.series.add(f"{one}~{other} round_trip_ms", t, _raw_ms(peer["rtt_s"]))
        for key in self.board.keys("link/"):
            if agent in key.split("/")[1:] and key not in present:
                self.board.set(key, None)

    def _clock(self, description: Mapping[str, Any], t: float) -> None:
        speed = 0.0 if description["held"] else float(description["speed"])
        if not self._leader or (description["role"] == "environment" and not self._truth):
            self._leader = description["agent"]
        if description["agent"] != self._leader:
            return
        at_s, mission_s, _ = self._anchor
        if not self._truth:
            at_s, mission_s = t, description["mission_s"]
        self._anchor = (at_s, mission_s, speed)
        fleet = {"name": description["fleet"], "speed": float(description["speed"]), "held": description["held"]}
        self.board.set("fleet", fleet)

    def _arena(self, settings: Mapping[str, Any]) -> None:
        arena = settings["arena"]
        if not isinstance(arena, Mapping) or not {"width_m", "height_m"} <= set(arena):
            return
        self.board.set("arena", [arena["width_m"], arena["height_m"]])
        self._step_m = max(0.01, arena["width_m"] / TRAIL_STEPS)
        for kind in ("robot", "sensor", "mover"):
            bodies = settings.get(f"{kind}s")
            for name, body in dict(bodies).items() if isinstance(bodies, Mapping) else ():
                self.board.set(f"shape/{name}", _shape(kind, body))


def _halt(halt: Mapping[str, Any]) -> str:
    """Return who halted an agent, and why."""
    return f"halted by {str(halt['by']).partition('/')[0]}" + (f": {halt['reason']}" if halt["reason"] else "")


def _reserve(reserve: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return how long a robot can go on before it must go to a dock, and what is wrong with docks or battery."""
    if reserve is None:
        return {}
    trouble = {"charge_trouble": reserve["trouble"]} if reserve["trouble"] else {}
    seconds = reserve["seconds"]  # a task of a user's own may tell NaN
    return {**({"reserve_s": round(seconds)} if math.isfinite(seconds) else {}), **trouble}


def _shape(kind: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """Return the shape of a body of a world; without its size if the settings do not tell it here.

    The world may be another's, and the model of a robot may be of a plug-in that is not installed here.
    """
    shape: dict[str, Any] = {"kind": kind}
    radius_m = body.get("radius_m")
    if isinstance(body.get("model"), str):
        with suppress(UnknownRobotModelError):
            model = robot_model(body["model"])
            radius_m = model.radius_m if radius_m is None else radius_m
            if model.laser is not None and model.laser.ahead_m:
                shape["laser_m"] = model.laser.ahead_m
    if radius_m is not None:
        shape["radius_m"] = radius_m
    motion = body.get("motion")
    if isinstance(motion, Mapping) and "range_m" in motion:
        shape["range_m"] = motion["range_m"]
    return shape


def _is_point(value: Any) -> TypeGuard[Sequence[float]]:
    return isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(it, float | int) for it in value)


def _rounded(value: float | None) -> float | None:
    return round(value, 3) if value is not None else None


def _version(process: Mapping[str, Any] | None) -> str | None:
    """Return the version of an agent; None: it shares the process and version of others."""
    return None if process is None else process.get("build") or process["version"]


def _short(value: float | None, digits: int = 3) -> float | None:
    """Round a figure to the digits that the page shows, so that it is sent again only if these change."""
    return float(f"{value:.{digits}g}") if value is not None else None


def _guards(guarding: Mapping[str, Any]) -> dict[str, Any]:
    """Return how a task is guarded; `by` has `[agent, age_s of its checkpoint, whether it answers]` per guardian."""
    guardians = [
        [it["agent"], _short(it["age_s"], 2), it["silent_s"] < guarding["lease_s"]] for it in guarding["guardians"]
    ]
    permit_s = round(guarding["permit_s"], 1)
    return {"wanted": guarding["guard"], "permit_s": permit_s, "age_s": _short(guarding["age_s"], 2), "by": guardians}


def _raw_ms(seconds: float | None) -> float | None:
    return 1000.0 * seconds if seconds is not None else None


def _ms(seconds: float | None) -> float | None:
    return round(1000.0 * seconds, 1) if seconds is not None else None


def drawn_rays(scan: LaserScan) -> tuple[list[float], list[float]]:
    """Return the bearings and ranges of a scan as it is drawn: of rays side by side, the shortest that measured.

    At most `MOST_RAYS` are drawn: a page gets them ten times a second.
    """
    width = -(-len(scan.ranges_mm) // MOST_RAYS)
    bearings_rad, ranges_m = [], []
    for first in range(0, len(scan.ranges_mm), width):
        measured = [(it, first + place) for place, it in enumerate(scan.ranges_mm[first : first + width]) if it]
        if measured:
            nearest_mm, ray = min(measured)
            bearings_rad.append(round(scan.start_rad + ray * scan.step_rad, 3))
            ranges_m.append(nearest_mm / 1000)
    return bearings_rad, ranges_m
