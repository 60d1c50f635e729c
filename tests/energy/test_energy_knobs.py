"""Where knobs stand at an effort, and which ranges are refused."""

import pytest

from pancakes.energy.governor import GovernorSettings
from pancakes.energy.orders import Range, RateRange, Sleep
from pancakes.settings import SettingsError, make_settings


def test_a_knob_goes_in_a_straight_line_from_full_to_least():
    speed = Range(full=0.1, least=0.04)
    assert [speed.at(effort) for effort in (1.0, 0.5, 0.0)] == pytest.approx([0.1, 0.07, 0.04])


def test_what_costs_less_when_it_is_larger_goes_up():
    assert Range(full=2.0, least=10.0).at(0.25) == pytest.approx(8.0)


def test_a_knob_may_begin_to_move_late():
    rate = RateRange(full=10.0, least=0.0, from_effort=0.5)
    assert [rate.at(effort) for effort in (1.0, 0.5, 0.25, 0.0)] == pytest.approx([10.0, 10.0, 5.0, 0.0])


def test_sleep_grows_with_what_is_to_be_saved_and_is_never_a_mere_nod():
    sleep = Sleep(every_s=15.0, for_s=10.0, from_effort=0.5)
    assert [sleep.at(effort) for effort in (1.0, 0.5, 0.25, 0.0)] == pytest.approx([0.0, 0.0, 5.0, 10.0])
    assert sleep.at(0.46) == 0.0, "0.8 s are not worth it"


NOTHING = {"thresholds": [{"below": 0.5, "effort": 0.0}]}
KNOB = {"rates": {"device/ir": {"full": 10, "least": 1}}}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (KNOB, "needs at least one threshold"),
        ({**KNOB, "policy": "feedback"}, "needs a table feedback"),
        (NOTHING, "nothing to govern"),
        ({**NOTHING, "rates": {"device/ir": {"full": 1, "least": 10}}}, "least = 10 Hz lies above full = 1 Hz"),
        ({**NOTHING, "sleep": {"every_s": 5, "for_s": 5}}, "leaves no time awake"),
        ({**KNOB, "thresholds": [{"below": 0.3, "effort": 0.5}, {"below": 0.6, "effort": 0.0}]}, "must go down"),
        ({**KNOB, "thresholds": [{"below": 0.6, "effort": 0.2}, {"below": 0.3, "effort": 0.5}]}, "must go down"),
        ({**KNOB, "thresholds": [{"below": 0.6, "effort": 1.0}]}, "the first threshold must ask for less"),
        ({**KNOB, "thresholds": [{"below": 0.99, "effort": 0.5}]}, "would never end"),
        ({**KNOB, **NOTHING, "policy": "hope"}, "expected one of 'thresholds', 'feedback'"),
    ],
)
def test_settings_that_make_no_sense_are_refused_with_a_reason(settings, said):
    with pytest.raises(SettingsError, match=said):
        make_settings(GovernorSettings, settings)


def test_a_full_table_is_understood():
    settings = make_settings(
        GovernorSettings,
        {**KNOB, **NOTHING, "values": {"ScanTarget": {"speed_mps": {"full": 0.1, "least": 0.04}}}},
    )
    assert [str(knob) for knob in settings.knobs()] == ["the rate of device/ir", "speed_mps of ScanTarget"]
