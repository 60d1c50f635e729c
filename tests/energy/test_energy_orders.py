"""The book of orders: what is asked for, and above all what is not asked for again."""

from pancakes.control import Configure, Describe, Reschedule
from pancakes.energy.orders import ANSWER_S, Knob, OrderBook

IR, SONAR = Knob("device/ir"), Knob("sonar")
SPEED, RADIUS = Knob("client/ScanTarget", "speed_mps"), Knob("client/ScanTarget", "radius_m")
NORMAL = {IR: 10.0, SONAR: 5.0, SPEED: 0.1, RADIUS: 0.55}


class Asker:
    """Whoever carries the orders out, and answers as a test says."""

    def __init__(self, normal=NORMAL):
        self.book = OrderBook(normal)
        self.now_s = 0.0
        self.seq = 0

    def give(self, **wanted):
        self.book.want({knob: wanted[name] for name, knob in self.names().items() if name in wanted})
        given = {}
        for order in self.book.due(self.now_s):
            self.seq += 1
            self.book.asked(self.seq, order, self.now_s)
            given[self.seq] = order.body
        return given

    def names(self):
        return {"ir": IR, "sonar": SONAR, "speed": SPEED, "radius": RADIUS}

    def answer(self, given, ok=True, reason="", result=None):
        return [line for seq in given for line in self.book.answered(seq, ok, reason, result)]


def test_what_holds_is_not_asked_for():
    asker = Asker()
    assert asker.give(ir=10.0, sonar=5.0, speed=0.1) == {}
    assert not asker.book.turned


def test_an_order_is_given_once_and_taken_back_once():
    asker = Asker()
    given = asker.give(ir=2.0)
    assert list(given.values()) == [Reschedule("device/ir", 2.0)]
    assert asker.give(ir=2.0) == {}, "it has not been answered yet"
    asker.answer(given)
    assert asker.give(ir=2.0) == {}
    given = asker.give(ir=10.0)
    assert list(given.values()) == [Reschedule("device/ir", 10.0)]
    asker.answer(given)
    assert asker.give() == {}


def test_what_is_wanted_meanwhile_waits_for_the_answer():
    asker = Asker()
    first = asker.give(ir=5.0)
    assert asker.give(ir=2.0) == {}
    asker.answer(first)
    assert list(asker.give().values()) == [Reschedule("device/ir", 2.0)]


def test_several_settings_of_a_task_are_one_order():
    asker = Asker()
    given = asker.give(speed=0.05, radius=0.8)
    assert list(given.values()) == [Configure("client/ScanTarget", {"speed_mps": 0.05, "radius_m": 0.8})]


def test_a_refusal_is_said_once_and_not_tried_again_for_nothing():
    asker = Asker()
    given = asker.give(ir=2.0)
    said = asker.answer(given, ok=False, reason="a1/device/ir is stopped, not running")
    assert said == ["the rate of device/ir was not set to 2: a1/device/ir is stopped, not running"]
    assert asker.give(ir=2.0) == {}
    given = asker.give(ir=1.0)
    assert given, "another value may be taken"
    assert asker.answer(given, ok=False, reason="a1/device/ir is stopped, not running") == [], "that has been said"


def test_a_refused_order_is_given_again_when_the_task_has_started():
    asker = Asker()
    asker.answer(asker.give(ir=2.0), ok=False, reason="it is stopped")
    asker.book.task_started("device", "sonar")
    assert asker.give() == {}
    asker.book.task_started("device", "ir")
    given = asker.give()
    assert list(given.values()) == [Describe("device/ir")]
    asker.answer(given, result={"rate_hz": 10.0})
    assert list(asker.give().values()) == [Reschedule("device/ir", 2.0)]


def test_a_task_that_has_started_anew_and_kept_its_rate_is_asked_for_nothing():
    asker = Asker()
    asker.answer(asker.give(sonar=1 / 3))
    asker.book.task_started("device", "sonar")
    given = asker.give()
    assert list(given.values()) == [Describe("sonar")]
    asker.answer(given, result={"rate_hz": 1 / (1 / (1 / 3))})
    assert asker.give() == {}


def test_a_task_that_has_started_anew_and_forgot_its_settings_is_told_them_again():
    asker = Asker()
    asker.answer(asker.give(speed=0.05))
    asker.book.task_started("client", "ScanTarget")
    asker.answer(asker.give(), result={"settings": {"speed_mps": 0.1, "radius_m": 0.55}})
    assert list(asker.give().values()) == [Configure("client/ScanTarget", {"speed_mps": 0.05})]


def test_a_task_that_was_never_turned_may_start_as_it_likes():
    asker = Asker()
    asker.book.task_started("device", "ir")
    assert asker.give() == {}


def test_who_takes_over_asks_first_what_holds():
    asker = Asker()
    asker.book.doubt()
    given = asker.give(ir=2.0, sonar=5.0)
    assert list(given.values()) == [Describe("device/ir"), Describe("sonar"), Describe("client/ScanTarget")]
    for seq, body in given.items():
        found = {"rate_hz": 2.0, "settings": {"speed_mps": 0.1, "radius_m": 0.55}}
        asker.answer([seq], result=found if body.target != "sonar" else {"rate_hz": 1.0})
    assert list(asker.give().values()) == [Reschedule("sonar", 5.0)], "its predecessor had slowed it down"


def test_one_of_several_timers_is_found_in_the_description():
    blink = Knob("client/Lamp", timer="blink")
    asker = Asker({blink: 4.0})
    asker.book.doubt()
    found = {"rate_hz": 9.0, "timers": [{"timer": "look", "rate_hz": 9.0}, {"timer": "blink", "rate_hz": 1.0}]}
    asker.answer(asker.give(), result=found)
    assert list(asker.give().values()) == [Reschedule("client/Lamp", 4.0, "blink")]


def test_a_service_that_sleeps_is_asked_for_nothing_until_it_wakes():
    beacons = Knob("network/Discovery")
    asker = Asker({beacons: 1.0, IR: 10.0})
    asker.book.service_stopped("network")
    asker.book.want({beacons: 0.1, IR: 2.0})
    assert list(asker.give().values()) == [Reschedule("device/ir", 2.0)]
    asker.book.service_started("network")
    assert list(asker.give().values()) == [Reschedule("network/Discovery", 0.1)]


def test_an_order_that_is_never_answered_is_given_again():
    asker = Asker()
    assert asker.give(ir=2.0)
    asker.now_s = ANSWER_S
    assert asker.give() == {}
    asker.now_s = ANSWER_S + 1.0
    assert list(asker.give().values()) == [Reschedule("device/ir", 2.0)]


def test_what_is_in_doubt_or_not_answered_is_restored_at_once():
    asker = Asker()
    assert asker.give(ir=2.0), "not answered yet"
    asker.answer(asker.give(sonar=1.0))
    asker.book.task_started("device", "sonar")
    orders = asker.book.restore(NORMAL, asker.now_s)
    assert [order.body for order in orders] == [Reschedule("device/ir", 10.0), Reschedule("sonar", 5.0)]


def test_the_answer_to_somebody_elses_question_changes_nothing():
    asker = Asker()
    given = asker.give(ir=2.0)
    assert asker.book.answered(999, False, "no") == []
    assert asker.give() == {}
    asker.answer(given)
    assert list(asker.give(ir=10.0).values()) == [Reschedule("device/ir", 10.0)]
