"""What a person probably meant."""

import pytest

from pancakes.runtime.foundation.suggestion import suggestion

KNOWN = ["encirclement.GoHome", "encirclement.ScanTarget", "sim.ir", "sim.sonar", "pose"]


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("poes", "pose"),
        ("POSE", "pose"),
        ("encirclement.scantarget", "encirclement.ScanTarget"),
        ("GoHome", "encirclement.GoHome"),
        ("encirclment.GoHom", "encirclement.GoHome"),
        ("pioneer.GoHome", "encirclement.GoHome"),
        ("encirclement.Foo", ""),
        ("encirclement.Scanner", ""),
        ("foo.ScanTargets", ""),
        ("foo.Sonar", ""),
        ("sim.sonr", "sim.sonar"),
        ("sim.pose", "pose"),
        ("temperature", ""),
        ("", ""),
    ],
)
def test_the_nearest_word(word: str, meant: str):
    assert suggestion(word, KNOWN) == meant


def test_where_nothing_is_known_nothing_is_meant():
    assert suggestion("pose", []) == ""
