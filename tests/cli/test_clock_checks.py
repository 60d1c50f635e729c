"""`pancakes doctor` reports wrong clocks: on which host, by how much, and what to do."""

from __future__ import annotations

from typing import Any

from pancakes.tools.cli.verbs.agent_checks import check_clocks
from pancakes.tools.cli.verbs.checks import Facts, Finding

NOW_S = 1.8e9
YEAR_S = 365.25 * 86_400
OFF = {"offset_s": 0.0, "bound_s": 0.001, "drift": 0.0, "mission_ahead_s": 0.0, "day_ahead_s": 0.0}


def fleet(key: str, values: dict[str, float], **utc_s: float | None) -> list[Finding]:
    """Return the findings if a value of each agent, such as its time of day, is ahead of the truth by this much."""
    agents: list[dict[str, Any]] = []
    for name, value in values.items():
        peers = [
            {"name": other, "clock": {**OFF, key: theirs - value}} for other, theirs in values.items() if other != name
        ]
        ahead_s = value if key == "day_ahead_s" else 0.0
        told = {"utc_s": utc_s.get(name, NOW_S + ahead_s + 0.3), "process": {"host": f"host-of-{name}"}}
        agents.append({"agent": name, "mesh": {"peers": [*peers, {"name": "terminal.1", "clock": None}]}, **told})
    return list(check_clocks(Facts(agents, now_s=NOW_S)))


def test_clock_check_accepts_clocks_that_agree():
    for key in ("day_ahead_s", "drift", "mission_ahead_s"):
        assert fleet(key, {"a": 0.0, "b": 0.009, "c": -0.0009}) == fleet(key, {"a": 0.0}) == [], key
    late = fleet("drift", {"a": 0.0, "b": 0.0}, a=NOW_S + 4.0, b=NOW_S - 1.0)
    assert late == [], "what an answer took on its way is no fault"


def test_clock_check_reports_host_and_advice():
    (found,) = fleet("day_ahead_s", {"a": 0.0, "b": -YEAR_S, "c": 0.0})
    assert (found.level, found.about) == ("warning", "b")
    expected = "the time of day of host-of-b, on which b runs, is 1.0 years behind that of a, c and this machine"
    assert found.text == expected
    assert found.advice.startswith("see timedatectl on host-of-b;")


def test_clock_check_of_two_agents_uses_local_time():
    (found,) = fleet("day_ahead_s", {"a": 0.0, "b": 7200.0})
    assert (found.about, "2.0 hours ahead of that of a and this machine" in found.text) == ("b", True)


def test_clock_check_reports_an_unset_clock():
    (found,) = fleet("drift", {"a": 0.0, "b": 0.0}, b=None)
    assert (found.level, found.about) == ("warning", "b") and "was not set" in found.text


def test_clock_check_reports_a_wrong_clock_rate():
    for drift, level in ((0.02, "warning"), (-0.06, "error")):
        (found,) = fleet("drift", {"a": 0.0, "b": 1e-5, "c": drift})
        assert (found.level, found.about) == (level, "c")
        assert f"{'gains' if drift > 0 else 'loses'} {abs(drift):.1%} against that of a and b" in found.text
        assert ("guarded tasks are not safe there" in found.text) is (level == "error")


def test_clock_check_reports_a_different_mission_time():
    (found,) = fleet("mission_ahead_s", {"a": 0.0, "b": 0.2, "c": -90.0})
    assert (found.level, found.about, found.text) == (
        "warning",
        "c",
        "its mission time is 90.0 s behind that of a and b",
    )
    assert found.advice == "if they should share one mission, restart c: it continues at the mission time of its fleet"
