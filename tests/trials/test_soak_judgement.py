"""The verdict of a soak, on series that are made up."""

from __future__ import annotations

import random

import pytest
from soak.judgement import MORE_PIECES, Sample, leaks, lost_pieces, memory_fault, shown, trend
from soak.vitals import Vitals

HOUR_S = 3600.0


def series(length_s, mib_per_h=0.0, noise_mib=0.0, step_mib=0.0, seed=1):
    """Memory over time, looked at every five seconds; with a step in the middle where one is wanted."""
    draw = random.Random(seed)
    return [
        Sample(time_s, vitals(rss_kib=int(1024 * (25 + mib_per_h * time_s / HOUR_S + noise + step))))
        for time_s in [5.0 * number for number in range(int(length_s / 5) + 1)]
        for noise in [draw.uniform(-noise_mib, noise_mib)]
        for step in [step_mib if time_s > length_s / 2 else 0.0]
    ]


def vitals(rss_kib=25_000, threads=7, sockets=6, files=8):
    return Vitals(rss_kib, rss_kib, threads, sockets, files)


def test_a_slope_is_found_under_noise_that_is_larger_than_all_of_the_growth():
    points = [(sample.time_s, sample.vitals.rss_kib / 1024) for sample in series(HOUR_S, 2.0, noise_mib=3.0)]
    assert trend(points).per_hour == pytest.approx(2.0, abs=0.5)


def test_a_few_outliers_move_no_slope():
    points = [(float(second), 25.0) for second in range(600)]
    for second in (0, 3, 598, 599):
        points[second] = (float(second), 90.0 if second > 300 else 1.0)
    assert trend(points).per_hour == 0.0


@pytest.mark.parametrize(("mib_per_h", "is_well"), [(0.0, True), (0.8, True), (1.2, False), (30.0, False)])
def test_in_an_hour_the_slope_is_judged(mib_per_h, is_well):
    fault, found = memory_fault("a", series(HOUR_S - 600, mib_per_h, noise_mib=0.2))
    assert (fault == "") is is_well
    assert found is not None and found.per_hour == pytest.approx(mib_per_h, abs=0.1)


@pytest.mark.parametrize(("mib_per_h", "is_well"), [(6.0, True), (15.0, True), (30.0, False)])
def test_in_five_minutes_the_growth_is_judged_since_no_slope_can_be_told_from_noise(mib_per_h, is_well):
    fault, found = memory_fault("a", series(300, mib_per_h))
    assert (fault == "") is is_well
    assert found is not None and found.growth == pytest.approx(mib_per_h / 12, abs=0.05)


def test_a_process_that_was_hardly_looked_at_has_not_passed():
    fault, found = memory_fault("a", series(10))
    assert "only 3 samples" in fault and found is None


def test_a_run_says_what_it_has_shown_and_what_takes_longer():
    assert shown(HOUR_S - 600) == "no agent's memory grows by more than 1 MiB/h"
    assert "4 min show a leak of 30 MiB/h or more" in shown(240) and "takes an hour" in shown(240)


def test_pieces_of_memory_that_are_not_given_back_are_counted_at_rest():
    before = Sample(0.0, vitals(), pieces=150_000)
    assert lost_pieces("a", before, Sample(9.0, vitals(), pieces=150_000 + MORE_PIECES)) == ""
    assert "7000 more pieces" in lost_pieces("a", before, Sample(9.0, vitals(), pieces=157_000))
    assert "never collected" in lost_pieces("a", before, Sample(9.0, vitals()))


def test_of_several_looks_the_least_of_each_figure_counts():
    looks = [
        Sample(0.0, vitals(threads=7, sockets=9), workers=1, pieces=0),
        Sample(2.0, vitals(threads=9, sockets=6), workers=1, pieces=150_400),
        Sample(4.0, vitals(threads=8, sockets=7), workers=1, pieces=150_900),
    ]
    least = looks[0].least(looks[1]).least(looks[2])
    assert (least.vitals.threads, least.vitals.sockets, least.pieces, least.time_s) == (7, 6, 150_400, 4.0)


def test_what_is_there_more_of_is_named():
    before = Sample(0.0, vitals(), workers=1, state_files=6)
    after = Sample(9.0, vitals(threads=9, sockets=7, files=10), workers=2, state_files=9)
    assert leaks("a", before, after, records=8) == [
        "a: 9 threads, and 8 would do",
        "a: 7 sockets, and 6 would do",
        "a: 8 other open files, and 7 would do",
        "a: 9 files in its state directory, and 8 would do",
    ]


def test_the_file_of_a_task_that_has_come_is_no_leak_nor_is_the_second_worker_of_a_pool():
    before = Sample(0.0, vitals(), workers=0, state_files=6)
    after = Sample(9.0, vitals(threads=8, sockets=5, files=10), workers=2, state_files=8)
    assert leaks("a", before, after, records=8) == []
