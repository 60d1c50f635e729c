"""What Pancakes relies on inside of pykka: when a new version changes it, these tests say so, not a robot.

`Component` replaces pykka's loop by turns, and keeps pykka's messages. So it overrides or calls methods that pykka
does not promise.
"""

import inspect
import threading

import pykka
import pytest
from pykka.messages import ProxyCall, ProxyGetAttr, ProxySetAttr
from seeded import for_each

from pancakes.durable.bidding import TaskMigrator
from pancakes.durable.client_service import ClientService
from pancakes.kernel.actor import Component
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.pykka_actor import ActorStop, Envelope
from pancakes.kernel.timer import Timer
from pancakes.service import Service
from pancakes.services.device import DeviceTask
from pancakes.services.log import Console
from pancakes.services.network import Discovery, NetworkClient
from pancakes.services.root import Root
from pancakes.task import Task, every
from pancakes.testing import no_thread_left, threaded_agent
from pancakes.util.clock import MissionClock, MonotonicClock
from pancakes.util.plugins import Plugins

PATIENCE_S = 10.0


def test_pykka_actor_methods_are_known():
    def check(case):
        method, parameters = case
        assert list(inspect.signature(getattr(pykka.Actor, method)).parameters) == parameters
        assert list(inspect.signature(getattr(Component, method)).parameters) == parameters

    for_each(
        [
            ("_create_actor_inbox", []),
            ("_create_future", []),
            ("_start_actor_loop", ["self"]),
            ("_actor_loop", ["self"]),
            ("_actor_loop_setup", ["self"]),
            ("_actor_loop_running", ["self"]),
            ("_actor_loop_teardown", ["self"]),
            ("_handle_receive", ["self", "message"]),
            ("_handle_failure", ["self", "exception_type", "exception_value", "traceback"]),
            ("_stop", ["self"]),
            ("stop", ["self"]),
            ("on_start", ["self"]),
            ("on_stop", ["self"]),
            ("on_failure", ["self", "exception_type", "exception_value", "traceback"]),
            ("on_receive", ["self", "message"]),
        ],
        check,
    )


def test_an_actor_sets_no_field_that_our_own_init_leaves_out():
    """`Component.__init__` does not call pykka's, which would cost a UUID and an Event for each actor."""
    assert sorted(vars(pykka.ThreadingActor())) == ["_actor_ref", "actor_inbox", "actor_stopped", "actor_urn"]


def test_a_ref_reads_these_fields_of_an_actor_and_no_others():
    ref = pykka.ThreadingActor().actor_ref
    assert sorted(vars(ref)) == ["_actor_weakref", "actor_class", "actor_inbox", "actor_stopped", "actor_urn"]


def test_an_envelope_is_a_message_and_a_future():
    assert Envelope.__slots__ == ["message", "reply_to"]
    assert list(inspect.signature(Envelope).parameters) == ["message", "reply_to"]


def test_messages_are_told_apart_by_these_classes():
    assert inspect.isclass(ActorStop)
    assert list(inspect.signature(ProxyCall).parameters) == ["attr_path", "args", "kwargs"]
    assert list(inspect.signature(ProxyGetAttr).parameters) == ["attr_path"]
    assert list(inspect.signature(ProxySetAttr).parameters) == ["attr_path", "value"]


def test_a_future_takes_an_error_as_we_give_it():
    future: pykka.Future[None] = pykka.ThreadingFuture()
    future.set_exception((ValueError, ValueError("as told"), None))
    with pytest.raises(ValueError, match="as told"):
        future.get(timeout=0)


def test_handling_a_stop_calls_stop_of_the_actor_itself():
    calls = []

    class Stopped(pykka.ThreadingActor):
        def _stop(self):
            calls.append("stop")

        def take(self, message):
            self._handle_receive(message)

    Stopped().take(ActorStop())
    assert calls == ["stop"]


def test_components_are_pykka_actors():
    def check(cls):
        assert issubclass(cls, pykka.Actor)

    for_each(
        [
            Component,
            Task,
            Service,
            Root,
            ClientService,
            DeviceTask,
            NetworkClient,
            Discovery,
            TaskMigrator,
            Console,
            Timer,
        ],
        check,
    )


@pytest.mark.parametrize("group", ["pancakes.tasks", "pancakes.services"])
def test_so_is_all_that_is_installed(group):
    plugins = Plugins()
    for name in plugins.names(group):
        assert issubclass(plugins.get(group, name), pykka.Actor)


class Counter(Task):
    """A task as pykka's users would write an actor."""

    def on_start(self):
        self.count = 0

    def add(self, number):
        self.count += number
        return self.count

    @every(hz=100)
    def tick(self, tick):
        self.ticked = True

    def on_receive(self, message):
        return ("got", message)


def test_tasks_and_services_answer_a_ref_from_outside():
    with no_thread_left(), threaded_agent(tasks={"Counter": Counter}) as agent:
        ref = agent.task("Counter").actor_ref
        assert ref.actor_urn == "a/client/Counter"
        assert ref.ask("hello", timeout=PATIENCE_S) == ("got", "hello")
        proxy = ref.proxy()
        assert proxy.add(3).get(timeout=PATIENCE_S) == 3
        assert proxy.count.get(timeout=PATIENCE_S) == 3
        for component in agent.kernel.registry.components():
            assert component.actor_ref.is_alive()
            assert component.actor_ref.proxy().address.get(timeout=PATIENCE_S) == component.address
        assert pykka.ActorRegistry.get_all() == []  # it is global to the process, and an agent is not
        assert ref.stop(timeout=PATIENCE_S)
        assert not ref.is_alive()
        # It was not its service that stopped it: a permanent task is started again.
        agent.wait_for_event("task_started", task="Counter", incarnation=2)


def test_the_timer_answers_a_ref_and_ends_when_it_is_stopped():
    with no_thread_left():
        host = MonotonicClock()
        timer = Timer("a", MissionClock(host), host)
        timer.launch()
        ref = timer.actor_ref
        assert ref.proxy().actor_urn.get(timeout=PATIENCE_S) == "a/kernel/timer"
        ref.stop(timeout=PATIENCE_S)
        assert not ref.is_alive()
        with pytest.raises(pykka.ActorDeadError):
            ref.ask("anything")


def test_a_thread_may_wait_for_the_end_of_a_component():
    with no_thread_left():
        kernel = Kernel("a")
        component = kernel.spawn(Component, "a/client/C")
        assert not component.actor_stopped.wait(0.0)
        waiting = [threading.Thread(target=component.actor_stopped.wait, args=(PATIENCE_S,)) for _ in range(2)]
        for thread in waiting:
            thread.start()
        component.stop()
        for thread in waiting:
            thread.join(PATIENCE_S)
        assert component.actor_stopped.wait() and not any(thread.is_alive() for thread in waiting)
        kernel.stop()


def test_stopping_all_actors_of_pykkas_registry_touches_no_agent():
    with no_thread_left():
        kernel = Kernel("a")
        component = kernel.spawn(Component, "a/client/C")
        pykka.ActorRegistry.stop_all()
        assert component.actor_ref.proxy().name.get(timeout=PATIENCE_S) == "C"
        component.actor_ref.stop(timeout=PATIENCE_S)
        kernel.stop()
