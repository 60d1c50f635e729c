"""What `pancakes top` makes of two looks at agents: rates that are reached, lateness, load."""

from typing import Any

import pytest

from pancakes.client.rates import RateMeter


def task(name: str = "Walk", ticks: int = 0, **others: Any) -> dict[str, Any]:
    """What an agent says of a task."""
    return {
        "agent": "a",
        "service": "client",
        "task": name,
        "type": "walk.Walk",
        "state": "running",
        "rate_hz": 10.0,
        "incarnation": 1,
        "ticks": ticks,
        "lateness_sum_s": 0.0,
        "missed": 0,
        "dropped": 0,
        **others,
    }


def agent(mission_s: float, *tasks: dict[str, Any], **others: Any) -> dict[str, Any]:
    """What an agent says of itself."""
    process = {"pid": 1, "processor_s": 0.0, "uptime_s": mission_s, "memory_mib": 30.0}
    return {
        "agent": "a",
        "fleet": "test",
        "role": "agent",
        "ready": True,
        "held": False,
        "mission_s": mission_s,
        "process": process,
        "battery_level": None,
        "mesh": {"peers": [{"role": "agent"}, {"role": "client"}]},
        "tasks": list(tasks),
        **others,
    }


def test_the_rate_is_that_between_two_looks():
    rates = RateMeter()
    (first,) = rates.update([agent(10.0, task(ticks=100))])
    (second,) = rates.update([agent(12.0, task(ticks=118))])

    assert first["tasks"][0]["achieved_hz"] is None
    assert second["tasks"][0]["achieved_hz"] == pytest.approx(9.0)
    assert second["tasks"][0]["rate_hz"] == 10.0
    assert second["links"] == 1  # this terminal does not count


def test_it_is_measured_over_ten_seconds_at_the_most():
    rates = RateMeter()
    for second in range(31):
        (row,) = rates.update([agent(float(second), task(ticks=min(second, 15) * 10))])
        if second == 20:
            assert row["tasks"][0]["achieved_hz"] == pytest.approx(5.0)
    assert row["tasks"][0]["achieved_hz"] == 0.0


def test_too_few_ticks_say_nothing():
    rates = RateMeter()
    rates.update([agent(0.0, task(ticks=0, rate_hz=1.0))])
    assert rates.update([agent(1.0, task(ticks=0, rate_hz=1.0))])[0]["tasks"][0]["achieved_hz"] is None
    assert rates.update([agent(4.0, task(ticks=4, rate_hz=1.0))])[0]["tasks"][0]["achieved_hz"] == pytest.approx(1.0)


@pytest.mark.parametrize("change", [{"incarnation": 2, "ticks": 3}, {"rate_hz": 50.0, "ticks": 105}])
def test_a_restart_or_another_rate_is_measured_by_itself(change: dict[str, Any]):
    rates = RateMeter()
    rates.update([agent(0.0, task(ticks=100))])
    assert rates.update([agent(1.0, task(**change))])[0]["tasks"][0]["achieved_hz"] is None
    later = {**change, "ticks": change["ticks"] + 20}
    assert rates.update([agent(2.0, task(**later))])[0]["tasks"][0]["achieved_hz"] == pytest.approx(20.0)


def test_an_agent_that_was_started_anew_is_measured_by_itself():
    rates = RateMeter()
    rates.update([agent(50.0, task(ticks=500))])
    assert rates.update([agent(1.0, task(ticks=10))])[0]["tasks"][0]["achieved_hz"] is None
    assert rates.update([agent(2.0, task(ticks=20))])[0]["tasks"][0]["achieved_hz"] == pytest.approx(10.0)


def test_lateness_is_the_mean_of_the_ticks_between():
    rates = RateMeter()
    rates.update([agent(0.0, task("A", 0, lateness_sum_s=5.0), task("B", 0), task("C", 0, rate_hz=None))])
    (row,) = rates.update(
        [agent(1.0, task("A", 10, lateness_sum_s=5.1), task("B", 30, lateness_sum_s=0.02), task("C", 0, rate_hz=None))]
    )

    assert [it["lateness_s"] for it in row["tasks"]] == [pytest.approx(0.01), pytest.approx(0.02 / 30), None]
    assert row["lateness_s"] == pytest.approx(0.12 / 40)
    assert row["tasks"][2]["achieved_hz"] is None


def test_the_processor_share_is_that_of_the_process():
    rates = RateMeter()
    before = {"pid": 1, "processor_s": 3.0, "uptime_s": 10.0, "memory_mib": 30.0}
    assert rates.update([agent(0.0, process=before)])[0]["processor_share"] is None

    now = {**before, "processor_s": 3.5, "uptime_s": 12.0}
    assert rates.update([agent(2.0, process=now)])[0]["processor_share"] == pytest.approx(0.25)
    assert rates.update([agent(3.0, process={**now, "pid": 2, "uptime_s": 1.0})])[0]["processor_share"] is None
    virtual = rates.update([agent(4.0, process=None)])[0]
    assert (virtual["processor_share"], virtual["memory_mib"]) == (None, None)


def test_who_does_not_answer_any_more_is_still_shown():
    rates = RateMeter()
    rates.update([agent(0.0, task()), agent(0.0, agent="b")])
    gone, there = rates.update([agent(1.0, agent="b")])

    assert (gone["agent"], gone["state"], gone["tasks"], gone["missed"]) == ("a", "no answer", [], None)
    assert there["state"] == "ready"
    assert [row["state"] for row in rates.update([agent(2.0)])] == ["ready", "no answer"]


def test_what_was_missed_and_dropped_is_summed_up():
    (row,) = RateMeter().update([agent(0.0, task("A", missed=2, dropped=1), task("B", missed=3, incarnation=3))])

    assert (row["missed"], row["dropped"]) == (5, 1)
    assert [it["restarts"] for it in row["tasks"]] == [0, 2]
