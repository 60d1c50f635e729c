"""What the components of one class react to is read once and shared; what one adds for itself concerns no other."""

from dataclasses import dataclass

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import on, plan_of
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.packet import packet_type


@packet_type("test_shared_handlers.word")
@dataclass(frozen=True)
class Word:
    """A packet of these tests."""

    text: str


class Listener(ActorCore):
    """Listens to words for all, and to those for itself."""

    def on_start(self):
        self.heard = []

    @on("system", Word)
    def hear(self, packet):
        self.heard.append(packet.body.text)

    @on("ctrl", Word, addressed=True)
    def obey(self, packet):
        self.heard.append(f"{packet.body.text}!")


class Deaf(Listener):
    """Overrides what its base listens to."""

    def hear(self, packet):
        self.heard.append("?")


def rig(*components):
    dispatcher = VirtualDispatcher(1)
    kernel = Kernel("a", virtual=dispatcher)
    made = [kernel.spawn(cls, address) for cls, address in components]
    source = kernel.spawn(ActorCore, "a/client/Source")
    dispatcher.run_until(dispatcher.clock.now())
    return dispatcher, source, made


def test_each_gets_its_own_packets_although_the_handlers_are_shared():
    dispatcher, source, (one, two) = rig((Listener, "a/client/One"), (Listener, "a/client/Two"))
    source.publish("system", Word("hello"))
    source.publish("ctrl", Word("go"), to="a/client/Two")
    dispatcher.run_until(dispatcher.clock.now())
    assert (one.heard, two.heard) == (["hello"], ["hello", "go!"])


def test_what_one_subscribes_to_while_it_runs_concerns_no_other_of_its_class():
    dispatcher, source, (one, two) = rig((Listener, "a/client/One"), (Listener, "a/client/Two"))
    before = {channel: dict(handlers) for channel, handlers in plan_of(Listener).handlers.items()}
    one.subscribe("system", Word, lambda packet: one.heard.append("again"))
    one.subscribe("log", Word, lambda packet: one.heard.append("log"))
    source.publish("system", Word("hello"))
    source.publish("log", Word("hello"))
    dispatcher.run_until(dispatcher.clock.now())
    assert (one.heard, two.heard) == (["hello", "again", "log"], ["hello"])
    assert {channel: dict(handlers) for channel, handlers in plan_of(Listener).handlers.items()} == before


def test_a_method_that_overrides_one_with_a_mark_is_called_in_its_place():
    dispatcher, source, (deaf,) = rig((type("Marked", (Deaf,), {"hear": on("system", Word)(Deaf.hear)}), "a/client/D"))
    source.publish("system", Word("hello"))
    dispatcher.run_until(dispatcher.clock.now())
    assert deaf.heard == ["?"]
