"""What an actor may rely on: its address, its two lanes, and the packets that it publishes and handles."""

import math

import pytest
from kernel.virtual_rig import Diary, Number, VirtualRig, Word

from pancakes.errors import LocalProtocolError, MailboxFullError, UnknownChannelError
from pancakes.events import Event, LogLine
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import every, on, reliable
from pancakes.testing import assert_published


def test_a_life_from_start_to_stop(virtual):
    diary = virtual.spawn(Diary, "a/client/Diary")
    virtual.send(Number(1), Number(2))
    virtual.settle()
    diary.stop()
    virtual.settle()
    virtual.send(Number(3))
    virtual.settle()
    assert diary.diary == ["start", 1, 2, "stop"]
    assert virtual.kernel.stream.subscribers("system") == []
    assert virtual.kernel.registry.get("a/client/Diary") is None


def test_two_actors_cannot_share_an_address(virtual):
    virtual.spawn(Diary, "a/client/Diary")
    with pytest.raises(ValueError, match="a/client/Diary runs already"):
        virtual.spawn(Diary, "a/client/Diary")


def test_control_goes_before_data(virtual):
    """A stop, a tick or a call does not wait for a hundred packets."""
    diary = virtual.spawn(Diary, "a/client/Diary")
    virtual.send(*map(Number, range(5)))
    diary.call(lambda: diary.diary.append("call"))
    virtual.settle()
    assert diary.diary == ["start", "call", 0, 1, 2, 3, 4]


def test_control_that_comes_in_the_middle_of_data_goes_next(virtual):
    class Busy(Diary):
        @on("system", Number)
        def number(self, packet):
            super().number(packet)
            if packet.body.n == 1:
                self.call(lambda: self.diary.append("call"))

    busy = virtual.spawn(Busy, "a/client/Busy")
    virtual.send(*map(Number, range(4)))
    virtual.settle()
    assert busy.diary == ["start", 0, 1, "call", 2, 3]


def test_a_turn_handles_what_waits_from_all_channels(virtual):
    class Reading(Diary):
        @on("network", Word)
        def word(self, packet):
            self.diary.append(packet.body.text)

    reading = virtual.spawn(Reading, "a/client/Reading")
    reading.after_turn = lambda: reading.diary.append("turn")
    virtual.send(Number(1))
    virtual.send(Word("one"), channel="network")
    virtual.settle()
    assert reading.diary == ["start", 1, "one", "turn"]


def test_a_stop_leaves_what_waits(virtual):
    diary = virtual.spawn(Diary, "a/client/Diary")
    virtual.send(*map(Number, range(5)))
    diary.stop()
    virtual.settle()
    assert diary.diary == ["start", "stop"]


def test_an_actor_that_stands_still_gets_no_packet_and_no_tick_and_then_all_that_waits(virtual):
    class Ticking(Diary):
        @every(period_s=1.0)
        def tick(self, tick):
            self.diary.append(f"tick {tick.time_s:g}")

    diary = virtual.spawn(Ticking, "a/client/Diary")
    virtual.run_until(1.5)
    diary.call(diary.pause)
    virtual.settle()
    virtual.send(Number(1), Number(2))
    virtual.run_until(4.5)
    assert virtual.dispatcher.next_s() == math.inf, "no timer wakes an actor that stands still"
    assert diary.diary == ["start", "tick 1"]
    diary.call(diary.resume)
    virtual.run_until(5.5)
    assert diary.diary == ["start", "tick 1", 1, 2, "tick 5"]


def test_a_packet_tells_where_it_comes_from_and_what_led_to_it(virtual):
    class Echo(ActorCore):
        @on("system", Number)
        def number(self, packet):
            self.publish("ctrl", Word(f"after {packet.body.n}"))

    virtual.probe.follow("ctrl")
    virtual.run_until(2.5)
    virtual.spawn(Echo, "a/client/Echo")
    sent = virtual.source.publish("system", Number(7))
    virtual.settle()
    heard = assert_published(virtual.probe, Word, source="a/client/Echo")
    assert heard.cause == (sent.source, sent.seq)
    assert (heard.stamp_s, heard.seq, heard.destination) == (2.5, 1, "")
    assert sent.cause is None


def test_the_numbers_of_a_source_go_on_with_its_successor(virtual):
    diary = virtual.spawn(Diary, "a/client/Diary")
    assert [diary.publish("ctrl", Number(1)).seq for _ in range(3)] == [1, 2, 3]
    diary.stop()
    virtual.settle()
    successor = virtual.spawn(Diary, "a/client/Diary")
    assert successor.publish("ctrl", Number(1)).seq == 4
    # What a snapshot from elsewhere says may be older than what this agent remembers: no number comes twice.
    virtual.kernel.continue_seq("a/client/Diary", 2)
    assert virtual.kernel.seq_of("a/client/Diary").take() == 5
    virtual.kernel.continue_seq("a/client/Diary", 100)
    assert virtual.kernel.seq_of("a/client/Diary").take() == 100


def test_what_is_no_packet_type_or_no_channel_is_refused_with_a_sentence(virtual):
    with pytest.raises(LocalProtocolError, match="builtins.dict is no packet type"):
        virtual.source.publish("system", {})
    with pytest.raises(
        UnknownChannelError, match="published 'virtual_rig.number' to 'maps', but a has no such channel"
    ):
        virtual.source.publish("maps", Number(1))


def test_a_slow_reader_that_may_lose_nothing_makes_the_publisher_wait(virtual):
    class Careful(Diary):
        @on("system", Number, queue=reliable(2))
        def number(self, packet):
            super().number(packet)

    careful = virtual.spawn(Careful, "a/client/Careful")
    virtual.send(Number(1), Number(2))
    with pytest.raises(MailboxFullError, match="a/client/Careful has no room for 'virtual_rig.number'"):
        virtual.send(Number(3))
    virtual.settle()
    virtual.send(Number(3))
    virtual.settle()
    assert careful.diary == ["start", 1, 2, 3]


def test_two_types_on_one_channel_are_handled_in_the_order_in_which_they_were_published(virtual):
    class Reader(Diary):
        @on("system", Word)
        def word(self, packet):
            self.diary.append(packet.body.text)

    reader = virtual.spawn(Reader, "a/client/Reader")
    virtual.send(Number(1), Word("a"), Number(2), Word("b"), Word("c"), Number(3))
    virtual.settle()
    assert reader.diary == ["start", 1, "a", 2, "b", "c", 3]


def test_one_method_may_listen_to_several_things_and_several_methods_to_one(virtual):
    class Reader(Diary):
        @on("ctrl", Number)
        @on("system", Number)
        def number(self, packet):
            self.diary.append(f"{packet.channel} {packet.body.n}")

        @on("system")
        def anything(self, packet):
            self.diary.append(f"any {packet.type.rpartition('.')[2]}")

    reader = virtual.spawn(Reader, "a/client/Reader")
    virtual.send(Number(1), Word("a"))
    virtual.send(Number(2), channel="ctrl")
    virtual.settle()
    assert sorted(map(str, reader.diary)) == ["any number", "any word", "ctrl 2", "start", "system 1"]
    assert reader.diary.index("system 1") < reader.diary.index("any word")


def test_a_method_for_addressed_packets_hears_no_others_though_another_does(virtual):
    class Reader(Diary):
        @on("system", Number, addressed=True)
        def mine(self, packet):
            self.diary.append(f"mine {packet.body.n}")

    reader = virtual.spawn(Reader, "a/client/Reader")
    for number, to in enumerate(["", "a", "a/client/Reader", "a/client"]):
        virtual.send(Number(number), to=to)
    virtual.kernel.stream.inject(
        virtual.source.publish("ctrl", Number(9), "*").__class__(
            "system", "virtual_rig.number", "b/client/S", "*", 0.0, 1, Number(9)
        )
    )
    virtual.settle()
    assert [entry for entry in reader.diary if str(entry).startswith("mine")] == ["mine 2", "mine 3"]
    assert [entry for entry in reader.diary if isinstance(entry, int)] == [0, 1, 2, 3, 9]


def test_a_channel_that_a_task_makes_may_be_listened_to_at_once(virtual):
    class Mapper(Diary):
        def on_start(self):
            self.open_channel("map")
            self.subscribe("map", Number, self.number)

    mapper = virtual.spawn(Mapper, "a/client/Mapper")
    virtual.send(Number(4), channel="map")
    virtual.settle()
    assert mapper.diary == [4]
    mapper.close_channel("map")
    with pytest.raises(UnknownChannelError):
        virtual.send(Number(5), channel="map")


def test_lines_and_events_reach_the_log_and_an_agent_without_a_log_goes_on(virtual):
    virtual.source.log("warning", "hot")
    virtual.source.event("melted", degrees=900)
    virtual.settle()
    assert virtual.probe.packets(LogLine)[0].body == LogLine("warning", "hot")
    assert virtual.probe.packets(Event)[0].body == Event("melted", {"degrees": 900})


@pytest.mark.parametrize(("takes_s", "handled"), [(0.02, 1), (0.002, 3), (0.0004, 13), (0.0, 100)])
def test_a_turn_ends_when_its_time_is_up_however_long_each_packet_takes(takes_s, handled):
    class Slow(ActorCore):
        count = 0

        @on("system", Number)
        def take(self, packet):
            self.count += 1
            virtual.dispatcher.clock.advance_to(virtual.dispatcher.clock.now() + takes_s)

    virtual = VirtualRig()
    slow = virtual.spawn(Slow, "a/client/Slow")
    virtual.send(*map(Number, range(100)))
    assert slow.actor_inbox.token.locked(), "its turn is due"
    slow.take_turn(0.005)
    assert slow.count == handled
    slow.actor_inbox.token.acquire(blocking=False)
    slow.take_turn(None)
    assert slow.count == 100


class Greedy(ActorCore):
    """Wants every line of `log`, and has room for one."""

    @on("log", None, queue=reliable(1))
    def heard(self, packet):
        pass


def test_a_component_that_logs_does_not_fail_where_a_reader_of_log_has_no_room(virtual):
    reader = virtual.kernel.spawn(Greedy, "a/test/greedy")
    speaker = virtual.kernel.spawn(ActorCore, "a/test/speaker")
    virtual.settle()
    reader.actor_inbox.paused = True
    for _ in range(3):
        speaker.log("info", "one more line")
        virtual.kernel.log("info", "one more line")
        speaker.event("one_more_event")
    assert len(reader.actor_inbox.queues["log"]) == 1
    assert virtual.kernel.stream.undelivered == 8


def test_a_kernel_without_a_mesh_and_a_disk_has_used_neither(virtual):
    assert virtual.kernel.mission_packets_sent() == 0
    assert virtual.kernel.disk_use() == (0, 0)


def test_a_class_is_not_published_in_place_of_an_instance(virtual):
    diary = virtual.spawn(Diary, "a/client/Diary")
    with pytest.raises(LocalProtocolError, match=r"Number is a class: publish an instance, Number\(\.\.\.\)"):
        diary.publish("system", Number)
