"""A reader that is full, an asker that is slow, an actor that ends just then: nobody else fails for it."""

import pytest

from pancakes.control import Describe
from pancakes.kernel.call import Call
from pancakes.kernel.component import Component
from pancakes.kernel.dispatch import defer
from pancakes.kernel.handlers import on
from pancakes.kernel.keep import reliable
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.virtual import VirtualDispatcher
from pancakes.net.mesh import Mesh
from pancakes.net.send_buffer import PeerBusy
from pancakes.task import Task
from pancakes.testing import FleetInTest


class Greedy(Component):
    """Wants every line of `log`, and has room for one."""

    @on("log", None, keep=reliable(1))
    def heard(self, packet):
        pass


@pytest.fixture
def kernel():
    made = Kernel("a", virtual=VirtualDispatcher(1))
    yield made
    made.stop()


def test_who_says_something_on_log_does_not_fail_for_a_reader_without_room(kernel):
    reader = kernel.spawn(Greedy, "a/test/greedy")
    speaker = kernel.spawn(Component, "a/test/speaker")
    kernel.virtual.settle()
    reader.actor_inbox.paused = True
    for _ in range(3):
        speaker.log("info", "one more line")
        kernel.log("info", "one more line")
        speaker.event("one_more_event")
    assert len(reader.actor_inbox.queues["log"]) == 1
    assert kernel.stream.undelivered == 8


def test_a_call_meant_for_an_actor_that_ended_is_not_made_in_its_successors_turn(kernel):
    mailbox = Mailbox()
    called = []
    first = kernel.spawn(Component, "a/test/one", mailbox=mailbox)
    first.stop()
    kernel.virtual.settle()
    second = kernel.spawn(Component, "a/test/one", mailbox=mailbox)
    # What `Component.call` does where its actor ends between the look and the put.
    mailbox.put(Call(first, lambda: called.append("first")))
    second.call(lambda: called.append("second"))
    kernel.virtual.settle()
    assert called == ["second"]


def test_an_actor_that_has_ended_may_be_stopped_again_and_its_successor_runs_on(kernel):
    mailbox = Mailbox()
    first = kernel.spawn(Component, "a/test/one", mailbox=mailbox)
    first.stop()
    kernel.virtual.settle()
    second = kernel.spawn(Component, "a/test/one", mailbox=mailbox)
    first.stop()
    kernel.virtual.settle()
    assert second.actor_ref.is_alive()


def test_what_a_turn_put_off_may_fail_and_the_actor_still_gets_turns(kernel):
    def fails():
        raise RuntimeError("no way out")

    done = []
    actor = kernel.spawn(Component, "a/test/actor")
    actor.call(lambda: defer(fails))
    kernel.virtual.settle()
    actor.call(lambda: done.append(True))
    kernel.virtual.settle()
    assert done == [True]


def test_an_asker_that_does_not_listen_ends_neither_the_root_nor_a_service(monkeypatch):
    with FleetInTest(seed=1) as fleet:
        a = fleet.start("a", tasks={"Task": Task})
        b = fleet.start("b")
        fleet.connect()
        send = Mesh.send

        def busy(self, packet, retry=False):
            if packet.type == "reply":
                raise PeerBusy("b is too slow")
            return send(self, packet, retry)

        with monkeypatch.context() as patch:
            patch.setattr(Mesh, "send", busy)
            for target in ("", "Task", "client", "nobody"):
                b.publish("sysctrl", Describe(target), to="a")
            fleet.run_for(1.0)
        assert any("the answer to b/test/Probe was lost" in line for line in a.lines("warning"))
        assert not a.events("service_failed")
        assert b.ask(Describe(), to="a").ok
