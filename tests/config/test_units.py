"""A number with a unit, as the key that takes it wants it."""

import pytest
from seeded import for_each

from pancakes.util.text import key_for, number_in, whole_number_in, written_for


def test_a_number_with_a_unit_is_written_as_its_key_takes_it() -> None:
    def check(case: tuple[str, str, str]) -> None:
        key, text, expected = case
        assert written_for(key, text) == expected

    for_each(
        [
            ("rate_hz", "2 Hz", "rate_hz = 2"),
            ("rate_hz", "2", "rate_hz = 2"),
            ("rate_hz", "500ms", "rate_hz = 2"),
            ("rate_hz", "10/min", "rate_hz = 0.166667"),
            ("period_s", "500 ms", "period_s = 0.5"),
            ("period_s", "2hz", "period_s = 0.5"),
            ("lease_s", "1.5min", "lease_s = 90"),
            ("speed_mps", "0.1 m/s", "speed_mps = 0.1"),
            ("speed_mps", "3.6 km/h", "speed_mps = 1"),
            ("radius_m", "20cm", "radius_m = 0.2"),
            ("heading_rad", "180°", "heading_rad = 3.14159"),
            ("radius_m", "2 s", ""),
            ("radius_m", "wide", ""),
            ("colour", "2 parrots", ""),
            ("rate_hz", "0 s", ""),
            ("rate_hz", "", ""),
        ],
        check,
    )


def test_a_number_in_text_is_one_as_the_world_writes_it() -> None:
    assert (number_in(" 1.5e1\n"), whole_number_in("-7")) == (15.0, -7)
    for read in (number_in, whole_number_in):
        for text in ("1_0", "ten", ""):
            with pytest.raises(ValueError):
                read(text)


def test_an_unknown_key_with_a_unit_is_answered_with_the_key_that_takes_it() -> None:
    keys = ["rate_hz", "lease_s", "checkpoint_s", "type"]

    def check(case: tuple[str, str, str]) -> None:
        word, text, expected = case
        assert key_for(word, text, keys) == expected

    for_each(
        [
            ("rate", "2 Hz", "rate_hz = 2"),
            ("period", "500ms", "rate_hz = 2"),
            ("every", "2s", "rate_hz = 0.5"),
            ("lease", "500ms", "lease_s = 0.5"),
            ("patience", "500ms", ""),
            ("period", "long", ""),
        ],
        check,
    )
