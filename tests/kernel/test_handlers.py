"""How a class says what it reacts to."""

from dataclasses import dataclass

import pytest

from pancakes.devices import Battery, Pose
from pancakes.errors import ClassError, LocalProtocolError
from pancakes.kernel.handlers import (
    LATEST,
    Period,
    QueuePolicy,
    Subscription,
    every,
    on,
    period_of,
    periods_of,
    plan_of,
    reliable,
    subscriptions_of,
)
from pancakes.packet import Packet, packet_type
from pancakes.util.class_checks import GIVEN, SUBSCRIPTIONS


class Base:
    @on("system", Pose)
    def first(self, packet):
        """Overridden below, and listens no more."""

    @every(hz=2)
    def tick(self, tick):
        """Time-driven."""

    @on("system", Battery, queue="latest")
    def second(self, packet):
        """Listens to one thing."""


class Derived(Base):
    def first(self, packet):
        """Not marked: a subclass says anew what an overridden method listens to."""

    @on("ctrl", "motors", queue=reliable(7), addressed=True)
    @on("log")
    def third(self, packet):
        """Listens to two."""

    @every(period_s=0.25)
    def tock(self, tick):
        """Time-driven."""


def test_the_methods_of_a_class_say_what_they_listen_to_in_the_order_of_the_text():
    assert subscriptions_of(Derived) == [
        (Subscription("system", "battery", LATEST), "second"),
        (Subscription("log", None, QueuePolicy(256)), "third"),
        (Subscription("ctrl", "motors", QueuePolicy(7, reliable=True), addressed=True), "third"),
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


@packet_type("handlers.load")
@dataclass(frozen=True)
class Load:
    """A body of these tests."""

    kg: float


def marked(method):
    return getattr(method, SUBSCRIPTIONS), getattr(method, GIVEN)


def test_handler_form_is_read_from_annotations():
    class Forms:
        @on("system")
        def all_packets(self, packet: Packet):
            """Takes packets of all types."""

        @on("system")
        def packets(self, packet: Packet[Load]):
            """Takes packets with a load."""

        @on("system")
        def bodies(self, load: Load):
            """Takes loads."""

        @on("system")
        def both(self, load: Load, packet: "Packet"):
            """Takes loads and their packets."""

        @on("system", Load)
        def plain(self, load, packet):
            """Is not annotated."""

        @on("system", Load)
        def bare(self, packet):
            """Is not annotated either."""

    found = {name: marked(vars(Forms)[name]) for name in vars(Forms) if not name.startswith("__")}
    types = {name: [it.type for it in subscriptions] for name, (subscriptions, _) in found.items()}
    load = ["handlers.load"]
    assert types == {"all_packets": [None], "packets": load, "bodies": load, "both": load, "plain": load, "bare": load}
    assert {name: given.value for name, (_, given) in found.items()} == {
        "all_packets": "packet",
        "packets": "packet",
        "bodies": "body",
        "both": "body and packet",
        "plain": "body and packet",
        "bare": "packet",
    }


def test_handler_annotated_by_text_in_a_function_finds_its_class():
    @packet_type("handlers.local")
    @dataclass(frozen=True)
    class Local:
        """Known in this function only."""

    class Forms:
        @on("system")
        def bodies(self, body: "Local"):
            """Takes these."""

        @on("system")
        def packets(self, packet: "Packet[Local]"):
            """Takes these as well."""

    for method in (Forms.bodies, Forms.packets):
        assert marked(method)[0][0].type == "handlers.local"


@pytest.mark.parametrize("annotation", ["NoClass", int, "Packet[int]", "Load | None"])
def test_handler_whose_annotation_names_no_packet_type_is_refused(annotation):
    def handle(self, load):
        """Never called."""

    handle.__annotations__["load"] = annotation
    with pytest.raises(ClassError, match="names no packet type"):
        on("system")(handle)


def test_handler_of_body_and_packet_must_name_a_type():
    with pytest.raises(ClassError, match="nothing says of which type"):

        class Unsaid:
            @on("system")
            def both(self, body, packet):
                """Of which type?"""


def test_handler_gets_what_its_parameters_say():
    heard: list[object] = []

    class Forms:
        @on("system")
        def bodies(self, load: Load):
            heard.append(load)

        @on("system")
        def both(self, load: Load, packet: Packet):
            heard.append((load, packet))

    packet = Packet("system", "handlers.load", "a/client/S", "", 0.0, 1, Load(2.0))
    for handler in plan_of(Forms).handlers["system"]["handlers.load"]:
        handler(Forms(), packet)
    assert heard == [Load(2.0), (Load(2.0), packet)]
