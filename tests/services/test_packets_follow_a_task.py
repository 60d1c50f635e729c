"""Packets that are addressed to a task reach it wherever it is: in order, and once."""

import pytest
from services.numbered import SINK, Moody, Numbered, Picky, Sink, Source, fails, numbers, upto

from pancakes.control import Describe, Migrate, Restart, Start, Stop
from pancakes.durable.courier import COURIER, Say
from pancakes.durable.delivery import Letter, SendUnsent
from pancakes.errors import LocalProtocolError, MailboxFullError
from pancakes.mesh.codec import encode_packet
from pancakes.mesh.memory_network import Quality
from pancakes.testing import Fleet, threaded_agent


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
        yield made


class TestOnOneAgent:
    def test_it_is_brought_while_the_network_sleeps(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink})
        assert agent.ask(Stop("network")).ok
        for n in upto(5):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(0.1)
        assert numbers(fleet) == upto(5)

    def test_nobody_else_hears_it(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink, "Other": Sink})
        agent.publish("system", Numbered(1), to=SINK)
        fleet.run_for(0.1)
        assert agent.task("Other").state.numbers == []
        assert agent.probe.packets(Numbered) == []

    def test_it_waits_once_while_the_task_comes_to_nothing_although_it_is_sent_again_and_again(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink})
        inbox = agent.task("Sink").actor_inbox
        assert inbox.token.acquire(blocking=False), "it is at rest"  # and has no turn from now on
        fleet.run_for(60.0)
        before = len(inbox.control)
        for n in upto(5):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(60.0)
        assert len(inbox.control) <= 2 * before + 5
        inbox.dispatch.ready(inbox)
        fleet.run_for(5.0)
        assert numbers(fleet) == upto(5)

    def test_it_waits_while_the_task_is_stopped(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink})
        assert agent.ask(Stop("Sink")).ok
        for n in upto(100):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(5.0)
        assert agent.ask(Start("Sink")).ok
        fleet.run_for(5.0)
        assert numbers(fleet) == upto(100)

    def test_the_publisher_is_told_when_too_many_wait(self, fleet):
        agent = fleet.start("a", tasks={"Sink": {"type": Sink, "start": False}})
        for n in upto(1024):
            agent.publish("system", Numbered(n), to=SINK)
        with pytest.raises(MailboxFullError, match="1024 packets for the task a/Sink"):
            agent.publish("system", Numbered(1025), to=SINK)
        assert agent.ask(Start("Sink")).ok
        fleet.run_for(5.0)
        assert numbers(fleet) == upto(1024)

    def test_the_publisher_is_told_what_cannot_be_sent(self, fleet):
        agent = fleet.start("a")
        with pytest.raises(LocalProtocolError, match="no task id"):
            agent.publish("system", Numbered(1), to="task:Sink")
        with pytest.raises(LocalProtocolError, match="cannot be sent"):
            agent.publish("system", Numbered(object()), to=SINK)
        with pytest.raises(LocalProtocolError, match="may be sent to a task"):
            agent.publish("system", Numbered("x" * 262_000), to=SINK)

    @pytest.mark.parametrize("durability", ["lazy", "each"])
    def test_a_packet_on_which_the_task_fails_is_given_up_after_three_times(self, fleet, durability):
        agent = fleet.start("a", tasks={"Sink": {"type": Picky, "durability": durability}})
        for n in upto(5):
            agent.publish("system", Numbered(n), to=SINK)
            fleet.run_for(1.5)
        fleet.run_for(10.0)
        assert [event["task"] for event in agent.events("task_failed")] == ["Sink"] * 3
        assert numbers(fleet) == [1, 2, 4, 5]
        assert agent.kernel.dead_letters.count == 1
        assert [line for line in agent.lines("warning") if "dead letter" in line and "3 times" in line]
        assert not agent.agent.outbox.waiting()

    def test_what_a_task_without_its_state_has_heard_is_not_told_again(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink})
        for n in upto(3):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(0.1)
        assert agent.ask(Restart("Sink", keep_state=False)).ok
        agent.publish("system", Numbered(4), to=SINK)
        fleet.run_for(1.0)
        assert numbers(fleet) == [4]

    @pytest.mark.parametrize("keep_state", [None, True, False])
    def test_a_letter_that_comes_late_a_second_time_has_no_effect(self, fleet, keep_state):
        agent = fleet.start("a", tasks={"Sink": Sink})
        last = [agent.publish("system", Numbered(n), to=SINK) for n in upto(3)][-1]
        fleet.run_for(0.1)
        (stream,) = agent.component("client/Sink").carry().heard
        if keep_state is not None:
            assert agent.ask(Restart("Sink", keep_state=keep_state)).ok
        again = Letter("a/Sink", stream, 3, 3, encode_packet(last), "a")
        agent.kernel.tell(COURIER, Say("a", again))
        fleet.run_for(0.1)
        assert numbers(fleet) == ([] if keep_state is False else upto(3))

    def test_a_courier_that_fails_loses_nothing(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink})
        agent.may_fail.add("kernel/Courier")
        courier = agent.component("kernel/Courier")

        def fail():
            raise RuntimeError("a fault")

        courier.call(fail)
        agent.publish("system", Numbered(1), to=SINK)
        fleet.run_for(1.0)
        agent.publish("system", Numbered(2), to=SINK)
        fleet.run_for(1.0)
        assert numbers(fleet) == upto(2)
        assert agent.component("kernel/Courier") is not courier

    def test_on_threads_too(self):
        with threaded_agent("a", tasks={"Sink": {"type": Sink, "durability": "each"}}) as agent:
            for n in upto(200):
                agent.publish("system", Numbered(n), to=SINK)
            sink = agent.task("Sink")
            while agent.agent.outbox.waiting():
                agent.ask(Describe())
            assert sink.state.numbers == upto(200)


class TestAcknowledgement:
    def test_follows_the_checkpoint_where_durability_is_each(self, fleet):
        agent = fleet.start("a", tasks={"Sink": {"type": Sink, "durability": "each"}})
        for n in upto(50):
            agent.publish("system", Numbered(n), to=SINK)
            fleet.run_for(0.0004 * (n % 7))
        acknowledged = 50 - agent.agent.outbox.waiting().get("a/Sink", 0)
        fleet.crash("a")
        fleet.restart("a")
        assert len(numbers(fleet)) >= acknowledged

    def test_runs_ahead_of_it_where_it_is_lazy(self, fleet):
        agent = fleet.start("a", tasks={"Sink": Sink})
        fleet.run_for(0.2)
        agent.publish("system", Numbered(1), to=SINK)
        fleet.run_for(0.01)
        assert agent.agent.outbox.waiting() == {}
        fleet.crash("a")
        agent = fleet.restart("a")
        agent.publish("system", Numbered(2), to=SINK)
        fleet.run_for(0.5)
        assert numbers(fleet) == [2]

    def test_what_was_acknowledged_is_not_lost_where_a_lazy_task_fails(self, fleet):
        """It begins anew from its checkpoint, and is given again what has come since, before all that follows."""
        agent = fleet.start("a", tasks={"Sink": Sink})
        fleet.run_for(1.01)
        for n in upto(5):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(0.01)
        assert agent.agent.outbox.waiting() == {}
        agent.task("Sink").call(fails)
        agent.publish("system", Numbered(6), to=SINK)
        fleet.run_for(0.01)
        assert len(agent.events("task_failed")) == 1
        agent.publish("system", Numbered(7), to=SINK)
        fleet.run_for(1.0)
        assert numbers(fleet) == upto(7)
        # Now it is on disk.
        agent.task("Sink").call(fails)
        fleet.run_for(0.5)
        assert numbers(fleet) == upto(7)

    def test_a_lazy_task_acknowledges_no_more_ahead_than_can_be_kept(self, fleet, monkeypatch):
        monkeypatch.setattr("pancakes.durable.hosting.KEPT", 10)
        agent = fleet.start("a", tasks={"Sink": Sink})
        fleet.run_for(1.01)
        for n in upto(200):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(0.5)
        # Written down more often than once a second, so that all could be acknowledged.
        assert agent.agent.outbox.waiting() == {}
        fleet.crash("a")
        fleet.restart("a")
        assert len(numbers(fleet)) >= 190

    def test_a_lazy_task_that_fails_on_a_packet_each_time_it_is_given_again_gives_it_up(self, fleet):
        agent = fleet.start("a", tasks={"Sink": {"type": Moody, "restart": {"policy": "always", "at_most": 100}}})
        fleet.run_for(1.01)
        for n in upto(4):
            agent.publish("system", Numbered(n), to=SINK)
        fleet.run_for(0.01)
        Moody.bad = 2
        agent.task("Sink").call(fails)
        fleet.run_for(3.0)
        Moody.bad = 0
        assert numbers(fleet) == [1, 3, 4]
        assert [line for line in agent.lines("warning") if "dead letter" in line and "3 times" in line]


def streams(fleet):
    """The streams that the sink has heard, without what only its agent knows of their names."""
    return [name.partition("#")[0] for name in fleet.agents["a"].component("client/Sink").carry().heard]


class TestASenderThatMoves:
    """The source was born on s, and goes to t; the sink is on a."""

    def pair(self, fleet, **others):
        fleet.start("a", tasks={"Sink": Sink})
        s = fleet.start("s", tasks={"Source": {"type": Source, **others}})
        t = fleet.start("t")
        fleet.connect()
        return s, t

    def test_takes_along_what_was_not_acknowledged(self, fleet):
        """Its old host is cut off from the sink, and then killed: nothing of it is needed any more."""
        s, t = self.pair(fleet)
        fleet.network.set_quality("s", "a", Quality(latency_s=100.0))
        fleet.run_for(1.0)
        assert s.agent.outbox.waiting()["a/Sink"] > 40
        assert s.ask(Migrate("Source", to="t")).ok
        assert s.agent.outbox.waiting() == {}
        fleet.crash("s")
        fleet.run_for(5.0)
        n = t.task("Source").state.n
        assert n > 200 and numbers(fleet) == upto(n)

    def test_goes_on_where_it_was_when_it_stays_after_all(self, fleet):
        s, _ = self.pair(fleet)
        fleet.run_for(1.0)
        fleet.faults.fill_disk("t")
        assert "did not ask for the task within 2.0 s" in s.ask(Migrate("Source", to="t")).reason
        fleet.faults.calm()
        fleet.run_for(1.0)
        assert numbers(fleet) == upto(s.task("Source").state.n)
        assert streams(fleet) == [s.agent.outbox.name + "/1"]

    def test_begins_a_new_stream_where_its_agent_is_killed(self, fleet):
        """Numbers may have been given out that its disk knows nothing of; they are not given out twice."""
        s, t = self.pair(fleet)
        fleet.run_for(1.0)
        assert s.ask(Migrate("Source", to="t")).ok
        fleet.crash("t")
        t = fleet.restart("t")
        fleet.connect()
        fleet.run_for(5.0)
        assert streams(fleet) == [s.agent.outbox.name + "/1", t.agent.outbox.name + "/1"]
        got = numbers(fleet)
        assert got[-1] == t.task("Source").state.n
        assert got == sorted(got)

    def test_that_has_sent_more_than_may_travel_stays_and_says_so(self, fleet, monkeypatch):
        monkeypatch.setattr("pancakes.durable.snapshot.LIMIT_BYTES", 2000)
        s, _ = self.pair(fleet)
        fleet.network.set_quality("s", "a", Quality(latency_s=100.0))
        fleet.run_for(1.0)
        reply = s.ask(Migrate("Source", to="t"))
        assert "the snapshot of s/Source has" in reply.reason and "2000 may travel" in reply.reason
        monkeypatch.undo()
        fleet.network.set_quality("s", "a", Quality())
        fleet.run_for(10.0)
        assert numbers(fleet) == upto(s.task("Source").state.n)


class TestFinding:
    """The sink was born on a, and moved to b."""

    @pytest.fixture
    def moved(self, fleet):
        a = fleet.start("a", tasks={"Sink": Sink})
        fleet.start("b")
        fleet.start("s")
        fleet.connect()
        assert a.ask(Migrate("Sink", to="b")).ok
        return fleet

    def test_the_old_host_sends_it_on(self, moved):
        moved.agents["s"].publish("system", Numbered(1), to=SINK)
        assert moved.run_until(lambda: numbers(moved) == [1], 0.05)

    def test_after_that_the_old_host_is_not_needed(self, moved):
        moved.agents["s"].publish("system", Numbered(1), to=SINK)
        moved.run_for(0.1)
        moved.crash("a")
        moved.agents["s"].publish("system", Numbered(2), to=SINK)
        assert moved.run_until(lambda: numbers(moved) == [1, 2], 0.05)

    def test_the_old_host_says_where_it_went_even_if_that_is_down(self, moved):
        moved.crash("b")
        moved.agents["s"].publish("system", Numbered(1), to=SINK)
        moved.run_for(0.1)
        moved.crash("a")
        moved.restart("b")
        assert moved.run_until(lambda: numbers(moved) == [1], 2.2)

    def test_where_nobody_is_left_to_ask_everybody_is(self, moved):
        moved.crash("a")
        moved.agents["s"].publish("system", Numbered(1), to=SINK)
        moved.agents["s"].publish("system", Numbered(2), to=SINK)
        assert moved.run_until(lambda: numbers(moved) == [1, 2], 6.0)
        assert moved.run_until(lambda: not moved.agents["s"].agent.outbox.waiting(), 0.1)

    def test_a_task_that_came_here_is_found_here(self, moved):
        moved.crash("a")
        moved.agents["b"].publish("system", Numbered(1), to=SINK)
        assert moved.run_until(lambda: numbers(moved) == [1], 0.05)


def test_what_a_sender_brings_is_sent_however_soon_the_courier_looks(fleet, monkeypatch):
    """In threads of its own the courier may deal with what it is told before its teller goes on."""
    a = fleet.start("a", tasks={"Sink": {"type": Sink, "start": False}, "Source": Source})
    b = fleet.start("b", classes={"Source": Source})
    fleet.connect()
    fleet.run_for(0.2)
    courier, told = b.component(COURIER), b.kernel.tell

    def tell_at_once(name, message):
        if name == COURIER and isinstance(message, SendUnsent):
            courier.take_message(message)
            return True
        return told(name, message)

    monkeypatch.setattr(b.kernel, "tell", tell_at_once)
    assert a.ask(Migrate("Source", to="b")).ok
    assert b.ask(Stop("Source")).ok
    assert a.ask(Start("Sink")).ok
    fleet.run_for(5.0)
    assert numbers(fleet)[:5] == upto(5)
    assert not b.agent.outbox.waiting()
