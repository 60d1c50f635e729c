"""The verdict on the energy demo: how much longer a governor lets the mission last, and what that costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pancakes.tools.demo import Run
from pancakes_encirclement.endurance import Endurance, read_endurance, share_of
from pancakes_encirclement.record import read_record
from pancakes_encirclement.scenario import read_scenario
from pancakes_encirclement.verdict import common_reasons, finish, mishaps

GOVERNOR: Final = "energy.governor"
PLAIN: Final = "plain"
_WIDTHS: Final = (10, 9, 18, 9, 9, 13, 9)


@dataclass(frozen=True, slots=True)
class EnergyLimits:
    """The limits of the governed missions.

    Attributes:
        longer: they last at least this many times as long as the plain one.
        off_mean_m: mean distance from the circle round the target.
        early_s: with feedback, how long before the wanted end the battery may be empty.
        left: with feedback, at most this share of the battery is left over at the wanted end, above the reserve.
    """

    longer: float = 1.25
    off_mean_m: float = 0.20
    early_s: float = 0.0
    left: float = 0.10


def judge_mission(run: Run) -> dict[str, Any]:
    """Judge one mission by itself: it must not break off, and have no collision.

    Raises:
        PancakesError: its files or its configurations cannot be read.
    """
    record, scenario = read_record(run.out), read_scenario(run.configs)
    measured = read_endurance(run)
    off_m = [off for _, off in measured.off_m]
    feedback = _feedback(run)
    summary: dict[str, Any] = {
        "seed": run.seed,
        "duration_s": run.duration_s,
        "policy": feedback.get("policy", ""),
        "lasted_s": measured.lasted_s,
        "empty": measured.empty,
        "until_s": feedback.get("until_s"),
        "reserve": feedback.get("reserve"),
        "left": _level_at(measured, feedback["until_s"]) if "until_s" in feedback else None,
        "off_circle_m": {"mean": sum(off_m) / len(off_m), "p95": share_of(off_m, 0.95), "max": max(off_m)}
        if off_m
        else None,
        "laps": measured.laps,
        "lap_s": measured.lasted_s / measured.laps if measured.laps > 0.0 else None,
        "mean_power_w": measured.mean_power_w(),
        "efforts": [[event.t_s, event.fields["effort"]] for event in record.told("effort_changed")],
        "orders": sum(1 for kind in ("rate_changed", "settings_changed") for _ in record.told(kind)),
        **mishaps(record, scenario),
    }
    reasons = common_reasons(summary, run)
    if not off_m:
        reasons.append(f"{scenario.first} never settled on the circle")
    return finish(summary, reasons)


def _feedback(run: Run) -> dict[str, Any]:
    """Return the governor's policy and goal; empty if none runs."""
    for config in run.configs.values():
        for task in config["tasks"].values():
            if task["type"] == GOVERNOR and task["start"]:
                settings = task["settings"]
                policy = settings.get("policy", "thresholds")
                aims = settings.get("feedback", {}) if policy == "feedback" else {}
                return {"policy": policy, **{key: aims[key] for key in ("until_s", "reserve") if key in aims}}
    return {}


def _level_at(measured: Endurance, time_s: float) -> float:
    return next((level for t_s, level in reversed(measured.levels) if t_s <= time_s), 0.0)


def judge_energy(
    out: Path,
    runs: Mapping[str, Run],
    summaries: Mapping[str, Mapping[str, Any]],
    limits: EnergyLimits = EnergyLimits(),
) -> dict[str, Any]:
    """Compare the governed missions with the plain one.

    Args:
        out: the folder with all results.
        runs: the missions, the plain one first.
        summaries: the result of `judge_mission` for each.
        limits: the limits.
    """
    plain = summaries[PLAIN]
    variants = {name: _compared(summary, plain) for name, summary in summaries.items()}
    reasons = [f"{name}: {reason}" for name, summary in summaries.items() for reason in summary["reasons"]]
    if not plain["empty"]:
        reasons.append("without a governor the battery outlasts the mission, so there is nothing to compare")
    for name, summary in summaries.items():
        if name != PLAIN and plain["empty"]:
            reasons += [f"{name}: {reason}" for reason in _reasons(summary, variants[name], limits)]
    first = next(iter(runs.values()))
    summary = {"seed": first.seed, "duration_s": first.duration_s, "variants": variants}
    return finish({**summary, "said": table(variants)}, reasons)


def _compared(summary: Mapping[str, Any], plain: Mapping[str, Any]) -> dict[str, Any]:
    keys = (
        "policy",
        "lasted_s",
        "empty",
        "until_s",
        "reserve",
        "left",
        "off_circle_m",
        "laps",
        "lap_s",
        "mean_power_w",
        "orders",
    )
    return {**{key: summary[key] for key in keys}, "longer": summary["lasted_s"] / plain["lasted_s"]}


def _reasons(summary: Mapping[str, Any], compared: Mapping[str, Any], limits: EnergyLimits) -> list[str]:
    reasons = []
    if compared["longer"] < limits.longer and not summary["empty"]:
        reasons.append(f"the mission was over at {summary['lasted_s']:.0f} s, too early to see how long it lasts")
    elif compared["longer"] < limits.longer:
        reasons.append(f"it lasts {compared['longer']:.2f} times as long, less than {limits.longer:g} times")
    off = summary["off_circle_m"]
    if off is not None and off["mean"] > limits.off_mean_m:
        reasons.append(f"{off['mean']:.3f} m off the circle on average, more than {limits.off_mean_m:g} m")
    until_s = summary["until_s"]
    if until_s is None or summary["duration_s"] < until_s:
        return reasons
    if summary["empty"] and summary["lasted_s"] < until_s - limits.early_s:
        reasons.append(f"the battery was empty at {summary['lasted_s']:.0f} s, before the wanted end at {until_s:g} s")
    elif summary["left"] > summary["reserve"] + limits.left:
        reasons.append(f"{summary['left']:.0%} of the battery were left at the wanted end: it could have done more")
    return reasons


def table(variants: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the comparison as lines for a terminal."""
    heads = ("lasted", "longer", "off the circle", "95 %", "a lap", "mean power", "orders")
    lines = [" " * 12 + "".join(f"{head:>{width}}" for head, width in zip(heads, _WIDTHS, strict=True))]
    for name, row in variants.items():
        off = row["off_circle_m"]
        lasted = f"{row['lasted_s']:.0f} s" if row["empty"] else f"> {row['lasted_s']:.0f} s"
        mean, most = (f"{100 * off['mean']:.1f} cm", f"{100 * off['p95']:.0f} cm") if off else ("-", "-")
        lap = f"{row['lap_s']:.0f} s" if row["lap_s"] is not None else "-"
        power = f"{sum(row['mean_power_w'].values()):.2f} W"
        longer = f"{row['longer'] - 1.0:+.0%}" if name != PLAIN else ""
        cells = (lasted, longer, mean, most, lap, power, str(row["orders"]))
        lines.append(f"{name:12}" + "".join(f"{cell:>{width}}" for cell, width in zip(cells, _WIDTHS, strict=True)))
    return lines
