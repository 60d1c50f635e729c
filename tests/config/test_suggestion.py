"""What a person probably meant."""

from seeded import for_each

from pancakes.util.text import suggestion

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
            ("pioneer.GoHome", ""),
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


def test_common_letters_do_not_lead_to_another_meaning():
    def check(case):
        word, known, meant = case
        assert suggestion(word, known) == meant

    levels = ["debug", "info", "warning", "error"]
    drivers = ["host.temperature", "host.load", "sim.ir"]
    for_each(
        [
            ("always", ["lazy", "each"], "each"),
            ("laz", ["lazy", "each"], "lazy"),
            ("eech", ["lazy", "each"], "each"),
            ("eager", ["lazy", "each"], ""),
            ("warn", levels, "warning"),
            ("critical", levels, "error"),
            ("infos", levels, "info"),
            ("verbose", levels, ""),
            ("never", ["no", "on-failure", "always"], "no"),
            ("on_failure", ["no", "on-failure", "always"], "on-failure"),
            ("transient", ["no", "on-failure", "always"], "on-failure"),
            ("mqtt.temperature", drivers, ""),
            ("arduino.load", drivers, ""),
            ("hosts.load", drivers, "host.load"),
            ("host.laod", drivers, "host.load"),
            ("temperature", drivers, "host.temperature"),
        ],
        check,
    )


def test_an_address_is_near_another_if_both_parts_are():
    known = ["base/log", "base/client", "base/client/Beat", "base/client/Count"]

    def check(case):
        word, meant = case
        assert suggestion(word, known) == meant

    for_each(
        [
            ("base/nobody", ""),
            ("base/lg", "base/log"),
            ("bse/log", "base/log"),
            ("base/client/Bet", "base/client/Beat"),
            ("base/Beat", "base/client/Beat"),
            ("base/clint/Beat", "base/client/Beat"),
            ("other/Beat", ""),
            ("beat", "base/client/Beat"),
        ],
        check,
    )


def test_where_nothing_is_known_nothing_is_meant():
    assert suggestion("pose", []) == ""
