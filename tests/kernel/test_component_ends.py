"""How an actor ends: by an error, by a stop, and what its successor finds."""

import pytest
from kernel.virtual_rig import Diary, Number, Word

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.dead_letters import ATTEMPTS
from pancakes.kernel.dispatchers import defer
from pancakes.kernel.handlers import on, reliable
from pancakes.kernel.mailbox import Call, Mailbox


def ends_of(virtual, cls, *bodies, address="a/client/T", mailbox=None):
    """Spawns an actor, sends it packets, and returns it with the error that it ended with."""
    ends = []
    component = virtual.kernel.spawn(cls, address, mailbox=mailbox, exited=lambda component, error: ends.append(error))
    virtual.settle()
    virtual.send(*bodies)
    virtual.settle()
    return component, (ends[0] if ends else "it lives")


@pytest.mark.parametrize("error", [ValueError("bad"), SystemExit(1), GeneratorExit()])
def test_any_error_ends_the_actor_and_no_other(virtual, error):
    class Failing(Diary):
        def on_failure(self, exception_type, exception_value, traceback):
            self.diary.append(f"failed: {exception_type.__name__}")

        @on("system", Number)
        def number(self, packet):
            raise error

    other = virtual.spawn(Diary, "a/client/Other")
    failing, end = ends_of(virtual, Failing, Number(1))
    assert end is error
    assert failing.diary == ["start", f"failed: {type(error).__name__}"]  # `on_stop` is for an end that was meant
    assert other.diary == ["start", 1]
    assert virtual.kernel.dead_letters.count == 1
    (letter,) = [line for line in virtual.lines() if "dead letter" in line]
    assert "a/client/T failed 1 time on 'virtual_rig.number' #1 from a/client/Source" in letter


@pytest.mark.parametrize("where", ["on_start", "number", "on_stop", "on_failure"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), type("Outcome", (BaseException,), {})()], ids=["^C", "other"])
def test_interrupt_in_virtual_time_reaches_the_program(virtual, error, where):
    """It counts as no failure of the actor, which gets no other turn; what its turn put off is done all the same."""
    put_off = []

    class Broken(Diary):
        def on_start(self):
            self.step("on_start")

        @on("system", Number)
        def number(self, packet):
            super().number(packet)
            self.step("number")
            if where == "on_failure":
                raise ValueError

        def on_stop(self):
            self.step("on_stop")

        def on_failure(self, *failure):
            self.step("on_failure")

        def step(self, name):
            if name == where:
                defer(lambda: put_off.append(name))
                raise error

    ends = []
    other = virtual.spawn(Diary, "a/client/Other")
    broken = virtual.kernel.spawn(Broken, "a/client/T", exited=lambda component, error: ends.append(error))
    with pytest.raises(type(error)) as raised:
        virtual.settle()
        virtual.send(Number(1))
        virtual.settle()
        broken.stop()
        virtual.settle()
    assert raised.value is error
    assert put_off == [where]
    done = list(broken.diary)
    virtual.send(Number(2))
    broken.stop()
    virtual.settle()
    assert (broken.diary, ends) == (done, [])
    assert other.diary[-1] == 2


def test_an_error_at_the_start_ends_it_before_it_handles_anything(virtual):
    class Failing(Diary):
        def on_start(self):
            raise RuntimeError("no hardware")

    failing, end = ends_of(virtual, Failing, Number(1))
    assert str(end) == "no hardware"
    assert failing.diary == []


@pytest.mark.parametrize("error", [RuntimeError("cannot close"), SystemExit(2)])
def test_an_error_while_stopping_is_told_and_does_not_keep_it_alive(virtual, error):
    class Failing(Diary):
        def on_stop(self):
            raise error

    failing, _ = ends_of(virtual, Failing)
    ends = []
    failing.exited = lambda component, problem: ends.append(problem)
    stopped = failing.actor_ref.stop(block=False)
    virtual.settle()
    stopped.get(timeout=0)
    assert ends == [error]
    assert not failing.actor_ref.is_alive()


def test_a_failing_on_failure_is_told_and_the_actor_ends_all_the_same(virtual):
    class Failing(Diary):
        def on_failure(self, exception_type, exception_value, traceback):
            raise RuntimeError("that too")

        @on("system", Number)
        def number(self, packet):
            raise ValueError("first")

    _, end = ends_of(virtual, Failing, Number(1))
    assert str(end) == "first"
    assert any("on_failure of a/client/T failed as well: RuntimeError: that too" in line for line in virtual.lines())


def test_a_successor_finds_what_waited_in_the_mailbox_of_its_slot(virtual):
    class Failing(Diary):
        @on("system", Word)
        def word(self, packet):
            raise ValueError(packet.body.text)

    slot = Mailbox()
    ends_of(virtual, Failing, Number(1), Word("bad"), Number(2), Number(3), mailbox=slot)
    virtual.send(Number(4))  # between the two
    successor = virtual.kernel.spawn(Diary, "a/client/T", mailbox=slot)
    virtual.settle()
    assert successor.diary == ["start", 2, 3, 4]


def test_an_actor_that_ended_while_it_stood_still_does_not_leave_that_to_its_successor(virtual):
    slot = Mailbox()
    first, _ = ends_of(virtual, Diary, mailbox=slot)
    first.call(first.pause)
    first.stop()
    virtual.settle()
    successor = virtual.kernel.spawn(Diary, "a/client/T", mailbox=slot)
    virtual.send(Number(1))
    virtual.settle()
    assert successor.diary == ["start", 1]


class Picky(Diary):
    """Fails on unlucky numbers, each time; counts how often it was tried."""

    tries: list

    @on("system", Number, queue=reliable(9))
    def number(self, packet):
        self.tries.append(packet.body.n)
        if packet.body.n == 13:
            raise ValueError("unlucky")

    @on("system", Word, queue=9)
    def word(self, packet):
        self.tries.append(packet.body.text)
        if packet.body.text == "bad":
            raise ValueError("bad word")


def lives(virtual, lives_left, *bodies):
    """Starts an actor again and again on one mailbox, as its service would; returns what it tried."""
    Picky.tries = []
    slot = Mailbox()

    def exited(component, error):
        nonlocal lives_left
        lives_left -= 1
        if error is not None and lives_left > 0:
            virtual.kernel.spawn(Picky, "a/client/Picky", mailbox=slot, exited=exited)

    virtual.kernel.spawn(Picky, "a/client/Picky", mailbox=slot, exited=exited)
    virtual.settle()
    virtual.send(*bodies)
    virtual.settle()
    return Picky.tries


def test_a_packet_that_may_not_be_lost_comes_three_times_and_is_then_a_dead_letter(virtual):
    assert lives(virtual, 9, Number(1), Number(13), Number(2)) == [1, 13, 13, 13, 2]
    assert ATTEMPTS == 3
    assert virtual.kernel.dead_letters.count == 1
    (letter,) = [line for line in virtual.lines() if "dead letter" in line]
    assert "a/client/Picky failed 3 times on 'virtual_rig.number'" in letter


def test_any_other_packet_is_a_dead_letter_at_once_though_a_reliable_one_shares_its_channel(virtual):
    assert lives(virtual, 9, Word("bad"), Number(1)) == ["bad", 1]
    assert virtual.kernel.dead_letters.count == 1


def test_a_call_meant_for_an_actor_that_ended_is_not_made_in_its_successors_turn(virtual):
    mailbox = Mailbox()
    called = []
    first = virtual.kernel.spawn(ActorCore, "a/test/one", mailbox=mailbox)
    first.stop()
    virtual.settle()
    second = virtual.kernel.spawn(ActorCore, "a/test/one", mailbox=mailbox)
    # What `ActorCore.call` does where its actor ends between the look and the put.
    mailbox.put(Call(first, lambda: called.append("first")))
    second.call(lambda: called.append("second"))
    virtual.settle()
    assert called == ["second"]


def test_an_actor_that_has_ended_may_be_stopped_again_and_its_successor_runs_on(virtual):
    mailbox = Mailbox()
    first = virtual.kernel.spawn(ActorCore, "a/test/one", mailbox=mailbox)
    first.stop()
    virtual.settle()
    second = virtual.kernel.spawn(ActorCore, "a/test/one", mailbox=mailbox)
    first.stop()
    virtual.settle()
    assert second.actor_ref.is_alive()


def test_what_a_turn_put_off_may_fail_and_the_actor_still_gets_turns(virtual):
    def fails():
        raise RuntimeError("no way out")

    done = []
    actor = virtual.kernel.spawn(ActorCore, "a/test/actor")
    actor.call(lambda: defer(fails))
    virtual.settle()
    actor.call(lambda: done.append(True))
    virtual.settle()
    assert done == [True]
