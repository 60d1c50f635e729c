"""How a class says what it reacts to."""

import pytest

from pancakes.devices import Battery, Pose
from pancakes.errors import ClassError, LocalProtocolError
from pancakes.kernel.handlers import (
    LATEST,
    Keep,
    Period,
    Subscription,
    every,
    on,
    period_of,
    periods_of,
    reliable,
    subscriptions_of,
)


class Base:
    @on("system", Pose)
    def first(self, packet):
        """Overridden below, and listens no more."""

    @every(hz=2)
    def tick(self, tick):
        """Time-driven."""

    @on("system", Battery, keep="latest")
    def second(self, packet):
        """Listens to one thing."""


class Derived(Base):
    def first(self, packet):
        """Not marked: a subclass says anew what an overridden method listens to."""

    @on("ctrl", "motors", keep=reliable(7), addressed=True)
    @on("log")
    def third(self, packet):
        """Listens to two."""

    @every(period_s=0.25)
    def tock(self, tick):
        """Time-driven."""


def test_the_methods_of_a_class_say_what_they_listen_to_in_the_order_of_the_text():
    assert subscriptions_of(Derived) == [
        (Subscription("system", "battery", LATEST), "second"),
        (Subscription("log", None, Keep(256)), "third"),
        (Subscription("ctrl", "motors", Keep(7, reliable=True), addressed=True), "third"),
    ]


def test_time_driven_methods_come_bases_first():
    assert periods_of(Derived) == {"tick": Period(0.5), "tock": Period(0.25)}


def test_a_method_takes_a_rate_or_a_period():
    with pytest.raises(ClassError, match="either a rate or a period"):
        every()
    with pytest.raises(ClassError, match="either a rate or a period"):
        every(period_s=1.0, hz=2)
    for bad_s in (0.0, -1.0, 1e-9, float("nan")):
        with pytest.raises(ClassError, match="a period must be at least 0.0001 s, not"):
            every(period_s=bad_s)
    with pytest.raises(ClassError, match="a rate must lie between 0 and 10,000"):
        every(hz=-1)
    for bad in ("10", True):
        with pytest.raises(ClassError, match="@every takes a number, not"):
            every(hz=bad)  # type: ignore[arg-type]
    assert period_of(0) == float("inf")
    assert period_of(4) == 0.25


@pytest.mark.parametrize("bare", [10, 0.5, 0])
def test_a_bare_number_is_no_rate_and_no_period(bare):
    with pytest.raises(ClassError, match=rf"write @every\(hz={bare}\) for a rate, @every\(period_s={bare}\)"):
        every(bare)


def test_a_body_must_be_a_packet_type():
    with pytest.raises(LocalProtocolError, match="builtins.dict is no packet type"):
        on("system", dict)
