"""What a person probably meant."""

from seeded import for_each

from pancakes.runtime.foundation.suggestion import suggestion

KNOWN = ["encirclement.GoHome", "encirclement.ScanTarget", "sim.ir", "sim.sonar", "pose"]


def test_suggestion_is_the_nearest_word():
    def check(case):
        word, meant = case
        assert suggestion(word, KNOWN) == meant

    for_each(
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
        check,
    )


def test_where_nothing_is_known_nothing_is_meant():
    assert suggestion("pose", []) == ""
